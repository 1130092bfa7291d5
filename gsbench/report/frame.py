"""Read runs into tables: `runs` (a row a run), `views` (a row a view of a run) and `curves` (a row a test on val).

`gsbench.report.columns` declares every column, with its unit and meaning. A number that is missing is NaN. Everything
that compares, averages or shows results starts from these tables.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from gsbench.config_roles import facts
from gsbench.errors import InputError, printable
from gsbench.measure import record as record_files
from gsbench.measure.record import Record
from gsbench.report import plausible, study
from gsbench.report.columns import CURVES, RUNS, VIEWS

RUN = ["experiment", "dataset", "scene", "model", "variant", "seed"]  # together they name a run
TIMES = ["train_s", "train_min", "train_cpu_s", "frame_ms", "frame_p10_ms", "frame_p90_ms", "fps"]
ALONE = 3.0  # load up to which a run has its GPU for itself: a training keeps one or two CPU threads busy
NUMBERS = [column.name for column in RUNS if column.kind == "float"]

Records = list[tuple[Path, Record]]  # with the paths of their files


@dataclass(frozen=True)
class Results:
    """The tables of some runs; `views` and `curves` have the index of their run in the column `run`.

    `runs` has the columns of RUNS and PARTS, and also `path` and `record`, for what no column holds.
    """

    runs: pd.DataFrame
    views: pd.DataFrame
    curves: pd.DataFrame
    faults: tuple[str, ...] = ()  # why records were left out

    def of(self, kept: pd.Series) -> "Results":
        """Return the tables of some runs, such as ``results.of(results.runs.scene == "trex")``."""
        runs = self.runs[kept]
        views, curves = (table[table.run.isin(runs.index)] for table in (self.views, self.curves))
        return Results(runs, views, curves, self.faults)

    @property
    def finished(self) -> "Results":
        """Return the tables of the runs that finished without error."""
        return self.of(self.runs.status == "ok")

    def chapters(self) -> Iterator["Results"]:
        """Yield the tables of each experiment on each data set, with times of one machine, and with labels."""
        for _, runs in self.runs.groupby(["experiment", "dataset"]):
            chapter = self.of(self.runs.index.to_series().isin(runs.index))
            yield Results(labelled(of_one_machine(chapter.runs)), chapter.views, chapter.curves, self.faults)


def load(root: Path) -> Results:
    """Read all records and studies under `root`; wrong and duplicate ones are left out, and `faults` says why.

    Raises:
        InputError: the folder is missing or has no record.
    """
    return tables(*records_in(root))


def records_in(root: Path) -> tuple[Records, list[str]]:
    """Return all records under `root` with the paths of their files, and why wrong ones are left out.

    Raises:
        InputError: the folder is missing or has no record, not even a damaged one.
    """
    if not root.is_dir():
        raise InputError(f"{root}: expected a folder of results, such as results/mini, found none")
    read: Records = []
    faults = []
    for path in record_files.find(root):
        try:
            read.append((path, record_files.read(path)))
        except InputError as error:
            faults.append(printable(error))
    for folder in study.find(root):
        try:
            of_study, damaged = study.read(folder)
            read += [(folder / study.RUNS_FILE, record) for record in of_study]
            faults += damaged
        except InputError as error:
            faults.append(printable(error))
    if not read and not faults:
        names = f"{record_files.FILE_NAME} or {study.RUNS_FILE}"
        raise InputError(f"{root}: expected results, found no {names} in it or below")
    records = []
    views = plausible.views_of_data(record for _, record in read)
    for path, record in read:
        try:
            plausible.check(record, f"{path}: {record.path}", views)
            records.append((path, record))
        except InputError as error:
            faults.append(printable(error))
    return records, faults


def tables(records: Records, faults: list[str]) -> Results:
    """Return the tables of records, sorted by RUN; of two records of one run, the first one is kept."""
    return laid_out(*unique(records, faults))


def unique(records: Records, faults: list[str]) -> tuple[Records, list[str]]:
    """Return the first record of each run, sorted by RUN, and the faults with a line for each further record."""
    once: dict[tuple[Any, ...], tuple[Path, Record]] = {}
    for path, record in records:
        if (run := run_name(record)) in once:
            faults = [*faults, printable(f"{path}: the same run as {once[run][0]}; keep one of them")]
        else:
            once[run] = path, record
    return [once[run] for run in sorted(once)], faults


def laid_out(records: Records, faults: Sequence[str]) -> Results:
    """Return the tables of records in their order."""
    runs = pd.DataFrame([row(record) | {"path": path, "record": record} for path, record in records], dtype=object)
    first = [*(column.name for column in RUNS), "path", "record"]
    # Behind the declared columns stand those that depend on the records: protocol_* and stage_*.
    runs = runs.reindex(columns=[*first, *(name for name in runs if name not in first)])
    runs = runs.astype({column.name: column.kind for column in RUNS if column.kind not in ("str", "dict")})
    views = [view for i, (_, record) in enumerate(records) for view in _views(i, record)]
    points = [(i, point) for i, (_, record) in enumerate(records) for point in record.curve]
    curves = [{"run": i} | {name: getattr(point, key) for name, key in CURVES.items()} for i, point in points]
    return Results(runs, _table(views, ["view"], VIEWS), _table(curves, [], CURVES), tuple(faults))


def run_name(record: Record) -> tuple[Any, ...]:
    """Return what names a run: its values of RUN."""
    return tuple(getattr(record, part) for part in RUN)


def _table(rows: list[dict[str, Any]], texts: list[str], numbers: Mapping[str, str]) -> pd.DataFrame:
    """Return rows as a table that has all its columns even if there is no row."""
    return pd.DataFrame(rows, columns=["run", *texts, *numbers]).astype(dict.fromkeys(numbers, float) | {"run": int})


def row(r: Record) -> dict[str, Any]:
    """Return a record as a row of `runs`."""
    values = {column.name: value_at(r, column.place) for column in RUNS if column.place}
    values |= {c.name: values[c.name] / c.unit for c in RUNS if c.unit != 1 and values[c.name] is not None}
    values |= {"psnr_val_db": psnr_val(r), "train_min": _number(values["train_s"]) / 60}
    if values["frame_ms"] is None and values["fps"]:  # stated of a method that gsbench did not render
        values["frame_ms"] = 1000 / values["fps"]
    values |= {"rendered_elsewhere": r.rendered_elsewhere is not None}
    values |= {"iterations": iterations(r), "machine": r.provenance.machine}
    values |= {"on_demand": r.on_demand is not None, "gate": gating(r)}
    values |= {"versions": ", ".join(f"{name} {version}" for name, version in sorted(r.provenance.versions.items()))}
    values |= {f"protocol_{name}": value for name, value in r.protocol.items()}
    return values | {f"stage_{name}": seconds for name, seconds in (r.cost.stage_s if r.cost else {}).items()}


def value_at(node: Any, place: str) -> Any:
    """Return the value at a dotted place of a record or of its settings; None if a part of it is missing."""
    for name in place.split("."):
        node = node.get(name) if isinstance(node, dict) else getattr(node, name, None)
    return node


def _views(run: int, r: Record) -> Iterator[dict[str, Any]]:
    """Yield the scores of each view."""
    for view in r.per_view:
        yield {"run": run, "view": view.name} | {name: getattr(view, field) for name, field in VIEWS.items()}


def psnr_val(r: Record) -> float:
    """Return PSNR on val at the end of a run, after effects were removed from its Gaussians; NaN if not measured.

    The curve ends before this removal, so the PSNR that it costs is subtracted.
    """
    if r.protocol.get("eval_split") == "val":
        return _number((r.metrics or {}).get("psnr"))
    at_end = [gate for gate in r.on_demand.gates if gate.step is None] if r.on_demand else []
    lost = sum(gate.measured_db for gate in at_end if gate.checked_on == "val")
    points = [point for point in r.curve if r.stop is None or point.iteration == r.stop.kept]
    return _number(points[-1].psnr_val) - lost if points else math.nan


def iterations(r: Record) -> float:
    """Return the iterations of the training that was kept; NaN if the record does not hold them."""
    value = r.length_choice.kept if r.length_choice else value_at(r.provenance.config, "train.iterations")
    return float(value) if isinstance(value, int) else math.nan


def gating(r: Record) -> str:
    """Return "gate=end" or the like where a run removes effects otherwise than its model does by default, else ""."""
    gate = value_at(r.provenance.config, "effects.gate") or "off"
    is_default = gate == (value_at(r.provenance.config, "model.gate") or "off")
    return f"gate={gate}" if gate in facts("effects.gate").choices and not is_default else ""


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def shared_gpu(r: Record) -> bool:
    """Tell whether a run on a GPU seems to have had company, which no record holds: the load says so."""
    on_gpu = str(value_at(r.provenance.config, "device")).startswith("cuda")
    return on_gpu and r.cost is not None and (r.cost.load or 0.0) > ALONE


def of_one_machine(runs: pd.DataFrame) -> pd.DataFrame:
    """Set times to NaN unless they are of the machine with the most finished runs, which no other run shared.

    `timed_on` is its name, and `is_timed` tells which times count.
    """
    counted = runs[runs.status == "ok"] if (runs.status == "ok").any() else runs
    machine = str(counted.machine.value_counts(sort=False).idxmax())  # of equals the first
    is_timed = (runs.machine == machine) & ~runs.record.map(shared_gpu).astype(bool)
    return runs.assign(**{name: runs[name].where(is_timed) for name in TIMES}, timed_on=machine, is_timed=is_timed)


def labelled(runs: pd.DataFrame) -> pd.DataFrame:
    """Add what a run is called.

    `main`: models are compared with these settings, which most models share, and with images that were rendered
    elsewhere. `compared`: the same but for ablations and the removal of effects. `series`: the curve of a
    figure. `label`: the row of a table.
    """
    counted = runs[(runs.status == "ok") & ~runs.rendered_elsewhere]
    models = counted[["model", "variant"]].drop_duplicates().variant.value_counts()  # their number by variant
    main = min(models.index, key=lambda variant: (-models[variant], is_ablated(variant), variant), default="")
    gated = (runs.gate != "") & (runs.gate.nunique() > 1)  # has a curve beside that of the model without gate
    series = runs.model.where(~gated, runs.model + ", " + runs.gate)
    label = names_of(runs) if runs.variant.nunique() > 1 else runs.model
    compared = (runs.variant.map(common) == common(main)) | runs.rendered_elsewhere
    is_main = (runs.variant == main) | runs.rendered_elsewhere
    return runs.assign(main=is_main, compared=compared, series=series, label=label)


def names_of(runs: pd.DataFrame) -> pd.Series:
    """Return the names of configurations: the model with its variant, such as "7dgs iterations=500"."""
    return (runs.model + " " + runs.variant).str.rstrip()


def title_of(runs: pd.DataFrame) -> str:
    """Return what the runs of one experiment on one data set are called."""
    return f"experiment {runs.experiment.iloc[0]}, data {printable(runs.dataset.iloc[0])[:60]}"


def covered(runs: pd.DataFrame, by: str = "label") -> list[str]:
    """Return the scenes that every model that has finished one has finished: averages are over these."""
    ok = runs[runs.status == "ok"]
    finished = pd.crosstab(ok.scene, ok[by]) > 0
    return list(finished.index[finished.all(axis=1)])


def without(variant: str, *names: str) -> str:
    """Return a variant (a text such as "train.iterations=500,model.x=1") without some of its settings.

    Args:
        variant: settings with their values, separated by commas.
        names: the settings to leave out, each named by the last part of its key, such as "iterations".
    """
    return ",".join(word for word in variant.split(",") if word.partition("=")[0].rpartition(".")[2] not in names)


def common(variant: str) -> str:
    """Return a variant without ablations and the removal of effects, which may differ between compared models."""
    return without(variant, "gate", "budget_db", "ablation")


def is_ablated(variant: str) -> bool:
    """Tell whether a variant changes one part of a model, by a file in conf/ablation."""
    return any(word.startswith("ablation=") and word != "ablation=none" for word in variant.split(","))

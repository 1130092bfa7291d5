"""Make result tables from run records: a row for each model and scene, and below it the row of the 7DGS paper."""

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import pandas as pd

from gsbench.errors import printable
from gsbench.measure.atomic import write_atomically
from gsbench.measure.record import METRICS, Record
from gsbench.report import frame, layout, paper
from gsbench.report.cells import cell
from gsbench.report.conditions import conditions
from gsbench.report.configurations import groups
from gsbench.report.intervals import over_seeds
from gsbench.report.layout import EMPTY, QuantityColumn, Row, Section, Table, Values

LEAKS = "psnr_best_on_test (leaks)"  # the title says that test views leak into the choice of the iteration
COLUMNS = (  # their keys are columns of `tidy`
    QuantityColumn("psnr", "PSNR", 2, "psnr", "higher"),
    QuantityColumn("ssim", "SSIM", 3, "ssim", "higher"),
    QuantityColumn("lpips_alex", "LPIPS-Alex", 3, "lpips", "lower"),
    QuantityColumn("train_min", "train min", None, "train_min", "lower"),
    QuantityColumn("fps", "FPS", None, "fps", "higher"),
    QuantityColumn("num_gaussians", "#Gaussians", 0, "num_gaussians", "lower"),
)
OF_THE_MACHINE = ("train_min", "fps")  # columns that can be compared only between runs on one machine
COSTS = ("fps", "num_gaussians", "bytes", "peak_memory", "train_cpu_s", "load")  # costs that are copied from a record
TRAIN = QuantityColumn("psnr_train", "PSNR train", 2)  # shown on request
REGIONS = {  # beside PSNR, if a run has them; by the names of `Record.regions`
    "moving": QuantityColumn("psnr_moving", "PSNR moving", 2, better="higher"),
    "object": QuantityColumn("psnr_object", "PSNR object", 2, better="higher"),
}
EXTRA_COLUMNS = (  # if a run has them
    QuantityColumn("lpips_vgg", "LPIPS-VGG", 3, better="lower"),
    QuantityColumn(LEAKS, LEAKS, 2),
)
CHOICES = {c.name: c for c in (COLUMNS[0], TRAIN, *REGIONS.values(), *COLUMNS[1:], *EXTRA_COLUMNS)}

PAPER = (
    "Table 1 of the 7DGS paper (ICCV 2025): 30,000 iterations at half resolution (Technicolor: full). Its PSNR is the "
    "best on test during training (leaks). Its times are of a V100."
)
PAPER_OTHER_DATA = (
    "OTHER DATA: Table 1 of the 7DGS paper for its scene of the same name. The scene measured here is a stand-in "
    "rendered for this project, so the two rows cannot be compared."
)
PAPER_LPIPS = (
    "The paper does not name the LPIPS network of Table 1. Its 7DGS has 0.198 on Technicolor in Table 1, 0.101 with "
    "AlexNet in Table 2."
)


def load(root: Path) -> tuple[list[Record], list[str]]:
    """Return all run records under `root`, and the reasons why damaged or duplicate records were left out.

    Raises:
        InputError: the folder is missing or has no record.
    """
    results = frame.load(root)
    return list(results.runs.record), list(results.faults)


def tidy(records: list[Record]) -> pd.DataFrame:
    """Make a data frame with a row for each run and a column for each quantity; a missing number is an empty cell."""
    return pd.DataFrame([quantities(record) for record in records])


def quantities(r: Record) -> dict[str, Any]:
    """Return the quantities of a run record in a dictionary by name; a missing number is None."""
    flat: dict[str, Any] = {
        name: getattr(r, name) for name in ("experiment", "dataset", "scene", "model", "variant", "seed")
    }
    flat |= {"status": r.status, "reason": r.reason}
    flat |= {LEAKS if name == "psnr_best_on_test" else name: (r.metrics or {}).get(name) for name in METRICS}
    flat["missing"] = "; ".join(f"{name}: {why}" for name, why in sorted(r.missing.items()))
    cost = r.cost
    flat["train_min"] = cost and cost.train_s / 60
    flat |= {name: cost and getattr(cost, name) for name in COSTS}
    flat |= {f"render_ms_{name}": cost and getattr(cost.render_ms, name) for name in ("p10", "p50", "p90")}
    flat |= {f"effect_{name}": value for name, value in vars(r.effects).items()}
    flat |= {f"protocol_{name}": value for name, value in sorted(r.protocol.items())}
    names = ("device", "threads", "git_commit", "config_hash", "data_hash", "time")
    return flat | {name: getattr(r.provenance, name) for name in names} | {"machine": r.provenance.machine}


def build(
    records: list[Record], *, train: bool = False, machine: str | None = None, columns: Sequence[str] = ()
) -> list[Table]:
    """Make a result table for every experiment and data set in `records`, sorted by name.

    Args:
        records: the run records of one or more experiments.
        train: whether to show PSNR on training views too.
        machine: the machine whose training times and FPS are shown; None for the machine of most runs in each table.
        columns: the names in CHOICES of the columns to show; empty for those that the runs have.
    """
    chosen = [CHOICES[name] for name in columns]
    return [_TableBuilder(group.records, train, machine or group.machine, chosen).table() for group in groups(records)]


def of_one_machine(records: list[Record], machine: str) -> list[str]:
    """List a footnote that names the machine whose times a table shows, and the machines whose times are left out.

    The list is empty if all runs were on one machine.

    Args:
        records: the run records of the table.
        machine: the machine whose times are shown.
    """
    others = Counter(r.provenance.machine for r in records if r.status == "ok" and r.provenance.machine != machine)
    if not others:
        return []
    named = "; ".join(f"{printable(other)} ({count} run{'s' * (count > 1)})" for other, count in sorted(others.items()))
    return [
        f"train min and FPS are of one machine, {printable(machine)}. Those of other machines are left out: {named}. "
        "All other columns are means over all runs."
    ]


class _TableBuilder:
    """Makes the result table of one experiment on one data set, and collects the footnotes of its cells."""

    def __init__(
        self, records: list[Record], train: bool, machine: str, columns: Sequence[QuantityColumn] = ()
    ) -> None:
        self.records = records
        self.machine = machine
        self.scenes = sorted({r.scene for r in records})
        variants = {r.variant for r in records}
        self.common = variants.pop() if len(variants) == 1 else ""  # the settings of all runs; stated below the table
        self.models = sorted({self._name(r) for r in records})
        flat = [quantities(r) for r in records]
        regions, extra = (
            [c for c in some if any(q[c.key] is not None for q in flat)] for some in (REGIONS.values(), EXTRA_COLUMNS)
        )
        found = [COLUMNS[0], *([TRAIN] if train else []), *regions, *COLUMNS[1:], *extra]
        self.columns = list(columns or found)
        finished: dict[tuple[str, str], list[dict[str, Any]]] = {}
        for q, name in zip(flat, map(self._name, records), strict=True):
            if q["status"] == "ok":
                finished.setdefault((q["scene"], name), []).append(q)
        self.values = {  # by scene and model, then column and seed; NaN where it is missing
            run: {c.key: self._values(c, seeds) for c in self.columns} for run, seeds in finished.items()
        }
        self.marks: list[str] = []

    def _values(self, column: QuantityColumn, seeds: list[dict[str, Any]]) -> dict[int, float]:
        """Return the values of a column for the runs of a model by seed, or NaN if there are none.

        Training times and FPS are only taken from runs on the machine whose times the table shows.
        """
        counted = [q for q in seeds if column.key not in OF_THE_MACHINE or q["machine"] == self.machine]
        found = {q["seed"]: math.nan if q[column.key] is None else float(q[column.key]) for q in counted}
        return found or dict.fromkeys((q["seed"] for q in seeds), math.nan)

    def _name(self, record: Record) -> str:
        """Return the name of a run's row: the model, and its settings if the runs of the table differ in them."""
        return f"{record.model} {record.variant}" if record.variant != self.common else record.model

    def table(self) -> Table:
        """Make the table with a section for every scene, and with an average if there are several scenes."""
        first = self.records[0]
        sections = [self._scene(scene) for scene in self.scenes]
        if len(sections) > 1:
            sections.append(self._average())
        title = f"experiment {first.experiment}, data {printable(first.dataset)}"
        common = [f"All runs differ from the experiment in {self.common}."] if self.common else []
        said = [*common, *of_one_machine(self.records, self.machine), *conditions(self.records), *self._no_vgg()]
        return Table(title, self.columns, sections, self.marks, said)

    def _no_vgg(self) -> list[str]:
        """List a footnote that says why the table has no column for LPIPS-VGG; the list is empty if it has one."""
        shown = any(c.key == "lpips_vgg" for c in self.columns)
        why = {r.missing["lpips_vgg"] for r in self.records if "lpips_vgg" in r.missing}
        return [f"{_lacking(EXTRA_COLUMNS[0], why)}."] if why and not shown else []

    def _mark(self, text: str) -> str:
        """Return the number of a footnote as text, such as "(1)"; footnotes with equal texts share a number."""
        if text not in self.marks:
            self.marks.append(text)
        return f"({self.marks.index(text) + 1})"

    def _scene(self, scene: str) -> Section:
        """Make the rows of a scene: each model's mean, each run that did not finish, and the paper's results."""
        rows: list[Row] = []
        notes = []
        leader = self._leader([self._of([scene], model) for model in self.models if (scene, model) in self.values])
        for model in self.models:
            runs = [r for r in self.records if (r.scene, self._name(r)) == (scene, model)]
            finished = [r for r in runs if r.status == "ok"]
            if finished:
                cells = {c.key: self._cell(c, finished) for c in self.columns}
                values = self._of([scene], model)
                rows.append(Row(model, cells, str(len(finished)), _shown_psnr(values) == leader, values))
            for run in runs:
                if run.status != "ok":
                    rows.append(Row(f"{model} seed {run.seed}", {self.columns[0].key: run.status}))
                    notes.append(f"{model} seed {run.seed} {run.status}: {printable(run.reason)}")
            if runs:
                rows += self._paper_row([scene], model)
        return Section(scene, rows, notes + self._regions([r for r in self.records if r.scene == scene]))

    def _regions(self, runs: list[Record]) -> list[str]:
        """List a note on the pixels of `psnr_moving` and `psnr_object` in a scene, and why there are none.

        The note is left out for old runs, which did not look for such pixels.
        """
        said = []
        for name, column in REGIONS.items():
            found = {f"{one.share:.1%} of the image, in {one.views} of {len(r.per_view)} views, by {one.source}"
                     for r in runs if (one := r.regions.get(name))}  # fmt: skip
            why = {r.missing[column.key] for r in runs if column.key in r.missing}
            if found:
                said.append(f"{column.title} is measured on {' or on '.join(sorted(found))}")
            elif why and column not in self.columns:  # otherwise a mark in a cell says it
                said.append(_lacking(column, why))
        return [printable(f"{'. '.join(said)}.")] if said else []

    def _cell(self, column: QuantityColumn, finished: list[Record]) -> str:
        """Format the mean and the interval over seeds; if a run lacks the number, return a dash with a footnote."""
        values = list(self.values[finished[0].scene, self._name(finished[0])][column.key].values())
        if not math.isnan(fmean(values)):
            return column.show(fmean(values), over_seeds(values).half)
        if column.key in OF_THE_MACHINE:
            return EMPTY  # a footnote of the table names the machines that are left out
        name = "psnr_best_on_test" if column.key == LEAKS else column.key
        why = {r.missing.get(name, "not measured") for r in finished if (r.metrics or {}).get(name) is None}
        return f"{EMPTY} " + self._mark(f"{_lacking(column, why)}.")

    def _average(self) -> Section:
        """Make the rows of averages over the scenes that every model has finished.

        All rows therefore average the same scenes.
        """
        models = [model for model in self.models if any((scene, model) in self.values for scene in self.scenes)]
        covered = [s for s in self.scenes if models and all((s, model) in self.values for model in models)]
        notes = [f"{model} finished on no scene and is left out" for model in self.models if model not in models]
        title = f"average over {len(covered)} of {len(self.scenes)} scenes"
        if not covered:
            return Section(title, [], [*notes, "there is no scene that every model has finished"])
        averages = {model: self._of(covered, model) for model in models}
        if any(math.isnan(_mean(values, c.key)) for values in averages.values() for c in self.columns):
            notes.append(f"{EMPTY}: not measured on every scene")
        leader = self._leader(list(averages.values()))
        rows = []
        for model, values in averages.items():
            cells = {c.key: c.show(_mean(values, c.key)) for c in self.columns}
            rows.append(Row(model, cells, "", _shown_psnr(values) == leader, values))
            rows += self._paper_row(covered, model)
        return Section(f"{title}: {', '.join(covered)}", rows, notes)

    def _paper_row(self, scenes: list[str], model: str) -> list[Row]:
        """List the row of the paper's results for `model`, averaged over `scenes`; empty if the paper lacks a scene."""
        runs = [r for r in self.records if self._name(r) == model and r.scene in scenes]
        if any(r.effects.refinement != paper.MODELS.get(r.model) for r in runs):
            return []  # the model has the same name as one of the paper but differs in AGR
        datasets = {r.scene: str(r.protocol.get("paper_dataset")) for r in runs}
        found = [paper.paper_row(datasets[scene], scene, runs[0].model) for scene in scenes]
        rows = [row for row in found if row is not None]
        if len(rows) < len(scenes):
            return []
        theirs = all(r.protocol.get("paper_dataset") == r.dataset for r in runs)
        label = f"paper {self._mark(PAPER)}" if theirs else f"paper, other data {self._mark(PAPER_OTHER_DATA)}"
        cells = {c.key: EMPTY for c in self.columns}
        for column in (c for c in COLUMNS if c.key in cells):
            values = [getattr(row, column.paper) for row in rows]
            if None not in values:
                cells[column.key] = column.show(fmean(values))
        if "lpips_alex" in cells:
            cells["lpips_alex"] += f" {self._mark(PAPER_LPIPS)}"
        return [Row(label, cells, paper=True)]

    def _of(self, scenes: list[str], model: str) -> Values:
        """Return the values of a row: those of a model on some scenes."""
        return {c.key: {scene: self.values[scene, model][c.key] for scene in scenes} for c in self.columns}

    def _leader(self, rows: list[Values]) -> str | None:
        """Return the highest mean PSNR as the table shows it; None if no row or not the first column has a PSNR.

        Rows that look equal after rounding are all marked as the best.
        """
        if self.columns[0] != COLUMNS[0]:
            return None
        means = [mean for mean in (_mean(values, COLUMNS[0].key) for values in rows) if not math.isnan(mean)]
        return COLUMNS[0].show(max(means)) if means else None


def _lacking(column: QuantityColumn, reasons: set[str]) -> str:
    """Say why a column is empty, from the reasons in records, such as "needs masks" or "not measured"."""
    fetched = f"needs weights: `python -m gsbench.fetch {column.key.replace('_', '-')}`"
    why = sorted({fetched if reason.startswith("no trunk weights") else reason for reason in reasons})  # older records
    is_verb = all(reason.startswith("needs ") for reason in why)
    return printable(f"{column.title}{'' if is_verb else ' is empty:'} {'; '.join(why)}")


def _mean(values: Values, key: str) -> float:
    """Return the mean over scenes of the mean over seeds; NaN if a number is missing."""
    return fmean(fmean(seeds.values()) for seeds in values[key].values())


def _shown_psnr(values: Values) -> str:
    """Format a mean PSNR with as many digits as the table shows; empty if the table has no PSNR."""
    key = COLUMNS[0].key
    return COLUMNS[0].show(_mean(values, key)) if key in values else ""


def write(records: list[Record], folder: Path, built: list[Table]) -> None:
    """Write result tables to ``table.md`` and all quantities of the runs to ``table.csv``.

    Args:
        records: the run records of one or more experiments.
        folder: the folder for the two files.
        built: the tables of these records.
    """
    write_atomically(folder / "table.md", layout.markdown(built).encode())
    write_atomically(folder / "table.csv", tidy(records).map(cell).rename(columns=cell).to_csv(index=False).encode())

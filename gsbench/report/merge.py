"""Read the runs of several people as one set, in which contributors, protocols and data never share a mean.

A run is left out, and the reason named, if it did not finish or if no commit reproduces it.

Names distinguish rows, as all sections group by them. Runs measured by another protocol are another experiment, and a
scene with other data is another scene. Of a model that several people trained, the runs of whoever has the most in
the experiment keep its name; the others' are a variant, such as "7dgs from=bob".
"""

import re
from collections.abc import Sequence
from pathlib import Path

import msgspec
import pandas as pd

from gsbench.config_roles import training_hash
from gsbench.errors import InputError, printable
from gsbench.measure.record import Record
from gsbench.report.frame import Results, laid_out, records_in, run_name, unique
from gsbench.report.reproduction import MEASURING
from gsbench.report.sections.protocol import SILENT

MOST_RUNS = 20_000  # of a contributor
# What tells protocols apart. A resolution follows from the data and from `downscale`.
PROTOCOL = ("name", *(setting for setting in MEASURING if setting != "resolution"))
LONGEST_PROTOCOL = 300  # characters, which titles have


def read(folders: Sequence[Path]) -> Results:
    """Read folders of runs or published studies, one of each contributor, as one set.

    `runs` also has the columns "contributor", "published_by" (all who published this very run, which counts once),
    "training" (SHA-256 of the settings of the training) and "protocol".

    Raises:
        InputError: a folder is missing, has no record, lies in another one, or has a name that no table can show.
    """
    kept: dict[bytes, tuple[Path, Record]] = {}
    people: dict[bytes, list[str]] = {}  # who published the run
    faults: list[str] = []
    for name, folder in contributors(folders).items():
        records, why = unique(*records_in(folder))
        if len(records) > MOST_RUNS:
            raise InputError(f"{folder}: expected at most {MOST_RUNS:,} runs of one contributor, got {len(records):,}")
        faults += why
        for path, record in records:
            if reason := unpublishable(record):
                faults.append(printable(f"{path}: {record.path}: {reason}"))
                continue
            # A run with other numbers, or on another machine, is its contributor's; an equal one is the first's.
            key = _identity(record)
            kept.setdefault(key, (path, record))
            people.setdefault(key, []).append(name)
    keys = sorted(kept, key=lambda key: (run_name(kept[key][1]), people[key]))
    results = laid_out([kept[key] for key in keys], faults)
    if results.runs.empty:
        return results
    runs = results.runs.assign(
        contributor=[people[key][0] for key in keys],
        published_by=[", ".join(people[key]) for key in keys],
        training=[training_hash(record.provenance.config) for record in results.runs.record],
        protocol=[protocol_of(record) for record in results.runs.record],
    )
    return Results(with_distinct_names(runs), results.views, results.curves, results.faults)


def contributors(folders: Sequence[Path]) -> dict[str, Path]:
    """Name each folder by its last part, or by as many as make all names differ, such as "bob/mini".

    Raises:
        InputError: a folder is named twice or lies in another one, or has a name that no table can show.
    """
    whole = [folder.resolve().relative_to("/") for folder in folders]
    for folder, path in zip(folders, whole, strict=True):
        if sum(path.is_relative_to(other) for other in whole) > 1:
            raise InputError(f"--merge {folder}: expected folders apart from each other, got it in another or twice")
    lengths = range(1, max(len(path.parts) for path in whole) + 1)
    named = (["/".join(path.parts[-n:]) for path in whole] for n in lengths)  # by one part, by two, ..
    names = next(names for names in named if len(set(names)) == len(names))
    for name, folder in zip(names, folders, strict=True):
        if not re.fullmatch(r"[\w.+/-]{1,100}", name):
            raise InputError(f"--merge {folder}: expected a name of letters, digits and _ . + -, got {name!r:.120}")
    return dict(zip(names, folders, strict=True))


def unpublishable(record: Record) -> str:
    """Return why a run may not be among published ones, such as that its commit does not reproduce it; "" if it may."""
    if record.status != "ok":
        return f"{record.status}: {record.reason}"
    commit = record.provenance.git_commit
    if not re.fullmatch(r"[0-9a-f]{7,64}", commit or ""):
        return f"its commit is {commit}, which does not reproduce it"
    if len(text := protocol_of(record)) > LONGEST_PROTOCOL:
        return f"protocol: expected at most {LONGEST_PROTOCOL} characters, got {len(text):,}: {text[:60]}"
    return ""


def _identity(record: Record) -> bytes:
    """Return bytes that are equal for two records of one run: settings, data, commit, machine and numbers."""
    numbers = [record.metrics, record.per_view, record.cost, record.curve]
    provenance = record.provenance
    named = [run_name(record), provenance.git_commit, provenance.data_hash, provenance.machine, protocol_of(record)]
    return msgspec.json.encode([named, training_hash(provenance.config), numbers], order="sorted")


def protocol_of(record: Record) -> str:
    """Return how a run was measured as text, such as "protocol gsbench, eval_split test, background black"."""
    recorded = {name: record.protocol.get(name) for name in PROTOCOL}
    values = {name: SILENT.get(name, "none") if value is None else value for name, value in recorded.items()}
    name = values.pop("name")
    shown = [f"{key} {value}" for key, value in values.items() if value is not False and value != SILENT.get(key)]
    return printable(", ".join([f"protocol {name}", *shown]))


def with_distinct_names(runs: pd.DataFrame) -> pd.DataFrame:
    """Return runs whose names tell protocols, data and contributors apart: columns experiment, scene and variant."""
    runs = runs.assign(experiment=runs.experiment + " (" + runs.protocol + ")")
    place = ["experiment", "dataset"]
    has_others = runs.groupby([*place, "scene"]).data_hash.transform("nunique") > 1
    runs = runs.assign(
        scene=runs.scene.where(~has_others, runs.scene + " (data " + runs.data_hash.str[:8].map(printable) + ")")
    )
    size = runs.groupby([*place, "contributor"]).seed.transform("size")
    ordered = runs.assign(size=-size).sort_values(["size", "contributor"], kind="stable")  # who has the most is first
    first = ordered.groupby([*place, "model", "variant"]).contributor.transform("first").reindex(runs.index)
    named = (runs.variant + ",from=" + runs.contributor).str.lstrip(",")
    return runs.assign(variant=runs.variant.where(runs.contributor == first, named))


def is_merged(results: Results) -> bool:
    """Tell whether runs are of contributors, as `read` returns them."""
    return "contributor" in results.runs

"""Say of a merged set whose runs it has, and which of them go by one name but are not the same."""

import msgspec
import pandas as pd

from gsbench.config_roles import listed
from gsbench.errors import printable
from gsbench.report.frame import NUMBERS, RUN, Results, names_of, without
from gsbench.report.reproduction import other_settings
from gsbench.report.section import Column, Section, number

# Equal in runs that give the same bits on one machine; `training` implies the variant.
IDENTITY = ["experiment", "dataset", "scene", "model", "seed", "git_commit", "training", "data_hash"]


def sections(results: Results) -> list[Section]:
    """Return the sections about all contributors: who they are, and what has one name but is not the same."""
    repeats = _repeats(results)
    return [_contributors(results, repeats), *_conflicts(repeats), *_trainings(results)]


def _repeats(results: Results) -> pd.DataFrame:
    """Return the runs that several people made with one commit, settings, data and seed; `is_equal`: to the bit."""
    runs = results.runs
    results_of_training = [
        msgspec.json.encode([r.metrics, r.per_view, r.cost and [r.cost.num_gaussians, r.cost.bytes]], order="sorted")
        for r in runs.record
    ]
    groups = runs.assign(bits=results_of_training).groupby(IDENTITY)
    repeats = groups.contributor.transform("nunique") > 1
    return runs[repeats].assign(is_equal=groups.bits.transform("nunique")[repeats] == 1)


def _contributors(results: Results, repeats: pd.DataFrame) -> Section:
    shared = results.runs.assign(name=results.runs.published_by.str.split(", ")).explode("name", ignore_index=True)
    rows = []
    for name, runs in shared.groupby("name"):
        repeated = repeats[repeats.contributor == name]
        rows.append(
            {
                "contributor": name,
                "runs": len(runs),
                "earlier": int((runs.contributor != name).sum()),
                "repeats": len(repeated),
                "equal": int(repeated.is_equal.sum()),
                "models": ", ".join(sorted(set(runs.model))),
                "commits": ", ".join(commit[:12] for commit in sorted(set(runs.git_commit))),
                "machines": "; ".join(sorted(set(runs.machine))),
            }
        )
    columns = {
        "earlier": Column("another's", 0),
        "repeats": Column("repeated", 0),
        "equal": Column("of these equal", 0),
    }
    text = (
        "A contributor is a folder. “another's”: runs that a folder before has, number for number; they count once. "
        "“repeated”: commit, settings of the training, data, protocol and seed of another contributor's run. "
        "“of these equal”: with the same numbers to the bit, but for times."
    )
    return Section("contributors", "Contributors", text, pd.DataFrame(rows), columns)


def _conflicts(repeats: pd.DataFrame) -> list[Section]:
    rows = []
    for _, runs in repeats[~repeats.is_equal].groupby(IDENTITY):
        psnr = [number(value, 4) for value in runs.psnr_db]
        others = [name for name in NUMBERS if runs[name].nunique(dropna=False) > 1 and name != "psnr_db"]
        rows.append(
            {
                "scene": runs.scene.iloc[0],
                "model": runs.model.iloc[0],
                "seed": str(runs.seed.iloc[0]),
                "contributors": ", ".join(runs.contributor),
                "PSNR": " and ".join(dict.fromkeys(psnr)),
                "machine": "the same" if runs.machine.nunique() == 1 else "others",
                "also differs in": ", ".join(others[:6]),
            }
        )
    text = (
        "Runs that claim one commit, one training, the same data and one seed, but not one result. On CPUs gsbench "
        "trains to the same bits on any machine; on GPUs rounding differs."
    )
    return [Section("conflicts", "Equal runs, other numbers", text, pd.DataFrame(rows))] if rows else []


def _trainings(results: Results) -> list[Section]:
    """Return the settings in which two contributors' trainings of one model and variant differ."""
    runs = results.runs[~results.runs.rendered_elsewhere]
    runs = runs.assign(variant=[without(variant, "from") for variant in runs.variant])  # which `merge` adds
    rows: dict[tuple[str, ...], dict[str, str]] = {}
    for _, same in runs.drop_duplicates([*RUN[:-1], "contributor"]).groupby(RUN[:-1]):  # all but the seed
        first, *others = same.itertuples()
        for other in others:
            if differing := listed(other_settings(first.config, other.config)):
                named = {"model": names_of(same).iloc[0], "contributors": f"{first.contributor}, {other.contributor}"}
                row_of_pair = named | {"settings of the second": printable(differing)}
                rows[tuple(row_of_pair.values())] = {"experiment": first.experiment} | row_of_pair
    text = "Trainings that go by one name although their settings differ, but for the seed."
    return [Section("trainings", "Equal names, other settings", text, pd.DataFrame(rows.values()))] if rows else []

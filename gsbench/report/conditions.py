"""State the conditions under which the results of a table were measured, and warn if they differ between runs."""

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial

from gsbench.errors import printable
from gsbench.measure.exact_views import sentence
from gsbench.measure.record import Record
from gsbench.report.configurations import is_beside_others, without

WARNING = "WARNING"
MOST_RUNS_NAMED = 3
# What a record means that lacks a part of its protocol.
_UNSAID = {"resize": "area", "repaired": "none", "val_every": "none"}
# The scenes on which gsbench's own settings were chosen; what is found on them may not hold on others.
TUNED = frozenset((
    "bouncingballs", "cloud", "moving-matte", "static-glossy", "static-matte", "suzanne",  # conf/exp/tuning.yaml
    "lego", "static-lego", "trex",
    "scene1_close_proximity", "scene4_occlusion", "scene7_deformation", "scene10_texture",
))  # fmt: skip
SPREAD = "± is half the width of the 95 % interval for other seeds on these scenes and views (Student's t)"
DEFINITIONS = (
    "PSNR: over all pixels and channels of a view, after the final iteration, averaged over views. SSIM: scikit-image, "
    "Gaussian window, data_range 1.",
    "FPS: 1000 / the median milliseconds of a frame, with slicing and AGR. train min: minutes of the training loop, "
    "without evaluation.",
)

Get = Callable[[Record], str]


def conditions(records: list[Record], spread: str = SPREAD) -> list[str]:
    """List a table's footnotes, which state protocol, data, machine, commit, versions and seeds; warnings come first.

    The footnotes describe the finished runs, because only these have results. If no run finished, they describe the
    failed runs and contain no warning. A failed run may have stopped before its backend or its data was known.

    Args:
        records: the run records of one table.
        spread: the text that explains the sign ± in this table.
    """
    finished = [r for r in records if r.status == "ok"]
    notes = _stated(finished or records, spread)
    return notes if finished else [note for note in notes if not note.startswith(WARNING)]


def _stated(records: list[Record], spread: str) -> list[str]:
    """List the footnotes on the conditions of the given runs, with a warning for each condition that differs."""
    names = sorted({name for r in records for name in r.protocol} - {"paper_dataset"})
    protocol: dict[str, Get] = {name: partial(_protocol, name=name) for name in names}
    protocol["iterations"] = _iterations
    data: dict[str, Get] = {printable(records[0].dataset): _data}
    notes = []
    for title, facts in (("protocol", protocol), ("data", data)):
        # Both may differ between scenes (lego is measured on val). Within a scene only a variant may change them.
        stated = [f"{printable(name)} {_by_scene(records, get)}" for name, get in facts.items()]
        notes.append(f"{title}: {'; '.join(stated)}")
        for name, get in facts.items():
            silent = [r for r in records if without(r.variant, name) == r.variant]
            if not _goes_with_scene(silent, get):
                notes.append(_differ(printable(name), silent, get))
    if any(r.scene == "lego" and r.protocol.get("eval_split") == "val" for r in records):
        notes.append("lego is measured on val: the test split of D-NeRF's lego contradicts its motion.")
    scenes = {r.scene for r in records}
    tuned, others = sorted(scenes & TUNED), sorted(scenes - TUNED)
    if tuned:
        rest = f"; not on {', '.join(map(printable, others))}" if others else ""
        notes.append(f"gsbench's own settings were tuned on {', '.join(tuned)}{rest} (docs/tuning.md).")
    for title, get in (("machine", _machine), ("commit", commit), ("versions", _versions)):
        same = len({get(r) for r in records}) == 1
        notes.append(f"{title}: {get(records[0])}" if same else _differ(title, records, get))
    notes += _load(records)
    if any(commit(r).endswith("-dirty") for r in records):
        notes.append(
            f"{WARNING}: files were changed after the commit (-dirty), which does not reproduce these numbers."
        )
    notes += [*_rounding(records), *_stops(records), *_averages(records), *_lengths(records), *_exact(records)]
    notes += [_seeds(records, spread), *DEFINITIONS]
    return sorted(notes, key=lambda note: not note.startswith(WARNING))


def _protocol(record: Record, name: str) -> str:
    if (value := record.protocol.get(name)) is None:
        value = _UNSAID.get(name, "none" if name in record.protocol else "not recorded")
    return printable(value)


def _iterations(record: Record) -> str:
    train = record.provenance.config.get("train")
    return printable(train.get("iterations", "not recorded")) if isinstance(train, dict) else "not recorded"


def _data(record: Record) -> str:
    """Return the first digits of the hash of a run's data, or the text that the record has instead of a hash."""
    of = printable(record.provenance.data_hash)
    return of if " " in of else of[:8]


def _machine(record: Record) -> str:
    return printable(record.provenance.machine)


def _load(records: list[Record]) -> list[str]:
    """List a footnote on the load of the machine that most runs used; the list is empty if no record has the load."""
    machine = Counter(r.provenance.machine for r in records).most_common(1)[0][0]
    costs = [r.cost for r in records if r.cost and r.provenance.machine == machine]
    loads = [cost.load for cost in costs if cost.load is not None]
    if not loads:
        return []
    silent = _silent(len(costs) - len(loads), len(costs))
    busy = sum(is_beside_others(r) for r in records if r.provenance.machine == machine)
    beside = f"; {busy} of {len(costs)} runs were measured beside other work, which makes times longer" if busy else ""
    return [f"load of the machine during training, with the run itself: {_span(loads, '.1f')}{silent}{beside}."]


def _silent(number: int, runs: int) -> str:
    """Return the end of a footnote that a number of the runs do not support, or "" if all do."""
    return f"; {number} of {runs} runs do not say" if number else ""


def _exact(records: list[Record]) -> list[str]:
    """List a footnote that names the views whose PSNR is capped; the list is empty if there is none."""
    exact = [r.exact for r in records if r.exact]
    if not exact:
        return []
    return [printable(f"{sentence(sorted(set().union(*exact)))}, in {len(exact)} of {len(records)} runs.")]


def _rounding(records: list[Record]) -> list[str]:
    """List a footnote on the change of PSNR by float32; the list is empty if no run measured it."""
    changes = [(r.metrics or {}).get("psnr_float32") for r in records]
    known = [change for change in changes if change is not None]
    if not known:
        return []
    silent = _silent(len(changes) - len(known), len(changes))
    return [
        f"Rounding to float32 changes PSNR of a view by at most {max(known):.1e} dB (three views of each run{silent})."
    ]


def _stops(records: list[Record]) -> list[str]:
    """List a footnote on runs that were measured at an earlier iteration (`train.patience`); empty if there is none."""
    early = [r.stop for r in records if r.stop is not None and r.stop.kept < r.stop.iteration]
    if not early:
        return []
    kept, ends = [stop.kept for stop in early], [stop.iteration for stop in early]
    return [f"{len(early)} of {len(records)} runs were measured at the iteration with the best PSNR on val, "
            f"{_span(kept, ',')}, and ended at iteration {_span(ends, ',')} (train.patience)."]  # fmt: skip


def _averages(records: list[Record]) -> list[str]:
    """List a footnote on runs that ended with averaged parameters (`train.average_from`); empty if there is none."""
    averaged = [r.averaged for r in records if r.averaged]
    if not averaged:
        return []
    return [f"{len(averaged)} of {len(records)} runs ended with parameters averaged over the last "
            f"{_span(averaged, ',')} iterations, because PSNR on val was higher (train.average_from)."]  # fmt: skip


def _lengths(records: list[Record]) -> list[str]:
    """List a footnote on runs that were trained at several lengths (`train.lengths`); empty if there is none."""
    chosen = [r.length_choice for r in records if r.length_choice is not None]
    if not chosen:
        return []
    return [f"{len(chosen)} of {len(records)} runs were trained at several lengths, of which the best on val was kept, "
            f"{_span([one.kept for one in chosen], ',')} iterations. Their seconds of training are those of all "
            f"lengths (train.lengths)."]  # fmt: skip


def _span(numbers: Sequence[float], form: str) -> str:
    """Return the least and the largest number, or one of them if they look alike."""
    return " to ".join(dict.fromkeys(format(number, form) for number in (min(numbers), max(numbers))))


def commit(record: Record) -> str:
    """Return the first digits of the commit of a run, with "-dirty" behind them if files were changed."""
    digits, *dirty = printable(record.provenance.git_commit or "not recorded").partition("-")
    return digits[:12] + "".join(dirty)


def _versions(record: Record) -> str:
    return ", ".join(f"{printable(k)} {printable(v)}" for k, v in sorted(record.provenance.versions.items()))


def _seeds(records: list[Record], spread: str) -> str:
    seeds = sorted({r.seed for r in records})
    listed = ", ".join(map(str, seeds))
    if len(seeds) == 1:
        return f"seed: {listed}. An interval (±) needs several seeds, such as seed=0,1,2."
    return f"seeds: {listed}; {spread}."


def _goes_with_scene(records: list[Record], get: Get) -> bool:
    """Tell whether a setting depends only on the scene, so that all runs on a scene have the same value."""
    return len({(r.scene, get(r)) for r in records}) == len({r.scene for r in records})


def _by_scene(records: list[Record], get: Get) -> str:
    """List the values of a setting in all runs, each followed by its scenes if not all scenes have it."""
    every = {record.scene for record in records}
    scenes: dict[str, set[str]] = {}
    for record in records:
        scenes.setdefault(get(record), set()).add(record.scene)
    ordered = sorted(scenes, key=lambda value: (len(value) if value.isdecimal() else 0, value))  # 250 before 1000
    return ", ".join(value if scenes[value] == every else f"{value} ({', '.join(sorted(scenes[value]))})"
                     for value in ordered)  # fmt: skip


def _differ(what: str, records: list[Record], get: Get) -> str:
    """Return a warning that the compared runs differ in a setting, with the names of the runs for each value."""
    runs: dict[str, list[str]] = {}
    for record in records:
        runs.setdefault(get(record), []).append("/".join(record.path.parts[1:]))
    listed = []
    for value, names in sorted(runs.items()):
        more = f" and {len(names) - MOST_RUNS_NAMED} more" if len(names) > MOST_RUNS_NAMED else ""
        listed.append(f"{value} ({', '.join(names[:MOST_RUNS_NAMED])}{more})")
    return f"{WARNING}: the rows differ in {what}: {'; '.join(listed)}."

"""Sum up runs and their comparison with another folder in at most six short lines, with which `make table1` ends."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from gsbench.errors import printable
from gsbench.measure.record import Record
from gsbench.report.against import AGREES, DIFFERS, UNTOLD, Comparison
from gsbench.report.configurations import iterations
from gsbench.report.page.messages import count, duration, sentence, shorten, shorten_middle

LONGEST = 100  # characters of a line
LONGEST_FOLDER = 40  # characters of a folder's name in a line
MOST_SEEDS = 3  # seeds that are named; more are counted
OTHERS = {"gaussians": "Gaussians", "mb": "MB", "seconds": "seconds", "ms": "ms a frame"}  # differ beside PSNR


def lines(of: Comparison, records: Sequence[Record], page: Path) -> list[str]:
    """Return what was trained, whether it agrees with the other folder, and where the report is.

    Args:
        of: the comparison of `records` with another folder.
        records: all records of the first folder, at least one.
        page: the path of the HTML report, which is the only line that may be long.
    """
    return [shorten(trained(records), LONGEST), *compared(of), f"Report: {printable(page)}"]


def trained(records: Sequence[Record]) -> str:
    """Return how many runs of which models, scenes, seeds and lengths there are, and how long they trained in all."""
    groups: dict[tuple[str, str], list[Record]] = {}
    for r in records:
        groups.setdefault((r.experiment, r.dataset), []).append(r)
    possible = sum(
        len({(r.model, r.variant) for r in group}) * len({r.scene for r in group}) * len({r.seed for r in group})
        for group in groups.values()
    )
    runs = count(len(records), "run") + (f" of {possible:,} combinations" if len(records) < possible else "")
    models, scenes = len({r.model for r in records}), len({(r.dataset, r.scene) for r in records})
    seeds = sorted({r.seed for r in records})
    named = f"seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}"
    finished = [r for r in records if r.status == "ok"]
    failed = len(records) - len(finished)
    seconds = duration(sum(r.cost.train_s for r in finished if r.cost))
    parts = [
        f"{count(models, 'model')} on {count(scenes, 'scene')}",
        named if len(seeds) <= MOST_SEEDS else count(len(seeds), "seed"),
        *_lengths(records),
        *([f"{failed} failed"] if failed else []),
        f"{seconds} of training in all",
    ]
    return f"{runs}: {', '.join(parts)}"


def _lengths(records: Sequence[Record]) -> list[str]:
    known = sorted({n for r in records if (n := iterations(r)) is not None})
    least = f"{known[0]:,} to " if len(known) > 1 else ""
    return [least + count(known[-1], "iteration")] if known else []


def compared(of: Comparison) -> list[str]:
    """Return whether the runs agree with those of the other folder, in at most four lines without full stops."""
    found = [_bits(of), _psnr(of)] if of.rows else []
    if of.otherwise:
        differing = {difference: len(names) for difference, names in of.otherwise.items()}
        found.append(f"Cannot be compared: {_most(differing)}")
    reasons = Counter(row.judged["psnr"].reason for row in of.of("psnr", UNTOLD))
    notes = [f"Cannot be told: {_most(reasons)}"] if reasons else []
    notes += [f"{name} differ in {n}" for quantity, name in OTHERS.items() if (n := len(of.of(quantity, DIFFERS)))]
    found += [sentence("; ".join(notes))] if notes else []
    if not found:
        found = [f"Cannot be compared: no model and scene is also in {_folder(of)}"]
    return [shorten(line, LONGEST) for line in found]


def _bits(of: Comparison) -> str:
    """Return how many of the runs whose seed both folders have are bit-equal."""
    shared = sum(len(row.shared) for row in of.rows)
    if not shared:
        return f"Bit-equal: no run has the seed of one in {_folder(of)}"
    equal = sum(len(row.bit_equal) for row in of.rows)
    return f"Bit-equal with the run of the same seed in {_folder(of)}: {equal} of {count(shared, 'run')}"


def _psnr(of: Comparison) -> str:
    """Return in how many models and scenes PSNR agrees or differs, and where the difference is largest."""
    agree, differ, total = len(of.of("psnr", AGREES)), len(of.of("psnr", DIFFERS)), len(of.rows)
    pairs = "1 model on a scene" if total == 1 else f"{total} models on scenes"
    text = f"PSNR differs in {differ} of {pairs}, agrees in {agree}" if differ else f"PSNR agrees in {agree} of {pairs}"
    largest = of.largest
    if largest is None:
        return text
    difference = f"{largest.judged['psnr'].difference.mean:+.2f}"
    if float(difference) == 0:
        return f"{text}; largest difference 0.00 dB"
    return f"{text}; largest difference {difference} dB, {printable(largest.model)} on {printable(largest.scene)}"


def _most(reasons: Mapping[str, int]) -> str:
    """Return the most frequent reason, and how many models on scenes have it or another one."""
    reason = max(reasons, key=lambda one: reasons[one])
    others = sum(reasons.values()) - reasons[reason]
    return f"{reason} (in {reasons[reason]}{f', others in {others}' if others else ''})"


def _folder(of: Comparison) -> str:
    return shorten_middle(of.theirs, LONGEST_FOLDER, LONGEST_FOLDER // 2)

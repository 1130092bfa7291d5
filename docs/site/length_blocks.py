"""Write the block of docs/results.md on long trainings: PSNR after each length, and after the one that val chooses."""

from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

from published import best, experiments, metric, signed, table

from gsbench.measure.record import Record

LENGTHS = {1000: "", 2000: "iterations=2000", 4000: "iterations=4000", 8000: "iterations=8000"}  # variants of runs
IN_SUITE = (1000, 2000)  # records of +exp=suite; the others are in the folder lengths


def lengths(published: Path) -> str:
    """Return the table of PSNR on test after four lengths, and of the length that `train.lengths=4` keeps."""
    suite = {scene: found for found in experiments(published / "suite") for scene in found.group.scenes}
    rows, longest, kept, steps = [], [], [], []
    for found in experiments(published / "lengths"):
        for model in found.group.models:
            for scene in found.configuration(model, LENGTHS[8000]).runs:
                runs = {
                    n: (suite[scene] if n in IN_SUITE else found).configuration(model, variant).runs[scene]
                    for n, variant in LENGTHS.items()
                }
                seeds = [run.seed for run in runs[8000]]
                runs = {n: [run for run in of if run.seed in seeds] for n, of in runs.items()}
                by_seed = [choose(one) for one in zip(*runs.values(), strict=True)]
                psnr = [metric(of, "psnr") for of in runs.values()]
                chosen = metric([run for run, _ in by_seed], "psnr")
                longest.append(psnr[-1] - max(psnr))
                kept.append(chosen - max(psnr))
                steps += [done for _, done in by_seed]
                rows.append([scene, model, *best(psnr, [f"{one:.2f}" for one in psnr]), f"{chosen:.2f}"])
    head = ["scene", "model", *(f"{n:,}" for n in LENGTHS), "kept"]
    said = (
        f"Over these {len(rows)} rows, 8,000 iterations are {signed(fmean(longest))} dB from the best length of a row "
        f"(worst: {signed(min(longest))} dB), and the kept length {signed(fmean(kept))} dB (worst: {signed(min(kept))} "
        f"dB). At least 0.1 dB is lost on {sum(one <= -0.1 for one in longest)} and "
        f"{sum(one <= -0.1 for one in kept)} rows. The lengths that are tried have {fmean(steps):,.0f} iterations "
        f"together on average."
    )
    return f"{table(head, sorted(rows), left=2)}\n\n{said}"


def choose(runs: Sequence[Record]) -> tuple[Record, int]:
    """Return the run that `train.lengths` keeps, and the iterations of all lengths that it tries.

    Args:
        runs: the runs of one seed, the shortest first; each has twice the iterations of the one before.
    """
    kept, done = runs[0], runs[0].curve[-1].iteration
    for run in runs[1:]:
        done += run.curve[-1].iteration
        if psnr_val(run) <= psnr_val(kept):
            break
        kept = run
    return kept, done


def psnr_val(run: Record) -> float:
    """Return the PSNR on val at the end of a run, dB."""
    value = run.curve[-1].psnr_val
    assert value is not None, f"{run.path}: expected a PSNR on val"
    return value


BLOCKS = {"lengths": lengths}

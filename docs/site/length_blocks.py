"""Write the block of docs/results.md on long training runs: PSNR after each length, and after that chosen on val."""

import math
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

from published import MODELS, best, experiments, metric, table
from suite_blocks import MOVING, val_after

from gsbench.measure.record import Record

LENGTHS = {1000: "", 2000: "iterations=2000", 4000: "iterations=4000", 8000: "iterations=8000"}  # variants of runs
OF_SUITE = {500: "iterations=500", 1000: "", 2000: "iterations=2000"}  # the lengths of all models and scenes


def lengths(published: Path) -> str:
    """Return the table of PSNR on test after four lengths, and of the length that `train.lengths=4` keeps."""
    suite = {scene: found for found in experiments(published / "suite") for scene in found.group.scenes}
    rows, tried = [], []
    for found in experiments(published / "lengths"):
        for model in found.group.models:
            for scene, longest in found.configuration(model, LENGTHS[8000]).runs.items():
                runs = []
                for variant in LENGTHS.values():  # the suite has most of the shorter training runs
                    own = found.configuration(model, variant).runs if found.has(model, variant) else {}
                    of = own.get(scene) or suite[scene].configuration(model, variant).runs[scene]
                    runs.append({run.seed: run for run in of})
                tried += (one := [[by_seed[run.seed] for by_seed in runs] for run in longest])
                psnr = [metric(list(of), "psnr") for of in zip(*one, strict=True)]
                kept = metric([choose(of)[0] for of in one], "psnr")
                rows.append([scene, model, *best(psnr, [f"{value:.2f}" for value in psnr]), f"{kept:.2f}"])
    of_suite = [
        runs
        for found in experiments(published / "suite")
        if found.group.dataset in MOVING
        for model in MODELS
        if all(found.has(model, variant) for variant in OF_SUITE.values())
        for scene in found.group.scenes
        for runs in zip(*(found.configuration(model, v).runs.get(scene, []) for v in OF_SUITE.values()), strict=False)
        if not any(math.isnan(val_after(run, 1)) or run.protocol["eval_split"] == "val" for run in runs)
    ]
    text = table(["scene", "model", *(f"{n:,}" for n in LENGTHS), "kept"], sorted(rows), left=2)
    own = said(f"these {len(tried)} runs", tried)
    others = (
        f"the {len(of_suite)} runs of all models and seeds on dynamic scenes of the suite that have val views and are "
        "measured on test, of 500, 1,000 and 2,000 iterations"
    )
    return f"{text}\n\n{own}\n\n{said(others, of_suite)}"


def said(what: str, tried: Sequence[Sequence[Record]]) -> str:
    """Say what the longest training run and the kept one lose to the best length on test, over lists of such runs."""
    lost: dict[str, list[float]] = {"longest": [], "kept": []}
    steps = []
    for runs in tried:
        kept, done = choose(runs)
        highest = max(metric([run], "psnr") for run in runs)
        for name, run in (("longest", runs[-1]), ("kept", kept)):
            lost[name].append(highest - metric([run], "psnr"))
        steps.append(done)
    mean, most = ({name: function(values) for name, values in lost.items()} for function in (fmean, max))
    return (
        f"Over {what}, the longest training run loses {mean['longest']:.2f} dB to "
        f"the best length on average, and at most {most['longest']:.2f} dB. The kept one loses "
        f"{mean['kept']:.2f} dB on average, and at most {most['kept']:.2f} dB. All lengths that are tried have "
        f"{fmean(steps):,.0f} iterations together on average."
    )


def choose(runs: Sequence[Record]) -> tuple[Record, int]:
    """Return the run that `train.lengths` keeps, and the iterations of all lengths that it tries.

    Args:
        runs: the runs of one seed, the shortest first; each has twice the iterations of the one before.
    """
    kept, done = runs[0], runs[0].curve[-1].iteration
    for run in runs[1:]:
        done += run.curve[-1].iteration
        if val_after(run, 1) <= val_after(kept, 1):
            break
        kept = run
    return kept, done


BLOCKS = {"lengths": lengths}

"""Write the blocks of README: tables and sentences that follow from the reference records.

A sentence says only what the records say: its numbers, its words, and whether it stands at all are computed, so a
record that changes changes the sentence.
"""

from operator import itemgetter
from pathlib import Path
from statistics import fmean

import suite_blocks
from published import (
    MODELS,
    ON_GPU,
    PAPERS,
    best,
    best_on_test,
    costs,
    experiment,
    gated,
    machine,
    metric,
    overfitted,
    plus_minus,
    signed,
    span,
    table,
)

from gsbench.measure.curve import FALL
from gsbench.report.messages import count
from gsbench.report.paper import paper_row

SHORT = ("250", "1,000", "4,000")  # iterations
SINGLE = [name for name in suite_blocks.EFFECTS if "instead of" not in name]  # effects, without other models


def figure(published: Path) -> str:
    """Return README's figure with its caption."""
    found = experiment(published, "frontier")
    of = found.of("7dgs")
    return (
        "![PSNR on test against seconds of training, a line for each model](docs/images/frontier.png)\n\n"
        f"*PSNR on test against training time (`make frontier`; {machine(found)}): means over {of.scenes} scenes and "
        f"{of.seeds} seeds, 95 % intervals over seeds.*"
    )


def cost(published: Path) -> str:
    """Return README's table of PSNR and seconds at three lengths of training, and what longer training does."""
    found = experiment(published, "frontier")
    models = [model for model in MODELS if model != "6dgs"]
    longer = overfitted(found)
    said = "PSNR on test in dB and seconds of training. Bold: the highest PSNR of a row. `7dgs_noagr` has no AGR, "
    said += "`7dgs_nodir` has neither AGR nor direction."
    if longer:
        said += f" From 2,000 iterations (not shown) to 4,000, PSNR falls by more than {FALL} dB for {len(longer)} of "
        said += f"{count(len(MODELS), 'model')} ([all rows, with 6DGS](docs/results.md#make-frontier)). "
        said += "`train.lengths=4` [chooses the length on val](docs/results.md#how-long-to-train)."
    rows = [costs(found, length, models, "{psnr}, {seconds} s") for length in SHORT]
    return f"{table(['iterations', *models], rows, left=0)}\n\n{said}"


def worth(published: Path) -> str:
    """Return README's table of the effects of time, direction and AGR, by kind of scene."""
    cells = suite_blocks.kinds(published, SINGLE)
    return f"{cells} Monocular: one moving camera. 1,000 iterations ([each scene](docs/results.md#over-scenes))."


def trex(published: Path) -> str:
    """Return README's table of trex at the paper's resolution, batch size and iterations."""
    found = experiment(published, "dnerf")
    variants = {"7dgs": ON_GPU, "7dgs_noagr": ON_GPU, "4dgs": PAPERS}
    ours = [found.of(model, variant) for model, variant in variants.items()]
    leaking = [best_on_test(found.runs(model, variant)) for model, variant in variants.items()]
    theirs = [paper_row("D-NeRF", "trex", model).psnr for model in variants]
    seeds = [str(len(found.runs(model, variant))) for model, variant in variants.items()]
    rows = [
        ["seeds", *seeds],
        ["last iteration, dB", *best([x.mean for x in ours], [plus_minus(x) for x in ours])],
        ["best on test, dB", *best([x.mean for x in leaking], [plus_minus(x) for x in leaking])],
        ["paper (best on test), dB", *best(theirs, [f"{x:.2f}" for x in theirs])],
    ]
    by_paper = found.runs("7dgs_noagr", f"recipe=paper,{PAPERS}")
    device = "GPU" if by_paper[0].protocol["backend"] == "cuda" else "CPU"
    said = (
        "The recipe was chosen on val, of trex and of other scenes ([details](docs/results.md#real-data-d-nerf-trex)). "
        f"With the numbers that the paper prints (`+recipe=paper`), `7dgs_noagr` has {metric(by_paper, 'psnr'):.2f} dB "
        f"at the last iteration ({count(len(by_paper), 'seed')}, {device}); settings that the paper does not give are "
        "gsbench's."
    )
    return f"{table(['', *variants], rows)}\n\n{said}"


def demand(published: Path) -> str:
    """Return README's sentence on what effects on demand change."""
    changed = gated(published, "7dgs")
    scenes = count(len(changed["psnr"]), "scene")
    return (
        f"On {scenes}, this changes the frame time of 7DGS by {span(changed['ms'], 0)} %, and its PSNR by "
        f"{span(changed['psnr'], 2)} dB ([docs/effects.md](docs/effects.md)). {compared(published)}"
    )


def compared(published: Path) -> str:
    """Return README's sentence on the choice of a model on val."""
    lost = suite_blocks.losses(published, itemgetter(suite_blocks.COMPARED))
    return (
        "`model=auto effects.compare=true` trains several models for 70 % of the iterations, and continues with the "
        f"one that has the highest PSNR on val. On {count(len(lost), 'dynamic scene')}, its PSNR on test differs from "
        f"that of the best of {count(len(suite_blocks.WHOLE), 'model')} on test by {signed(fmean(lost.values()))} dB "
        f"on average, and by {signed(min(lost.values()))} dB on the worst scene. The 70 % were chosen on these scenes."
    )


BLOCKS = {"figure": figure, "cost": cost, "worth": worth, "trex": trex, "demand": demand}

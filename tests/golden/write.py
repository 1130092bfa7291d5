"""Write the goldens: numbers of the published records, bits of trainings, names of runs.

    PYTHONPATH=tests:docs/site python tests/golden/write.py [mini.page trainings names ...]

Without a name it writes all. Run it after a change of numbers that is meant,
and read the difference before committing it.
"""

import csv
import json
import math
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import today
from tiny_run import overrides, write_moving_square

KEPT = Path(__file__).parent / "kept"
STUDIES = ("mini", "frontier", "suite", "dnerf", "effects", "lengths")
DIGITS = 10  # of the numbers that are kept
NUMBERS: dict[str, Callable[[], today.Numbers]] = {
    **{f"{study}.page": lambda study=study: today.page(study) for study in STUDIES},
    **{f"{study}.paper": lambda study=study: today.paper(study) for study in ("mini", "dnerf")},
    "mini.against_itself": lambda: today.against("mini", (0, 1, 2), (0, 1, 2)),
    "mini.against_other_seeds": lambda: today.against("mini", (0,), (1, 2)),
    "frontier.against_shared_seeds": lambda: today.against("frontier", (0, 1), (1, 2)),
}
SHORT = (
    *("train.iterations=60", "train.recipe_iterations=60", "train.curve_points=6", "train.sh_every=12"),
    *("train.densify.start=8", "train.densify.every=8", "train.densify.stop=48", "train.densify.max_gaussians=200"),
    "data.initial_points=100",
)
# By the name of the golden. Together they have every part of a training that an option turns on.
TRAININGS: dict[str, tuple[str, ...]] = {
    "3dgs": (
        *("model=3dgs", *SHORT, "train.densify.kind=mcmc", "train.lengths=2"),
        *("train.penalties.opacity.weight=0.01", "train.penalties.size={weight: 0.01, start: 10, stop: 50}"),
    ),
    "4dgs": (
        *("+exp=mini", "scene=suzanne", "scene.downscale=5", "model=4dgs", *SHORT, "optim=sparse_adam", "seed=3"),
        *("train.densify.kind=multiview", "train.densify.thin_to=0.8"),
        *("train.coarse=[[2,20]]", "train.cooldown_from=50", "raster.antialias=true"),
    ),
    "patience": ("model=4dgs", *SHORT, "train.patience=0.5"),  # ends with its best iteration
    "7dgs": (
        *("model=7dgs", "data.initial_lambda_t=0.05", "data.initial_points=100", "train.iterations=800"),
        *("train.densify.stop=17000", "train.densify.every=50", "train.densify.max_gaussians=2000"),
        *("train.average_from=25000", "effects.gate=both", "train.checkpoint_minutes=0.003"),
    ),
}
RESUMED = ("7dgs", 8)  # killed after so many checkpoints, again and again
COMMANDS = (
    "+exp=mini scene=suzanne",
    "+exp=mini scene=suzanne seed=2 results=elsewhere resume=false log=tensorboard",
    "+exp=mini scene=pendulum model=7dgs_noagr train.iterations=3000",
    "+exp=mini scene=suzanne model=7dgs_nodir agr=true",
    "+exp=mini scene=suzanne model=3dgs agr=true raster.antialias=true",
    "+exp=mini scene=suzanne model=auto",
    "+exp=mini scene=suzanne model=auto effects.compare=true",
    "+exp=mini scene=suzanne model=7dgs effects.gate=both effects.budget_db=0.1",
    "+exp=mini scene=suzanne model=7dgs effects.gate=off",
    "+exp=mini scene=suzanne model=4dgs optim=sparse_adam train.patience=0.2",
    "+exp=mini scene=suzanne model=4dgs train.lengths=4",
    "+exp=mini scene=suzanne model=6dgs +ablation=schur",
    "+exp=ablation scene=suzanne model=7dgs +ablation=no_agr",
    "+exp=mini scene=suzanne model=freetime train.penalties.size.weight=0.5 train.penalties.size.stop=100",
    "+exp=mini scene=suzanne model=ubs +recipe=mcmc train.densify.max_gaussians=5000",
    "+exp=dnerf data.root=/data scene=trex +recipe=paper protocol.best_on_test=true",
    "+exp=dnerf data.root=/data scene=trex model=4dgs scene.downscale=8 data.initial_points=20000"
    " train.iterations=3000",
    "+exp=dnerf data.root=/data scene=trex model=dgs protocol=dgs2026 +recipe=authors",
    "+exp=dnerf data.root=/data scene=lego +recipe=quick device=cuda",
    "+exp=frontier scene=pendulum model=6dgs train.densify.grad_threshold=4e-4",
    "+exp=technicolor data.root=/data scene=Painter scene.frames=[0,49] protocol.quantise=true protocol.renders=40",
    "+exp=tuning data.root=/data scene=suzanne +trial=late_harmonics train.average_from=800"
    " train.coarse=[[4,100],[2,300]]",
    "+exp=mini scene=suzanne model=7dgs model.lr.means.start=0.001 model.options.lambda_t=0.3 train.cooldown_from=900"
    " train.densify.thin_to=0.5 train.ssim_weight=0.3 train.batch_size=3 train.curve_points=5 seed=1",
    "+exp=colmap scene=custom scene.name=garden data.root=/data/garden scene.val_every=8",
    "+exp=pbr data.root=/data scene=dust model=ndgs device=cuda:1 train.checkpoint_minutes=30 launch.at_once=2",
)


def trainings(folder: Path) -> dict[str, Any]:
    data = write_moving_square(folder / "data")
    return {name: today.bits(*today.train(words_of(name, data, folder / name))) for name in TRAININGS}


def words_of(name: str, data: Path, results: Path) -> list[str]:
    """The command line of a training: on the scene that it names, or on a square that moves."""
    words = TRAININGS[name]
    return [*words, f"results={results}"] if words[0].startswith("+exp") else overrides(data, results, *words)


def in_a_folder() -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        return trainings(Path(folder))


TEXTS: dict[str, Callable[[], dict[str, Any]]] = {
    "trainings": in_a_folder,
    "names": lambda: {command: today.identity(command.split()) for command in COMMANDS},
    "blocks": today.blocks,
}


def keep_numbers(name: str) -> None:
    with (KEPT / f"{name}.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows([key, f"{value:.{DIGITS}g}"] for key, value in sorted(NUMBERS[name]().items()))


def kept_numbers(name: str) -> today.Numbers:
    """Read what `keep_numbers` wrote."""
    with (KEPT / f"{name}.csv").open(newline="") as file:
        return {key: float(value) for key, value in csv.reader(file)}


def differing(kept: today.Numbers, present: today.Numbers) -> list[str]:
    """Name each golden number that is missing now, or is another beyond the digits kept; what is new is free."""
    return [
        f"{key}: expected {number}, got {present.get(key)}"
        for key, number in kept.items()
        if not (
            math.isnan(present.get(key, math.nan))
            if math.isnan(number)
            else math.isclose(number, present.get(key, math.nan), rel_tol=1e-9, abs_tol=1e-12)
        )
    ]


def main(names: list[str]) -> None:
    for name in names or [*NUMBERS, *TEXTS]:
        if name in NUMBERS:
            keep_numbers(name)
        else:
            (KEPT / f"{name}.json").write_text(f"{json.dumps(TEXTS[name](), indent=1)}\n")


if __name__ == "__main__":
    main(sys.argv[1:])

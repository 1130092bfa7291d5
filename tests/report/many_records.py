"""Records for tests of the page: a frontier, an experiment of 5,000 runs, hostile texts, and an image strip."""

import dataclasses
from pathlib import Path

import numpy as np
from make_golden import make

from gsbench.measure import record as files
from gsbench.measure.curve import Point
from gsbench.measure.images import Pixels, strip, write_png
from gsbench.measure.record import Effects, Gate, OnDemand, Record, TimeScreen, ViewScore
from gsbench.measure.speed import RenderTimes

EFFECTS = {
    "3dgs": Effects(False, False, False),
    "4dgs": Effects(True, False, False),
    "6dgs": Effects(False, True, False),
    "7dgs": Effects(True, True, True),
    "7dgs_noagr": Effects(True, True, False),
}
HOSTILE = (
    "<script>document.title='owned'</script><img src=x onerror=alert(1)>\"'`</style></script>&amp;{{7*7}} "
    "\u202eright to left\u202c \u05e9\u05dc\u05d5\u05dd \u0645\u0631\u062d\u0628\u0627 " + "x" * 10_000
)
OLD_REASON = (  # of a record that was written before the words changed
    "what a static fit leaves over changes with time "
    "(p = 0.001, z = 12.0, 90% of time's slow waves are free of the camera)"
)
STAGES = ("slice", "raster", "loss", "backward", "density", "optimizer")


def frontier(
    models=tuple(EFFECTS), scenes=("suzanne", "moving-matte"), seeds=3, lengths=(250, 500, 1000, 2000), views=10
) -> list[Record]:
    """Finished runs of every model, scene, seed and length: longer is better and slower, 7dgs best and slowest."""
    return [
        one(model, scene, seed, length, views, lengths)
        for model in models
        for scene in scenes
        for seed in range(seeds)
        for length in lengths
    ]


def one(model: str, scene: str, seed: int, length: int, views: int, lengths: tuple[int, ...]) -> Record:
    """One run with numbers drawn from its name."""
    random = np.random.default_rng([seed, length, *scene.encode(), *model.encode()])
    rank = list(EFFECTS).index(model)
    effects = EFFECTS[model]
    reached = 20 + 3 * effects.time + 0.5 * effects.direction + effects.refinement + 1.5 * np.log2(length / 250)
    reached = float(reached + 0.1 * random.normal())
    psnr = [float(p) for p in reached + 0.5 * random.normal(size=views)]
    seconds = length / 100 * (1 + 0.2 * rank) * (1 + 0.02 * random.random())
    base = make("7dgs", scene, seed, float(np.mean(psnr)))
    variant = "" if length == 1000 or len(lengths) == 1 else f"iterations={length}"
    curve = [Point(length * i // 5, seconds * i / 5, reached - 5 + i) for i in range(1, 6)]
    config = {"train": {"iterations": length}}
    return dataclasses.replace(
        base,
        model=model,
        effects=effects,
        variant=variant,
        overrides=["+exp=mini", f"model={model}", f"scene={scene}", f"seed={seed}", f"train.iterations={length}"],
        per_view=[ViewScore(f"test/r_{i:03}", p) for i, p in enumerate(psnr)],
        cost=dataclasses.replace(
            base.cost,
            train_s=seconds,
            stage_s=dict.fromkeys(STAGES, seconds / 6),
            render_ms=RenderTimes(1.0, 1.0 + rank / 4 + length / 1000, 3.0),
            bytes=1_000_000 + 1000 * length,
        ),
        curve=curve,
        provenance=dataclasses.replace(base.provenance, config=config),
    )


def gates(seed: int = 0) -> list[Gate]:
    """A gate in training and one at the end, with numbers that differ from seed to seed."""
    first = {"refined": 500, "conditioned": 200, "time": 0, "direction": 0, "static": 100, "removed": 200}
    last = {"refined": 300 + 10 * seed, "conditioned": 150, "time": 40, "direction": 10, "static": 200, "removed": 100}
    last["removed"] -= 10 * seed
    orders = {"degree 0": 350, "degree 1": 50, "degree 2": 100, "degree 3, 2 waves": 200 + 10 * seed}
    return [
        Gate(0.1, 0.4, 0.3, first, {"degree 3": 800}, 400_000, 300_000, step=600, seconds=1.0),
        Gate(0.01, 0.04, 0.03, last, orders, 300_000, 200_000, None, "val", 2.0, 0.02 + 0.01 * seed, 4.0, 3.0,
             asleep=0.25),
    ]  # fmt: skip


def on_demand(records: list[Record], *, label: str = "auto", gate: str = "both") -> list[Record]:
    """The same runs with effects chosen, as another model or another variant of their own one."""
    found = []
    for r in records:
        own = label == r.model
        config = r.provenance.config | {"effects": {"gate": gate}, "model": {"gate": "off" if own else gate}}
        screen = TimeScreen("on", OLD_REASON, 0.001, 12.0, 0.9, 0.8)
        found.append(
            dataclasses.replace(
                r,
                model=label,
                variant=",".join(filter(None, [r.variant, f"gate={gate}"])) if own else r.variant,
                on_demand=OnDemand(None if own else screen, gates(r.seed)),
                provenance=dataclasses.replace(r.provenance, config=config),
            )
        )
    return found


def hostile() -> list[Record]:
    """Runs whose every free text tries to leave its place, and one that failed with such a reason."""
    runs = frontier(("3dgs", "7dgs"), ("suzanne",), 2, (1000,))
    protocol = {**runs[0].protocol, "name": HOSTILE, HOSTILE[:200]: HOSTILE}
    provenance = dataclasses.replace(
        runs[0].provenance, device=HOSTILE, git_commit=HOSTILE, versions={HOSTILE[:99]: HOSTILE}
    )
    views = [dataclasses.replace(view, name=f"{HOSTILE}{i}") for i, view in enumerate(runs[0].per_view)]
    stages = dataclasses.replace(runs[0].cost, stage_s={HOSTILE: 1.0})
    changes = {"dataset": HOSTILE, "protocol": protocol, "provenance": provenance, "overrides": [HOSTILE, "seed=0"]}
    bad = [dataclasses.replace(r, per_view=views, cost=stages, **changes) for r in runs]
    bad[-1] = dataclasses.replace(bad[-1], on_demand=hostile_choice())
    lost = {"status": "failed", "reason": HOSTILE, "metrics": None, "missing": {}, "cost": None}
    return [*bad, dataclasses.replace(bad[0], model="4dgs", per_view=[], curve=[], **lost)]


def hostile_choice() -> OnDemand:
    """Words, classes and numbers that no gate would write."""
    screen = TimeScreen(HOSTILE, HOSTILE, 2.0, -1e300, 1e300, -1.0)
    rows = {HOSTILE: 2**62, "refined": -(2**62), "removed": 2**62, "conditioned": 0}
    orders = {HOSTILE: 1, f"degree 1{HOSTILE}": -5, "degree 3": 2**62}
    gate = Gate(-1.0, 1e300, -1e300, rows, orders, -1, 2**62, None, HOSTILE, -1.0, None, 1e300, -1e300)
    return OnDemand(screen, [gate], [HOSTILE, HOSTILE[::-1], "", *(f"note {i}" for i in range(50))])


def write_all(records: list[Record], root: Path, *, pictures: int = 0) -> Path:
    """Write records where runs write them, image strips beside them, and return the experiment's folder."""
    for r in records:
        folder = files.run_path(root, r.experiment, r.scene, r.model, r.seed, variant=r.variant)
        files.write(r, folder / files.FILE_NAME)
        if pictures:
            random = np.random.default_rng(len(r.model))
            rows = [(random.random((40, 60, 3)), np.full((40, 60, 3), i / pictures)) for i in range(pictures)]
            write_png(strip(rows), folder / "pictures.png")
            if r.on_demand:
                write_png(effect_sets(random), folder / "effect_sets.png")
    return root / records[0].experiment


def effect_sets(random: np.random.Generator) -> Pixels:
    """A picture of the size of effect_sets.png, of noise."""
    return random.integers(0, 256, (120, 912, 3)).astype(np.uint8)

"""Invented records for tests of reports: every kind of row, any number of runs, hostile texts, and their tables."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from gsbench.measure import record as files
from gsbench.measure.curve import Point
from gsbench.measure.images import strip, write_png
from gsbench.measure.record import (
    Cost,
    Effects,
    Gate,
    OnDemand,
    Provenance,
    Record,
    Region,
    Renders,
    TimeScreen,
    ViewScore,
)
from gsbench.measure.speed import RenderTimes
from gsbench.report import frame
from gsbench.report.section import Section
from gsbench.report.sections import built

EFFECTS = {  # time, direction, AGR
    "3dgs": Effects(False, False, False),
    "4dgs": Effects(True, False, False),
    "6dgs": Effects(False, True, False),
    "7dgs": Effects(True, True, True),
    "7dgs_noagr": Effects(True, True, False),
    "dgs": Effects(True, True, False),
}
HOSTILE = (
    "<script>document.title='owned'</script><img src=x onerror=alert(1)>\"'`</style></script>&amp;{{7*7}} "
    "\u202eright to left\u202c \u05e9\u05dc\u05d5\u05dd \u0645\u0631\u062d\u0628\u0627 " + "x" * 10_000
)
STAGES = ("slice", "raster", "loss", "backward", "density", "optimizer")
TIMES = RenderTimes(40.0, 50.0, 60.0)
PROTOCOL = {
    "name": "gsbench",
    "background": "white",
    "downscale": 1,
    "eval_split": "test",
    "quantise": False,
    "resolution": "60x40",
}
BASE = Record(
    status="ok",
    reason=None,
    experiment="mini",
    model="7dgs",
    scene="suzanne",
    dataset="mini",
    seed=0,
    effects=EFFECTS["7dgs"],
    protocol=PROTOCOL | {"paper_dataset": None},
    metrics={"ssim": 0.9, "lpips_alex": 0.1, "lpips_vgg": None, "psnr_background_only": 12.5},
    missing={"lpips_vgg": "no trunk weights"},
    cost=Cost(90.0, {"raster": 60.0, "loss": 30.0}, TIMES, 20.0, 5000, 10**6, 10**9, train_cpu_s=150.0, load=2.0),
    provenance=Provenance(
        git_commit="0123456789abcdef0123456789abcdef01234567",
        versions={"python": "3.11.2", "torch": "2.13.0"},
        device="Invented CPU",
        threads=2,
        config={"train": {"iterations": 1000}},
        config_hash="c0" * 32,
        data_hash="3a" * 32,
        time="2026-01-01T00:00:00+00:00",
    ),
)


def but(record: Record, **changes: Any) -> Record:
    """The same record with other fields; a dict changes parts of a field, such as cost={"load": 1.0}.

    Numbers that follow from changed ones follow: the stages from seconds, FPS from frame times.
    """
    cost = changes.get("cost") or {}
    if "train_s" in cost and "stage_s" not in cost:
        cost = {"stage_s": {"raster": cost["train_s"]}} | cost
    if "render_ms" in cost and "fps" not in cost:
        cost = {"fps": cost["render_ms"].fps} | cost
    changes |= {"cost": cost} if cost else {}

    def part(before: Any, after: Any) -> Any:
        if not isinstance(after, dict):
            return after
        return dataclasses.replace(before, **after) if dataclasses.is_dataclass(before) else before | after

    return dataclasses.replace(record, **{name: part(getattr(record, name), value) for name, value in changes.items()})


def make(model: str = "7dgs", scene: str = "suzanne", seed: int = 0, psnr: float = 25.0, **changes: Any) -> Record:
    """A finished run with one view; `changes` replace whole fields."""
    run = but(
        BASE,
        model=model,
        scene=scene,
        seed=seed,
        effects=EFFECTS.get(model, EFFECTS["7dgs"]),
        metrics={"psnr": psnr, "psnr_channel_mean": psnr + 0.1, "psnr_best_on_val": psnr},
        per_view=[ViewScore("test/r_000", psnr, psnr + 0.1, 0.9, 0.1)],
        cost={"train_s": 90.0 + seed, "load": 2.0 + seed},
        curve=[Point(500, 45.0, psnr - 1), Point(1000, 90.0, psnr)],
    )
    if scene == "suzanne":
        run = but(run, protocol={"paper_dataset": "7DGS-PBR"}, provenance={"data_hash": "5e" * 32})
    return dataclasses.replace(run, **changes)


def elsewhere(record: Record, model: str, **costs: float | None) -> Record:
    """The same views as another program rendered them: of its cost only what is stated is known."""
    return dataclasses.replace(
        record,
        model=model,
        variant="",
        effects=None,
        overrides=[],
        curve=[],
        on_demand=None,
        parts={},
        cost=Cost(
            **{"train_s": None, "fps": None, "num_gaussians": None, "bytes": None} | costs,
            stage_s={},
            render_ms=None,
            peak_memory=None,
        ),
        protocol={key: value for key, value in record.protocol.items() if key != "backend"} | {"images": "8-bit PNG"},
        provenance=dataclasses.replace(record.provenance, config={"seed": record.seed}),
        rendered_elsewhere=Renders("8-bit PNG", "order", "800x800", "5e" * 32),
    )


def lost(record: Record, reason: str = "out of memory", status: str = "failed") -> Record:
    nothing: dict[str, Any] = {"metrics": None, "missing": {}, "cost": None, "per_view": [], "curve": []}
    return dataclasses.replace(record, status=status, reason=reason, **nothing)


def run(model="7dgs", seed=0, views=(25.0, 26.0), scene="suzanne", seconds=90.0, **changes) -> Record:
    """A run with the PSNR of its views, and its mean as the metric."""
    scores = [ViewScore(f"test/r_{i:03}", value) for i, value in enumerate(views)]
    base = but(make(model, scene, seed, sum(views) / len(views)), cost={"train_s": seconds}, effects=EFFECTS["7dgs"])
    return dataclasses.replace(base, **{"per_view": scores} | changes)


def runs_of(model, variant, psnr, seconds, seeds=(0,), scene="suzanne") -> list[Record]:
    """Runs of a model at a variant whose PSNR on val is half a dB above that on test."""
    kept: dict[str, Any] = {"variant": variant, "curve": [Point(1000, seconds, psnr + 0.5)]}
    return [run(model, s, (psnr + s / 100, psnr + s / 50), scene, seconds, **kept) for s in seeds]


def three_lengths() -> list[Record]:
    """Model a at 10, 20, 40 s, of which 20 is worse than 10; b at 15 s between them, and at 100 s the best."""
    points = (
        ("a", "", 20.0, 10.0),
        ("a", "iterations=2", 19.0, 20.0),
        ("a", "iterations=4", 23.0, 40.0),
        ("b", "", 19.5, 15.0),
        ("b", "iterations=9", 25.0, 100.0),
    )
    return [record for point in points for record in runs_of(*point)]


def moving(record: Record, psnr: float) -> Record:
    """The record with a PSNR of moving pixels, and without one of objects."""
    return but(
        record,
        metrics={"psnr_moving": psnr, "psnr_object": None},
        missing={"psnr_object": "needs masks, or images with alpha"},
        per_view=[dataclasses.replace(view, psnr_moving=psnr) for view in record.per_view],
        regions={"moving": Region("images of one camera", 1, 0.123, "5e" * 32)},
    )


def every_row() -> list[Record]:
    """A stand-in of a scene of the paper's and one more; seeds, failures, no LPIPS, a dirty commit, moving pixels."""
    of_pixels = {"psnr_moving": "needs 3 evaluated views with the same camera", "psnr_object": "needs masks"}
    dirty = {"git_commit": f"{BASE.provenance.git_commit}-dirty"}
    return [
        but(make("3dgs", psnr=20.0), missing=of_pixels),
        make("4dgs", psnr=23.004),
        make("7dgs", seed=0, psnr=25.0),
        make("7dgs", seed=1, psnr=26.0),
        lost(make("7dgs", seed=2), "step 431: means is not finite | nan", "diverged"),
        lost(make("7dgs_noagr")),
        but(
            make("3dgs", "moving-matte", psnr=21.0),
            metrics={"lpips_alex": None},
            provenance=dirty,
            missing={"lpips_alex": "no trunk weights"},
        ),
        moving(make("4dgs", "moving-matte", psnr=27.0), 21.5),
        moving(make("7dgs", "moving-matte", psnr=26.998), 22.0),
    ]


def frontier(
    models=("3dgs", "4dgs", "6dgs", "7dgs", "7dgs_noagr"),
    scenes=("suzanne", "moving-matte"),
    seeds=3,
    lengths=(250, 500, 1000, 2000),
    views=10,
) -> list[Record]:
    """Finished runs of every model, scene, seed and length: longer is better and slower, 7dgs best and slowest."""
    return [
        drawn(model, scene, seed, length, views, len(lengths) == 1)
        for model in models
        for scene in scenes
        for seed in range(seeds)
        for length in lengths
    ]


def drawn(model: str, scene: str, seed: int, length: int, views: int, is_only_length: bool) -> Record:
    """A run with numbers drawn from its name."""
    random = np.random.default_rng([seed, length, *scene.encode(), *model.encode()])
    rank, effects = [*EFFECTS].index(model), EFFECTS[model]
    reached = 20 + 3 * effects.time + 0.5 * effects.direction + effects.refinement + 1.5 * np.log2(length / 250)
    reached = float(reached + 0.1 * random.normal())
    psnr = [float(p) for p in reached + 0.5 * random.normal(size=views)]
    seconds = length / 100 * (1 + 0.2 * rank) * (1 + 0.02 * random.random())
    return but(
        run(model, seed, psnr, scene, seconds),
        effects=effects,
        variant="" if length == 1000 or is_only_length else f"iterations={length}",
        overrides=["+exp=mini", f"model={model}", f"scene={scene}", f"seed={seed}", f"train.iterations={length}"],
        cost={
            "stage_s": dict.fromkeys(STAGES, seconds / 6),
            "bytes": 1_000_000 + 1000 * length,
            "render_ms": RenderTimes(1.0, 1.0 + rank / 4 + length / 1000, 3.0),
        },
        curve=[Point(length * i // 5, seconds * i / 5, reached - 5 + i) for i in range(1, 6)],
        provenance={"config": {"train": {"iterations": length}}},
    )


def gates(seed: int = 0) -> list[Gate]:
    """A gate in training and one at the end, with numbers that differ from seed to seed."""
    first = {"refined": 500, "conditioned": 200, "time": 0, "direction": 0, "static": 100, "removed": 200}
    last = {"refined": 300 + 10 * seed, "conditioned": 150, "time": 40, "direction": 10, "static": 200}
    last["removed"] = 100 - 10 * seed
    checked = (0.02 + 0.01 * seed, 4.0, 3.0)  # dB that the picture loses, and milliseconds before and after
    orders = {"degree 0": 350, "degree 1": 50, "degree 2": 100, "degree 3, 2 waves": 200 + 10 * seed}
    return [
        Gate(0.1, 0.4, 0.3, first, {"degree 3": 800}, 400_000, 300_000, step=600, seconds=1.0),
        Gate(0.01, 0.04, 0.03, last, orders, 300_000, 200_000, None, "val", 2.0, *checked, asleep=0.25),
    ]


def on_demand(records: list[Record], *, label: str = "auto", gate: str = "both") -> list[Record]:
    """The same runs with effects chosen, as another model, or as another variant of themselves."""
    screen = TimeScreen("on", "p = 0.001 and z = 12.0", 0.001, 12.0, 0.9, 0.8)
    runs = []
    for r in records:
        is_itself = label == r.model
        config = r.provenance.config | {"effects": {"gate": gate}, "model": {"gate": "off" if is_itself else gate}}
        variant = ",".join(filter(None, [r.variant, f"gate={gate}"])) if is_itself else r.variant
        chosen = OnDemand(None if is_itself else screen, gates(r.seed))
        runs.append(but(r, model=label, variant=variant, on_demand=chosen, provenance={"config": config}))
    return runs


def hostile() -> list[Record]:
    """Runs whose every free text tries to leave its place, and one that failed with such a reason."""
    bad = [
        but(
            r,
            dataset=HOSTILE,
            protocol={"name": HOSTILE, HOSTILE[:200]: HOSTILE},
            overrides=[HOSTILE, "seed=0"],
            provenance={"device": HOSTILE, "git_commit": HOSTILE, "versions": {HOSTILE[:99]: HOSTILE}},
            per_view=[dataclasses.replace(view, name=f"{HOSTILE}{i}") for i, view in enumerate(r.per_view)],
            cost={"stage_s": {HOSTILE: 1.0}},
        )
        for r in frontier(("3dgs", "7dgs"), ("suzanne",), 2, (1000,))
    ]
    screen = TimeScreen(HOSTILE, HOSTILE, 2.0, -1e300, 1e300, -1.0)
    rows = {HOSTILE: 2**62, "refined": -(2**62), "removed": 2**62, "conditioned": 0}
    orders = {HOSTILE: 1, f"degree 1{HOSTILE}": -5, "degree 3": 2**62}
    gate = Gate(-1.0, 1e300, -1e300, rows, orders, -1, 2**62, None, HOSTILE, -1.0, None, 1e300, -1e300)
    notes = [HOSTILE, HOSTILE[::-1], "", *(f"note {i}" for i in range(50))]
    bad[-1] = but(bad[-1], on_demand=OnDemand(screen, [gate], notes))
    other = but(elsewhere(bad[0], "other"), rendered_elsewhere={"kind": HOSTILE, "resized_from": HOSTILE})
    return [*bad, lost(but(bad[0], model="4dgs"), HOSTILE), other]


def at_paper(
    model="7dgs",
    scene="trex",
    seed=0,
    psnr=30.0,
    *,
    dataset="D-NeRF",
    iterations=30_000,
    batch_size=4,
    frames=None,
    experiment="dnerf",
    variant="",
    **protocol,
) -> Record:
    """A run on D-NeRF at the protocol of the 7DGS paper; arguments change its config, or its `protocol`."""
    config = {"train": {"iterations": iterations, "batch_size": batch_size}, "scene": {"frames": frames}}
    paper_dataset = "D-NeRF" if dataset == "mini" else dataset
    images = {"background": "black", "downscale": 2, "resolution": "400x400", "paper_dataset": paper_dataset}
    return but(
        make(model, scene, seed, psnr),
        dataset=dataset,
        experiment=experiment,
        variant=variant,
        metrics={"psnr_best_on_test": psnr + 0.5},
        provenance={"config": config},
        protocol=images | protocol,
    )


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
                write_png(random.integers(0, 256, (120, 912, 3)).astype(np.uint8), folder / "effect_sets.png")
    return root / records[0].experiment


def results(*records: Record) -> frame.Results:
    """The tables of records, each at the path where a run writes it."""
    return frame.tables([(Path(record.path) / "record.json", record) for record in records], [])


def chapter(*records: Record) -> frame.Results:
    """The tables of records of one experiment on one data set."""
    (only,) = results(*records).chapters()
    return only


def sections(*records: Record) -> dict[str, Section]:
    """The sections of a report of these records, by key."""
    return {section.key: section for section in built(chapter(*records))}

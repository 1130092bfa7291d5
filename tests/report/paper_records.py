"""Invented records at the protocol of the 7DGS paper, and records that depart from it."""

from typing import Any

from make_golden import EFFECTS, make

from gsbench.measure.record import Effects, Record

EFFECTS.setdefault("dgs", Effects(time=True, direction=True, refinement=False))
EFFECTS.setdefault("6dgs", Effects(time=False, direction=True, refinement=False))


def at_paper(
    model: str = "7dgs",
    scene: str = "trex",
    seed: int = 0,
    psnr: float = 30.0,
    *,
    dataset: str = "D-NeRF",
    iterations: int = 30_000,
    batch_size: int = 4,
    frames: list[int] | None = None,
    experiment: str = "dnerf",
    variant: str = "",
    **protocol: Any,
) -> Record:
    """A record of a run on D-NeRF at the paper's protocol; arguments change its config, or its `protocol`."""
    base = make(model, scene, seed, psnr)
    config = {"train": {"iterations": iterations, "batch_size": batch_size}, "scene": {"frames": frames}}
    provenance = base.provenance.__class__(**{**vars(base.provenance), "config": config})
    paper_dataset = "D-NeRF" if dataset == "mini" else dataset
    own = {"background": "black", "downscale": 2, "resolution": "400x400", "paper_dataset": paper_dataset}
    metrics = {**(base.metrics or {}), "psnr_best_on_test": psnr + 0.5}
    return make(model, scene, seed, psnr, dataset=dataset, experiment=experiment, variant=variant, metrics=metrics,
                provenance=provenance, protocol={**base.protocol, **own, **protocol})  # fmt: skip


def records() -> list[Record]:
    """Every kind of row."""
    lost: dict[str, Any] = {"status": "failed", "reason": "out of memory", "metrics": None, "missing": {}, "cost": None}
    failed = at_paper("4dgs", "lego", eval_split="val")
    return [
        *(at_paper("7dgs", seed=seed, psnr=30.0 + seed) for seed in range(3)),
        at_paper("4dgs", psnr=29.0),
        at_paper("7dgs", psnr=28.0, variant="recipe=paper,best_on_test=true"),
        at_paper("7dgs", "mutant", psnr=41.0),
        at_paper("4dgs", "mutant", psnr=39.0),
        type(failed)(**{**vars(failed), **lost}),
        at_paper("7dgs", psnr=33.0, iterations=7000, resolution="200x200", variant="downscale=4,iterations=7000"),
        at_paper("7dgs", psnr=31.0, iterations=500, resolution="200x200", variant="downscale=4,iterations=500"),
        *(
            at_paper(
                "dgs",
                seed=seed,
                psnr=30.2 + seed,
                name="dgs2026",
                resize="pillow",
                quantise=True,
                variant="protocol=dgs2026",
            )
            for seed in range(2)
        ),
        at_paper("dgs", psnr=29.8, batch_size=1, variant="recipe=mcmc,batch_size=1"),
        make("7dgs", protocol={**make().protocol, "resolution": "80x80"}),
    ]

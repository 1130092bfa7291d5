"""Invented records that put every kind of row and footnote of a table into one report."""

import dataclasses
from pathlib import Path

from gsbench.measure.curve import Point
from gsbench.measure.record import Cost, Effects, Provenance, Record, Region, ViewScore
from gsbench.measure.speed import RenderTimes

GOLDEN = Path(__file__).parent / "golden" / "table.md"
NO_REGIONS = {
    "psnr_moving": "needs 3 evaluated views with the same camera",
    "psnr_object": "needs masks, or images with alpha",
}
EFFECTS = {
    "3dgs": Effects(time=False, direction=False, refinement=False),
    "4dgs": Effects(time=True, direction=False, refinement=False),
    "7dgs": Effects(time=True, direction=True, refinement=True),
    "7dgs_noagr": Effects(time=True, direction=True, refinement=False),
}


def make(model: str = "7dgs", scene: str = "suzanne", seed: int = 0, psnr: float = 25.0, **changes: object) -> Record:
    """A record of a run that is ok; `changes` replace its fields."""
    record = Record(
        status="ok",
        reason=None,
        experiment="mini",
        model=model,
        scene=scene,
        dataset="mini",
        seed=seed,
        effects=EFFECTS[model],
        protocol={
            "name": "gsbench",
            "background": "white",
            "downscale": 1,
            "eval_split": "test",
            "quantise": False,
            "paper_dataset": "7DGS-PBR" if scene == "suzanne" else None,
        },
        metrics={
            "psnr": psnr,
            "psnr_channel_mean": psnr + 0.1,
            "ssim": 0.9,
            "lpips_alex": 0.1,
            "lpips_vgg": None,
            "psnr_best_on_val": psnr,
            "psnr_background_only": 12.5,
        },
        missing={"lpips_vgg": "no trunk weights"},
        per_view=[ViewScore("test/r_000", psnr, psnr + 0.1, 0.9, 0.1)],
        cost=Cost(
            90.0 + seed,
            {"raster": 60.0, "loss": 30.0},
            RenderTimes(40.0, 50.0, 60.0),
            20.0,
            5000,
            10**6,
            10**9,
            train_cpu_s=150.0,
            load=2.0 + seed,
        ),
        curve=[Point(500, 45.0, psnr - 1), Point(1000, 90.0, psnr)],
        provenance=Provenance(
            git_commit="0123456789abcdef0123456789abcdef01234567",
            versions={"python": "3.11.2", "torch": "2.13.0"},
            device="Invented CPU",
            threads=2,
            config={"train": {"iterations": 1000}},
            config_hash="c0" * 32,
            data_hash="5e" * 32 if scene == "suzanne" else "3a" * 32,
            time="2026-01-01T00:00:00+00:00",
        ),
    )
    return dataclasses.replace(record, **changes)


def moving(record: Record, psnr: float) -> Record:
    """The record with a PSNR of moving pixels, and without one of objects."""
    return dataclasses.replace(
        record,
        metrics={**(record.metrics or {}), "psnr_moving": psnr, "psnr_object": None},
        missing=record.missing | {"psnr_object": NO_REGIONS["psnr_object"]},
        per_view=[dataclasses.replace(one, psnr_moving=psnr) for one in record.per_view],
        regions={"moving": Region("images of one camera", 1, 0.123, "5e" * 32)},
    )


def records() -> list[Record]:
    """A stand-in of a scene of the paper's and one more; seeds, failures, no LPIPS, a dirty commit, moving pixels."""
    without = make("3dgs", "moving-matte", psnr=21.0)
    no_lpips = {**(without.metrics or {}), "lpips_alex": None}
    dirty = dataclasses.replace(without.provenance, git_commit="0123456789abcdef0123456789abcdef01234567-dirty")
    nothing = {"metrics": None, "missing": {}, "cost": None, "per_view": [], "curve": []}
    return [
        dataclasses.replace(make("3dgs", psnr=20.0), missing={"lpips_vgg": "no trunk weights"} | NO_REGIONS),
        make("4dgs", psnr=23.004),
        make("7dgs", seed=0, psnr=25.0),
        make("7dgs", seed=1, psnr=26.0),
        make("7dgs", seed=2, status="diverged", reason="step 431: means is not finite | nan", **nothing),
        make("7dgs_noagr", status="failed", reason="out of memory", **nothing),
        dataclasses.replace(
            without, metrics=no_lpips, missing={**without.missing, "lpips_alex": "no trunk weights"}, provenance=dirty
        ),
        moving(make("4dgs", "moving-matte", psnr=27.0), 21.5),
        moving(make("7dgs", "moving-matte", psnr=26.998), 22.0),
    ]

"""Write the results folder of a large sweep without training: a plan, and the record or the progress of each run.

    PYTHONPATH=tests python tests/launch/crowd.py 5000 FOLDER  # time python -m gsbench.launch status FOLDER/crowd

Records are as long as real ones: the whole config, 20 points of curve, 20 views.
"""

import json
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from report.records import make

from gsbench.config import Config
from gsbench.launch import plan
from gsbench.launch.plan import Ended, Plan
from gsbench.measure.curve import Point
from gsbench.measure.record import METRICS, ViewScore
from gsbench.run import progress
from gsbench.run.progress import Progress

MODELS = ("3dgs", "4dgs", "6dgs", "7dgs", "7dgs_noagr")
SCENES = ("bouncingballs", "hellwarrior", "hook", "jumpingjacks", "lego", "mutant", "standup", "trex")
UNFINISHED = 50  # one run in so many has only a progress file


def overrides(model: str, scene: str, seed: int) -> list[str]:
    """The overrides of a run as its record has them."""
    return ["+exp=crowd", f"model={model}", f"scene={scene}", f"seed={seed}"]


def record(model: str, scene: str, seed: int) -> dict[str, Any]:
    """A record of a run that ended well, in plain JSON."""
    psnr, golden = 28 + (seed * 37 + len(model) * 11 + len(scene)) % 100 / 100, make()
    return asdict(
        replace(
            golden,
            experiment="crowd",
            model=model,
            scene=scene,
            dataset="crowd",
            seed=seed,
            overrides=overrides(model, scene, seed),
            metrics=dict.fromkeys(METRICS, 0.5)
            | {"psnr": psnr, "psnr_channel_mean": 28.0, "ssim": 0.9, "lpips_alex": 0.1},
            missing={},
            provenance=replace(golden.provenance, config={"seed": seed, "all": asdict(Config())}),
            per_view=[ViewScore(f"r_{i}", psnr + i / 10 - 0.95, 28.0, 0.9, 0.1) for i in range(20)],
            curve=[Point(1500 * (i + 1), 4.5 * i, 20 + i / 3) for i in range(20)],
        )
    )


def write(count: int, results: Path) -> Path:
    """Write the sweep into `results`/crowd and return that folder."""
    experiment = results / "crowd"
    runs = [(MODELS[i % 5], SCENES[i // 5 % 8], i // 40) for i in range(count)]
    at_plan = experiment / plan.FOLDER / "2026-11-22_00-00-00.000000"
    plan.write(Plan("local", [overrides(*run) for run in runs], host="elsewhere", started=time.time()), at_plan)
    for number, run in enumerate(runs):
        model, scene, seed = run
        folder = experiment / scene / model / f"seed{seed}"
        folder.mkdir(parents=True)
        if number % UNFINISHED:
            (folder / "record.json").write_text(json.dumps(record(*run), default=str))
            plan.write_ended(at_plan, number, Ended(str(folder.relative_to(results) / "record.json")))
        else:
            at = Progress(overrides(*run), host="elsewhere", pid=1, born=1, step=100, steps=30_000, seconds=9.0)
            progress.write(folder, at)
    return experiment


if __name__ == "__main__":
    print(write(int(sys.argv[1]), Path(sys.argv[2])))

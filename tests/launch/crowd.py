"""Write the results folder of a large sweep without training: a plan, and the record or the progress of each run.

    python tests/launch/crowd.py 5000 FOLDER      # then: time python -m gsbench.launch status FOLDER/crowd

Records are as long as real ones: the whole config, 20 points of curve, 20 views.
"""

import json
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from gsbench.config import Config
from gsbench.launch import plan
from gsbench.launch.plan import Ended, Plan
from gsbench.measure.curve import Point
from gsbench.measure.record import METRICS, Cost, Effects, Provenance, Record, ViewScore
from gsbench.measure.speed import RenderTimes
from gsbench.run.progress import FILE_NAME as PROGRESS
from gsbench.run.progress import Progress

MODELS = ("3dgs", "4dgs", "6dgs", "7dgs", "7dgs_noagr")
SCENES = ("bouncingballs", "hellwarrior", "hook", "jumpingjacks", "lego", "mutant", "standup", "trex")
UNFINISHED = 50  # one run in so many has only a progress file


def runs(count: int) -> list[tuple[str, str, int]]:
    """Model, scene and seed of so many runs."""
    return [(MODELS[i % 5], SCENES[i // 5 % 8], i // 40) for i in range(count)]


def overrides(model: str, scene: str, seed: int) -> list[str]:
    """The overrides of a run as its record has them."""
    return ["+exp=crowd", f"model={model}", f"scene={scene}", f"seed={seed}"]


def record(model: str, scene: str, seed: int) -> dict[str, Any]:
    """A record of a run that ended well, in plain JSON."""
    noise = (seed * 37 + len(model) * 11 + len(scene)) % 100 / 100
    metrics = dict.fromkeys(METRICS, 0.5 + noise) | {"psnr": 28 + noise, "lpips_vgg": None, "psnr_best_on_test": None}
    config = {"seed": seed, "all": asdict(Config())}
    versions = {"python": "3.11.7", "torch": "2.13.0"}
    ended = Record(
        status="ok", reason=None, experiment="crowd", model=model, scene=scene, dataset="crowd", seed=seed,
        effects=Effects(model[0] in "47", model[0] in "67", model == "7dgs"),
        protocol={"name": "gsbench", "background": "black", "downscale": 2, "eval_split": "test", "quantise": False,
                  "resolution": "400x400", "backend": "cpu", "paper_dataset": None},
        provenance=Provenance("0" * 40, versions, "EPYC", 4, config, "c" * 64, "d" * 64, "2026-11-22T00:00:00+00:00"),
        metrics=metrics, missing={"lpips_vgg": "no trunk weights", "psnr_best_on_test": "it leaks"},
        per_view=[ViewScore(f"r_{i}", 28 + noise + i / 10, 28.0, 0.9, 0.1) for i in range(20)],
        cost=Cost(600 + noise, {"slice": 300, "raster": 300}, RenderTimes(1.0, 2.0, 3.0), 500.0, 10**5, 10**7, 10**8),
        curve=[Point(1500 * (i + 1), 30.0 * i, 20 + i / 3) for i in range(20)],
    )  # fmt: skip
    return asdict(replace(ended, overrides=overrides(model, scene, seed)))


def write(count: int, results: Path, started: float | None = None) -> Path:
    """Write the sweep into `results`/crowd and return that folder."""
    experiment = results / "crowd"
    planned = Plan("local", [overrides(*run) for run in runs(count)], host="elsewhere", started=started or time.time())
    at_plan = experiment / plan.FOLDER / "2026-11-22_00-00-00.000000"
    plan.write(planned, at_plan)
    (at_plan / plan.ENDED).mkdir()
    for number, run in enumerate(runs(count)):
        model, scene, seed = run
        folder = experiment / scene / model / f"seed{seed}"
        folder.mkdir(parents=True)
        if number % UNFINISHED:
            (folder / "record.json").write_text(json.dumps(record(*run), default=str))
            outcome = Ended(str(folder.relative_to(results) / "record.json"), None)
            (at_plan / plan.ENDED / f"{number}.json").write_text(json.dumps(asdict(outcome)))
        else:
            at = Progress(
                overrides(*run), host="elsewhere", pid=1, born=1, job=None, step=100, steps=30_000, seconds=9.0
            )
            (folder / PROGRESS).write_text(json.dumps(asdict(at)))
    return experiment


if __name__ == "__main__":
    print(write(int(sys.argv[1]), Path(sys.argv[2])))

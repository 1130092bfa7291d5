"""Time frames of finished runs in turns, so that what else the machine does meets all of them alike.

python -m benchmarks.frames RUN_FOLDER RUN_FOLDER [..] [--data-root PATH] [--count 200]

All are rendered at the test views of the first run's scene, at native size, on one thread; the first is compared with.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import torch

from gsbench.errors import InputError
from gsbench.measure.speed import time_in_turns
from gsbench.models.render import render
from gsbench.run.load import LoadedRun, load_run, scene_of
from gsbench.scenes import View


def frames_of(run: LoadedRun, views: list[View]) -> Callable[[int], object]:
    """Render frame i of a run's model."""
    background = torch.tensor(run.scene.background)

    @torch.no_grad()
    def frame(i: int) -> object:
        view = views[i % len(views)]
        return render(run.model, view.camera, view.time, background)

    return frame


def main(arguments: list[str] | None = None) -> int:
    """Print for each run its Gaussians, median milliseconds, bytes, and both as shares of the first run's."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.frames", description=__doc__.partition("\n")[0])
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN_FOLDER")
    parser.add_argument("--data-root", help="where the data set is now")
    parser.add_argument("--count", type=int, default=200, help="frames of each run")
    asked = parser.parse_args(arguments)
    torch.set_num_threads(1)
    try:
        runs = [load_run(folder) for folder in asked.runs]
        views = scene_of(runs[0], asked.data_root).test
    except InputError as error:
        print(f"benchmarks.frames: {error}", file=sys.stderr)
        return 2
    times = time_in_turns([frames_of(run, views) for run in runs], asked.count)
    sizes = [run.model.stored_bytes() for run in runs]
    for run, time, size in zip(runs, times, sizes, strict=True):
        print(
            f"{run.folder}: {len(run.model)} Gaussians, {time.p50:.3f} ms ({time.p50 / times[0].p50:.2f}), "
            f"{size / 1e6:.3f} MB ({size / sizes[0]:.2f})"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())

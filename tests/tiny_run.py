"""A run small enough for a test: a data set of a few pixels, a config of a few steps, the command line around it."""

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from forked import ENVIRONMENT, python_m

if TYPE_CHECKING:
    from gsbench.measure.record import Record
    from gsbench.run.identity import RunSpec

ROOT = Path(__file__).resolve().parents[1]
SIZE = 16
COUNTS = {"train": 6, "val": 2, "test": 2}


def write_moving_square(root: Path, name: str = "square") -> Path:
    """Write a data set with one scene, a white square that moves with time, seen from cameras on a circle."""
    import json

    for split, count in COUNTS.items():
        frames = []
        for i in range(count):
            time, angle = i / (count - 1), 2 * np.pi * i / count
            image = np.zeros((SIZE, SIZE, 4), np.uint8)
            left = 3 + round(5 * time)
            image[5:11, left : left + 5] = 255
            path = root / name / split / f"r_{i}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(path), image)
            c, s = np.cos(angle), np.sin(angle)
            matrix = [[c, 0, s, 4 * s], [0, 1, 0, 0], [-s, 0, c, 4 * c], [0, 0, 0, 1]]
            frames.append({"file_path": f"./{split}/r_{i}", "time": time, "transform_matrix": matrix})
        content = {"camera_angle_x": 0.7, "frames": frames}
        (root / name / f"transforms_{split}.json").write_text(json.dumps(content))
    return root


def overrides(data: Path, results: Path, *more: str) -> list[str]:
    """The overrides of a run of 30 steps on that data set."""
    return [
        *("+exp=dnerf", f"data.root={data}", "data.scenes=[square]", "data.initial_points=40"),
        *("scene=custom", "scene.name=square", "scene.downscale=1"),
        *("train.iterations=30", "train.batch_size=2", "train.curve_points=2", f"results={results}", *more),
    ]


def environment() -> dict[str, str]:
    """That of a process which shares the machine with other tests."""
    return os.environ | ENVIRONMENT


def command(*arguments: str) -> list[str]:
    """`python -m gsbench` with arguments."""
    return [sys.executable, "-m", "gsbench", *arguments]


def gsbench(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the command line to its end."""
    return python_m("gsbench", *arguments)


def main_here(*arguments: str) -> int:
    """Run the command line in this process, as if it were a new one; return its exit status."""
    from hydra.core.global_hydra import GlobalHydra

    from gsbench.__main__ import run_command
    from gsbench.run.stop import SIGNALS

    argv, handlers = sys.argv, {number: signal.getsignal(number) for number in SIGNALS}
    GlobalHydra.instance().clear()
    sys.argv = ["gsbench", *arguments]
    try:
        return run_command([*arguments])
    except SystemExit as end:
        return int(end.code or 0)
    finally:
        sys.argv = argv
        for number, handler in handlers.items():
            signal.signal(number, handler)
        GlobalHydra.instance().clear()


def spec_of(words: Sequence[str]) -> "RunSpec":
    """Name a run as the command line does."""
    from gsbench.launch.command import compose_run, hydra_with
    from gsbench.run.identity import identify

    with hydra_with(None):
        run = compose_run(words)
        return identify(run.config, run.choices, run.overrides)


def run_here(*words: str) -> tuple["Record", Path]:
    """Do one run in this process, which costs no start of another one; return its record and its folder."""
    from gsbench.run.execution import execute

    spec = spec_of(words)
    record = execute(spec)
    assert record is not None
    return record, spec.folder

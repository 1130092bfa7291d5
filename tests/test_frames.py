"""What FPS is measured on: replayed frames where a GPU can record them."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from gsbench.kernels.backends import CPU, CUDA, Backend
from gsbench.run import measuring
from gsbench.scenes.scene import Camera, View
from gsbench.train.renderer import Renderer

VIEW = View("test/r_0", Camera(torch.eye(4), torch.eye(3), 5, 4), 0.4, torch.zeros(4, 5, 3))


def trainer(backend: Backend) -> Any:
    model, renderer = SimpleNamespace(backend=backend), Renderer(torch.zeros(3), antialias=False)
    return SimpleNamespace(model=model, renderer=renderer, render=lambda _: "launched")


class Recorded:
    """Stands for `GraphedFrames`, which needs a GPU."""

    def __init__(self, *_: Any) -> None: ...

    def __call__(self, *_: Any) -> str:
        return "replayed"


class Refused(Recorded):
    def __call__(self, *_: Any) -> str:
        raise RuntimeError("operation not permitted when stream is capturing\nmore")


@pytest.mark.parametrize(
    ("backend", "replay", "frames"), [(CPU, Recorded, None), (CUDA, Recorded, "replayed"), (CUDA, Refused, "launched")]
)
def test_the_record_says_which_frames_are_timed(backend, replay, frames, monkeypatch, capsys):
    """Catches a protocol that speaks of replays on a CPU, a finished training lost to a model that waits for the
    device, and an FPS that hides how it was made."""
    monkeypatch.setattr(measuring, "GraphedFrames", replay)
    frame, recorded = measuring.frames(trainer(backend), VIEW)
    assert (frame(VIEW), recorded) == (frames or "launched", {"frames": frames} if frames else {})
    warning = "cannot record this model: operation not permitted when stream is capturing\n"
    assert (warning in capsys.readouterr().err) == (replay is Refused)

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


def test_on_a_cpu_frames_are_launched() -> None:
    """Catches a protocol that speaks of replays where there are none."""
    frame, frames = measuring.frames(trainer(CPU), VIEW)
    assert (frame(VIEW), frames) == ("launched", {})


@pytest.mark.parametrize(("replay", "frames"), [(Recorded, "replayed"), (Refused, "launched")])
def test_on_a_gpu_the_record_says_which(
    replay: type[Recorded], frames: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a finished training lost to a model that waits for the device, and an FPS that hides how it was made."""
    monkeypatch.setattr(measuring, "GraphedFrames", replay)
    frame, text = measuring.frames(trainer(CUDA), VIEW)
    assert (frame(VIEW), text) == (frames, {"frames": frames})
    text = capsys.readouterr().err
    assert ("cannot record this model: operation not permitted when stream is capturing\n" in text) == (
        frames == "launched"
    )

"""Replayed renders against launched ones: on a GPU as a CUDA graph, by the shim as a call that is made again."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from benchmarks.scene import camera as benchmark_camera
from benchmarks.scene import model
from gsbench.errors import InputError
from gsbench.kernels.backends import CUDA, REFERENCE
from gsbench.kernels.raster import RasterInputs, Viewport, enqueue
from gsbench.models import CameraTime, GaussianModel
from gsbench.models.render import GraphedFrames, render
from gsbench.raster import EPS2D, FAR, NEAR
from gsbench.scenes.scene import Camera

BACKGROUND = (0.1, 0.5, 0.9)


def camera(device: str, distance: float = 4.0, size: int = 40) -> Camera:
    viewmats, Ks = benchmark_camera(size)
    viewmats[0, 2, 3] = distance
    return Camera(viewmats[0], Ks[0], size, size - 3).to(device)


def called_again(call: Callable[[], Any]) -> tuple[Callable[[], None], Any]:
    """`render.capture` where there is no GPU: its results are overwritten, as a graph's are."""
    results = call()

    def play() -> None:
        for old, new in zip(results, call(), strict=True):
            old.copy_(new)

    return play, results


@pytest.fixture
def device(cuda_device: str, monkeypatch: pytest.MonkeyPatch) -> str:
    if cuda_device == "cpu":
        monkeypatch.setattr("gsbench.models.render.capture", called_again)
        monkeypatch.setattr("gsbench.models.render.resolve", lambda *_: CUDA)
    return cuda_device


def large(name: str, device: str, agr: bool = False) -> GaussianModel:
    """A model whose Gaussians cover each other in a small picture."""
    return model(name, 300, agr=agr, sigma=0.2).to(device)


def both(
    device: str, name: str, agr: bool = False
) -> tuple[GaussianModel, GraphedFrames, Callable[[Camera, float], Tensor]]:
    fitted, background = large(name, device, agr), torch.tensor(BACKGROUND, device=device)

    def launched(camera: Camera, time: float) -> Tensor:
        with torch.no_grad():
            return render(fitted, camera, time, background)

    return fitted, GraphedFrames(fitted, background), launched


@pytest.mark.parametrize(("name", "agr"), [("3dgs", False), ("4dgs", False), ("6dgs", True), ("7dgs", True)])
def test_replays_are_what_is_launched(name, agr, device):
    """Catches a camera, a time or a parameter that is read when a picture is recorded, and not when it is replayed."""
    fitted, replayed, launched = both(device, name, agr)
    for distance, time in ((4.0, 0.4), (4.5, 0.1), (3.9, 0.9)):
        at = camera(device, distance)
        torch.testing.assert_close(replayed(at, time), launched(at, time), rtol=0, atol=1e-4)
    with torch.no_grad():
        fitted.splats["means"].mul_(0.8)
        fitted.splats["opacities"].add_(0.5)
    torch.testing.assert_close(replayed(at, 0.9), launched(at, 0.9), rtol=0, atol=1e-4)


def test_replays_of_beta_profiles(device, monkeypatch):
    """Catches a replay that draws Gaussians where the slice has exponents, or ones of the wrong camera."""
    fitted, replayed, launched = both(device, "3dgs")
    gaussians, at = launched(camera(device), 0.4), fitted.slice
    exponents = torch.linspace(0.1, 6.0, 300, device=device)
    monkeypatch.setattr(fitted, "slice", lambda query: at(query)._replace(beta_exponents=exponents))
    for distance in (4.0, 4.5):
        view = camera(device, distance)
        torch.testing.assert_close(replayed(view, 0.4), launched(view, 0.4), rtol=0, atol=1e-4)
    assert (launched(camera(device), 0.4) - gaussians).abs().max() > 0.1


def test_more_pairs_than_there_is_room_for(device):
    """Catches Gaussians that are left out because a picture recorded from afar had few pairs of tiles and Gaussians."""
    _, replayed, launched = both(device, "7dgs")
    for distance in (30.0, 2.5, 1.5):
        near = camera(device, distance, size=90)
        torch.testing.assert_close(replayed(near, 0.4), launched(near, 0.4), rtol=0, atol=1e-4)
    assert len(replayed._recordings) == 1
    small = camera(device)
    torch.testing.assert_close(replayed(small, 0.4), launched(small, 0.4), rtol=0, atol=1e-4)


def test_a_bad_value_is_named(device):
    """Catches a picture of NaN: replays do not go through the rasterizer's door."""
    fitted, replayed, _ = both(device, "4dgs")
    replayed(camera(device), 0.4)
    with torch.no_grad():
        fitted.splats["means"][7] = torch.nan
    with pytest.raises(InputError, match="means: expected finite"):
        replayed(camera(device), 0.4)


@pytest.mark.parametrize("room", [0, 1, 40])
@pytest.mark.parametrize("N", [0, 300])
def test_too_little_room_is_counted(N, room, device):
    """Catches a pair written past the end of the lists, and an image with too few of them that looks good."""
    at, fitted = camera(device), large("4dgs", device)
    with torch.no_grad():
        means, factors, opacities, colors, _ = fitted.slice(CameraTime.at(at.center, 0.4))
        gaussians = (means[:N], factors[:N], opacities[:N], colors[None, :N])
        inputs = RasterInputs(*gaussians, at.viewmat[None], at.K[None], torch.tensor(BACKGROUND, device=device))
        drawing = enqueue(inputs, Viewport(at.width, at.height, NEAR, FAR, EPS2D, antialias=False), room)
    pairs, flags = drawing.needed.tolist()
    assert flags == 0
    bad = ~drawing.image.isfinite()
    assert bad.sum() == bad[0, 0, 0, 0] == (pairs > room)
    assert (pairs > 40) == (N > 0)


def test_only_the_cuda_backend_is_replayed():
    """Catches a graph asked for where nothing records one."""
    with pytest.raises(InputError, match=r"expected raster\.backend=cuda, got 'reference'"):
        GraphedFrames(model("3dgs", 5, backend=REFERENCE), torch.zeros(3))

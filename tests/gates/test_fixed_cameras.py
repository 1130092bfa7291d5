"""Whether a scene changes with time, asked of cameras that stand still, where images of one place are compared."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from worlds import appearing, brightening, camera, filmed, moving, rigged, small_mover, still

from gsbench.gates import fixed_camera_test
from gsbench.gates.screen import screen_time
from gsbench.gates.shared_viewpoints import group_by_viewpoint
from gsbench.scenes.scene import Scene

Exposure = Callable[[Tensor, float], Tensor]


def noisy(exposure: Exposure | None = None, size: float = 0.02) -> Exposure:
    """Sensor noise, of what `exposure` makes of an image."""
    random = torch.Generator().manual_seed(3)
    return lambda image, t: (
        (exposure(image, t) if exposure else image) + size * torch.randn(image.shape, generator=random)
    )


def drifting(image: Tensor, moment: float) -> Tensor:
    """An exposure that rises from 0.8 to 1.2, which saturates what is bright, and a white balance that wanders."""
    return image * torch.tensor([0.8 + 0.4 * moment, 0.8 + 0.4 * moment, 0.9 + 0.2 * moment])


def flickering(image: Tensor, moment: float) -> Tensor:
    """A lamp that is brighter in some images than in others."""
    return image * (1 + 0.2 * math.sin(997 * moment))


def darkening(image: Tensor, moment: float) -> Tensor:
    """A patch of 1 % of the frame that moves in front of the still world."""
    image = image.clone()
    column = int(36 * moment)
    image[18:22, column : column + 4] *= 0.5
    return image


@pytest.mark.parametrize("exposure", [None, noisy(), drifting, flickering, noisy(drifting), noisy(flickering)])
def test_exposure_is_no_change(exposure):
    """Catches noise, rounding to 8 bits, an exposure that drifts (and saturates) or flickers, taken for a change; and
    a gain and an offset that take a mover out with the exposure."""
    still_rig = screen_time(rigged(still, exposure=exposure))
    assert still_rig.decision == "off", still_rig
    assert "exposure and noise only" in still_rig.reason
    if exposure not in (None, drifting, flickering):
        assert screen_time(rigged(moving, exposure=exposure)).decision == "on"
        assert screen_time(rigged(small_mover, exposure=exposure)).decision == "on"


@pytest.mark.parametrize("world", [moving, small_mover, brightening])
@pytest.mark.parametrize(
    ("places", "views", "together"), [(6, 8, False), (4, 12, False), (6, 16, True), (4, 70, False)]
)
def test_a_rig_sees_motion(world, places, views, together):
    """Catches "off" or "undecided" on a rig, one of four cameras, one whose cameras fire together, or one with so many
    views that only some of them are compared: their times must be those of these views."""
    screen = screen_time(rigged(world, places, views, together=together))
    assert screen.decision == "on", screen
    assert screen.p is not None
    assert screen.free is None


def _mixed(fixed: Scene, loose: Scene) -> Scene:
    return replace(loose, train=fixed.train + loose.train)


def _shuffled(scene: Scene) -> Scene:
    order = torch.randperm(len(scene.train), generator=torch.Generator().manual_seed(5)).tolist()
    return replace(scene, train=[replace(v, time=scene.train[i].time) for v, i in zip(scene.train, order, strict=True)])


@pytest.mark.parametrize(
    ("scene", "decisions", "reason"),
    [
        # What is rare (no slow wave is left) or moves in 1 % of the frame is never called static.
        (lambda: rigged(appearing), ("on", "undecided"), ""),
        (lambda: rigged(appearing, exposure=noisy()), ("on", "undecided"), ""),
        (lambda: rigged(still, exposure=noisy(darkening)), ("on", "undecided"), ""),
        (lambda: rigged(appearing, views=3), ("on", "undecided"), ""),
        (lambda: rigged(moving, views=2), ("on", "undecided"), ""),
        (lambda: rigged(moving, 4, 4), ("on", "undecided"), ""),
        (lambda: rigged(small_mover, 8, 3), ("on", "undecided"), ""),
        (lambda: _shuffled(rigged(moving)), ("undecided",), "differ"),  # images of one place differ, by no slow wave
        # Captures of standing and of wandering cameras are judged by both kinds.
        (lambda: _mixed(rigged(moving, 4, 12), filmed(moving, 36)), ("on",), "together p"),
        (lambda: _mixed(rigged(still, 3, 6, exposure=noisy()), filmed(still, 48)), ("off",), ""),
        (lambda: _mixed(rigged(still, 3, 6), filmed(moving, 36)), ("on",), ""),
        (lambda: _mixed(rigged(moving, 3, 6), filmed(still, 24, orbit=True)), ("on", "undecided"), ""),
        # Cameras held in the hand: each place has a misfit of its own, which nine harmonics of the camera do not fit.
        (lambda: rigged(moving, 6, 10, shake=0.005), ("on", "undecided"), ""),
        (lambda: rigged(still, 6, 10, shake=0.005), ("undecided",), ""),
    ],
)
def test_hard_cases(scene, decisions, reason):
    """Catches a scene that is called static though it may change, and a test that ignores a part of the views."""
    screen = screen_time(scene())
    assert screen.decision in decisions, screen
    assert reason in screen.reason


@pytest.mark.parametrize(("times_noise", "changes"), [(22, True), (18, False)])
def test_a_block_changes_by_twenty_times_its_noise(times_noise, changes):
    """Catches another threshold: of `wave` w and `noise` n, the energies are 2 (w^2 - n^2) and 4 n^2."""
    noise = 0.01 * np.array([1.0, -1.0])
    wave = noise * math.sqrt(2 * times_noise + 1)
    first, second = (np.float32(half)[:, None, None] for half in (wave + noise, wave - noise))
    halves = np.broadcast_to(np.stack([first, second]), (2, 2, 5, 3))
    assert (fixed_camera_test._changed_blocks(halves) == changes).all()


@pytest.mark.parametrize("together", [False, True])
def test_the_level_on_rigs(together, monkeypatch):
    """Catches permutations that break what cameras see together, as a flicker for all, and a black camera: 0 / 0."""
    monkeypatch.setattr(fixed_camera_test, "PERMUTATIONS", 199)
    random = np.random.default_rng(0)
    times = [np.linspace(0, 1, 8) if together else np.sort(random.random(8)) for _ in range(6)]
    patterns = [random.standard_normal(30) for _ in times]
    low = 0
    for k in range(300):
        light = random.standard_normal(8)
        means = []
        for pattern in patterns:
            brightness = light if together else random.standard_normal(8)
            images = np.outer(brightness, pattern) + 0.3 * random.standard_normal((8, 30))
            means.append(images - images.mean(0))
        low += fixed_camera_test._test_slow_change(means, times, k)[0] <= 0.05
    blind = fixed_camera_test._test_slow_change([*means, np.zeros((8, 30))], [*times, times[0]], k)
    assert blind == fixed_camera_test._test_slow_change(means, times, k)
    assert low / 300 == pytest.approx(0.05, abs=0.035)


@pytest.mark.parametrize(("width", "height"), [(24, 48), (48, 24)])
def test_a_shift_is_one_of_the_longer_side(width, height):
    """Catches shifts in units of the width alone: in a portrait image they would be twice as large, and no camera held.
    A camera that turns around the scene by a moves by sqrt(2) a f / side in these units, here by 0.045 of at most
    0.05."""
    scene, K = rigged(still, 4, 3), torch.tensor([[57.6, 0.0, width / 2], [0.0, 57.6, height / 2], [0.0, 0.0, 1.0]])
    angle = 0.045 * 48 / 57.6 / math.sqrt(2)
    turned = [
        replace(
            view, camera=replace(camera(azimuth + angle * moment, 0.2), K=K, width=width, height=height), time=moment
        )
        for azimuth in (0.0, 1.5, 3.0, 4.5)
        for view, moment in zip(scene.train, (0.0, 0.5, 1.0), strict=False)
    ]
    assert [len(place) for place in group_by_viewpoint(turned, scene.extent).held] == [3] * 4


def test_viewpoints_are_those_of_the_cameras():
    """Catches viewpoints that are split by rounding, or joined though the lens differs; a film has none."""
    shaken = rigged(still, 6, 10, shake=0.005)
    viewpoints = group_by_viewpoint(shaken.train, shaken.extent)
    assert len(viewpoints.held) == 6
    assert viewpoints.loose == list(range(60))
    scene = rigged(still, 4, 4)
    random = torch.Generator().manual_seed(0)
    train = [
        replace(v, camera=replace(v.camera, viewmat=v.camera.viewmat + 1e-6 * torch.randn(4, 4, generator=random)))
        for v in scene.train
    ]
    assert sorted(map(len, group_by_viewpoint(train, scene.extent).fixed)) == [4] * 4
    lens = torch.tensor([[1.1], [1.1], [1.0]])
    zoomed = [replace(v, camera=replace(v.camera, K=v.camera.K * lens)) if v.time > 0.5 else v for v in train]
    assert sorted(map(len, group_by_viewpoint(zoomed, scene.extent).fixed)) == [2] * 8
    for orbit in (False, True):
        film = filmed(still, 60, orbit=orbit)
        before = [view for view in film.train if view.time < 1]  # an orbit ends where it began
        assert len(group_by_viewpoint(before, film.extent).other) == 59


def test_a_channel_with_too_few_pixels_has_the_gain_of_the_others():
    """Catches a mean over all channels, also those that were fitted to nothing."""
    values = np.float32([[[2.0], [4.0], [9.0]], [[5.0], [6.0], [7.0]]])
    enough = np.array([[[True], [True], [False]], [[False], [False], [False]]])
    shared = fixed_camera_test._shared(values, enough, 1.0)
    np.testing.assert_array_equal(shared[..., 0], [[2, 4, 3], [1, 1, 1]])

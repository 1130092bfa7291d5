"""Whether a scene changes with time, asked of scenes whose answer is known."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from worlds import World, brightening, filmed, moving, small_mover, still

from gsbench.errors import InputError
from gsbench.gates import __main__ as command
from gsbench.gates import permutation_test, screen, static_fit_residuals
from gsbench.gates.permutation_test import follow_time
from gsbench.gates.screen import screen_time
from gsbench.models.gaussian_batch import Gaussians3D
from gsbench.scenes.scene import Scene

EMBEDDED = Path(__file__).resolve().parents[2] / "gsbench/scenes/sample"


@pytest.mark.parametrize(
    ("world", "decision"), [(still, "off"), (moving, "on"), (small_mover, "on"), (brightening, "on")]
)
def test_known_worlds(world: World, decision: str) -> None:
    """Catches a test that finds time in a static scene, or misses motion in 2 % of the image or light that changes."""
    found = screen_time(filmed(world))
    assert found.decision == decision, found
    assert found.free is not None
    assert found.free > 0.7


def test_imports_are_no_seconds_of_the_screen() -> None:
    """Catches a screen that is charged for what torch imports with a process's first optimizer, once 1.1 s of 1.5."""
    code = """
import sys, time
from worlds import filmed, still
from gsbench.gates.screen import screen_time
clock, loaded = time.perf_counter, []
time.perf_counter = lambda: (loaded.append(set(sys.modules)), clock())[1]
screen_time(filmed(still))
print(len([name for name in loaded[-1] - loaded[0] if name.startswith("torch._dynamo")]))
"""
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    environment = os.environ | {"PYTHONPATH": path}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert done.stdout == "0\n", done.stderr


def test_shuffled_times_are_no_time() -> None:
    """Catches a test that sees motion wherever images differ: at shuffled times nothing is slow."""
    shuffled = torch.randperm(48, generator=torch.Generator().manual_seed(5)) / 47
    assert screen_time(filmed(moving, times=shuffled)).decision == "off"


def test_flicker_that_is_not_slow_is_no_time() -> None:
    """Catches a test of brightness instead of slow waves: a light that jumps from view to view cannot be fitted."""
    jumps = torch.rand(48, generator=torch.Generator().manual_seed(2))
    moments = iter(jumps.tolist())

    def flicker(_: float) -> Gaussians3D:
        world = still(0.0)
        return world._replace(colors=world.colors * (0.5 + next(moments)))

    assert screen_time(filmed(flicker)).decision == "off"


def test_an_orbit_decides_nothing() -> None:
    """Catches an answer where the camera moves along with time, so that either may explain the images."""
    for world in (still, moving):
        found = screen_time(filmed(world, orbit=True))
        assert found.decision == "undecided"
        assert found.free is not None
        assert found.free < screen.LEAST_FREE
        assert "camera moves along" in found.reason


def test_what_is_too_little_to_tell() -> None:
    """Catches a verdict from few views, from one time, or from none."""
    few, one = filmed(moving, views=8), filmed(moving, views=16, times=torch.full((16,), 0.5))
    assert screen_time(few).decision == "undecided"
    assert "too few" in screen_time(few).reason
    assert screen_time(one).decision == "undecided"
    assert "the same time" in screen_time(one).reason
    timeless = Scene(**{**vars(one), "train": [type(v)(**{**vars(v), "time": None}) for v in one.train]})
    assert screen_time(timeless).decision == "off"
    with pytest.raises(InputError, match="expected training views"):
        screen_time(Scene(**{**vars(one), "train": []}))


def test_the_level_of_the_test(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a permutation test that is wrong too often: leftovers that only the camera explains."""
    monkeypatch.setattr(permutation_test, "PERMUTATIONS", 199)
    random = np.random.default_rng(0)
    camera = random.standard_normal((40, 9))
    gradients = camera @ random.standard_normal((9, 50)) * 3 + random.standard_normal((40, 50))
    deals = [follow_time(gradients @ gradients.T, random.permutation(40) / 39, camera, k).p for k in range(300)]
    assert np.mean(np.array(deals) <= 0.05) == pytest.approx(0.05, abs=0.035)
    assert np.mean(np.array(deals) <= 0.01) <= 0.027


@pytest.mark.parametrize(("wave", "found"), [(1, True), (2, True), (3, True), (4, True), (5, False)])
def test_the_waves_that_are_looked_for(wave: int, found: bool) -> None:
    """Catches a constant among the slow waves in place of the fastest, and faster ones: cos(pi k t), k = 1 to 4."""
    times = (np.arange(40) + 0.5) / 40
    gradients = np.cos(np.pi * wave * times)[:, None] + 0.1 * np.random.default_rng(0).standard_normal((40, 20))
    p = follow_time(gradients @ gradients.T, times, np.ones((40, 1)), 0).p
    assert p == 0.001 if found else p > 0.05


def test_the_answer_is_that_of_its_seed() -> None:
    """Catches a draw that is not the seed's."""
    scene = filmed(moving, views=16)
    first, second = screen_time(scene, 3), screen_time(scene, 3)
    assert (first.p, first.z, first.free) == (second.p, second.z, second.free)


def test_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a command whose JSON is not what the page promises, and bad input that ends in a stack trace."""
    assert command.main([str(EMBEDDED / "moving-matte"), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)["time"]
    assert answer["decision"] == "on"
    assert answer["p"] == 0.001
    assert answer.keys() >= {"z", "free", "seconds", "reason"}
    for wrong in ([], ["/nowhere"], ["x", "--checkpoint", "y"], ["--checkpoint", "/nowhere"],
                  ["x", "--budget-db", "nan"], ["--picture", "y", "--out", ""], ["--picture", "y", "--out", "a\0b"],
                  ["x", "--seed", "-1"], ["x", "--seed", str(2**63)], ["x", "--seed", "9" * 5000]):  # fmt: skip
        assert command.main(wrong) == 2
        assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.slow
def test_five_hundred_views_take_no_more_than_their_share(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a screen that draws the views of a long film more often: a fit of the same steps, and each view once."""
    drawn = []
    draw = static_fit_residuals.rasterize_slice
    monkeypatch.setattr(static_fit_residuals, "rasterize_slice", lambda *x: drawn.append(1) or draw(*x))
    counts = {}
    for views in (100, 500):
        drawn.clear()
        assert screen_time(filmed(moving, views=views)).decision == "on"
        counts[views] = len(drawn)
    assert counts[500] - counts[100] == 400

"""Whether a scene changes with time, asked of scenes whose answer is known."""

import json
import os
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from forked import python
from worlds import brightening, filmed, moving, small_mover, still

from gsbench import scenes
from gsbench.errors import InputError
from gsbench.gates import __main__ as command
from gsbench.gates import permutation_test, static_fit_residuals
from gsbench.gates.messages import lines, of_comparison, of_screen
from gsbench.gates.permutation_test import follow_time
from gsbench.gates.screen import LEAST_FREE, screen_time
from gsbench.measure.record import Candidate, Direction, Gate, ModelComparison, OnDemand, TimeScreen
from gsbench.models.gaussian_batch import Gaussians3D
from gsbench.scenes.scene import Camera, Points, Scene, View

EMBEDDED = Path(__file__).resolve().parents[2] / "gsbench/scenes/sample"
SHUFFLED = torch.randperm(48, generator=torch.Generator().manual_seed(5)) / 47


def flickering() -> Scene:
    """A still world under a light that jumps from view to view, which no static fit can follow."""
    jumps = iter(torch.rand(48, generator=torch.Generator().manual_seed(2)).tolist())

    def world(_: float) -> Gaussians3D:
        return still(0.0)._replace(colors=still(0.0).colors * (0.5 + next(jumps)))

    return filmed(world)


def timeless() -> Scene:
    scene = filmed(moving, views=16)
    return replace(scene, train=[replace(view, time=None) for view in scene.train])


@pytest.mark.parametrize(
    ("scene", "decision", "reason"),
    [
        (lambda: filmed(still), "off", "does not change over time"),
        (lambda: filmed(moving), "on", "changes over time"),
        (lambda: filmed(small_mover), "on", "changes over time"),
        (lambda: filmed(brightening), "on", "changes over time"),
        (lambda: filmed(moving, times=SHUFFLED), "off", "does not change over time"),  # nothing is slow
        (flickering, "off", "does not change over time"),
        (lambda: filmed(still, orbit=True), "undecided", "camera moves along"),
        (lambda: filmed(moving, orbit=True), "undecided", "camera moves along"),
        (lambda: filmed(moving, views=11), "undecided", "11 training views are too few; 12 are needed"),
        (lambda: filmed(moving, views=12), "undecided", "camera moves along"),  # enough to be asked
        (lambda: filmed(moving, views=16, times=torch.full((16,), 0.5)), "undecided", "the same time"),
        (timeless, "off", "no times"),
    ],
)
def test_known_scenes(scene, decision, reason):
    """Catches time in a static scene, motion in 2 % of the image or slow light that is missed, a test of brightness
    instead of slow waves, and an answer where the camera moves along with time or there is too little to say."""
    screen = screen_time(scene())
    assert screen.decision == decision, screen
    assert reason in screen.reason
    if reason == "changes over time":  # the answer is that of its seed
        assert replace(screen, seconds=0) == replace(screen_time(scene()), seconds=0)
    if "over time" in reason:
        assert screen.free > 0.7
    elif "camera" in reason:
        assert screen.free < LEAST_FREE
    else:
        assert screen.p is None


def test_a_scene_without_views_is_refused():
    """Catches a stack trace where a split is empty."""
    with pytest.raises(InputError, match="expected training views"):
        screen_time(replace(timeless(), train=[]))


@pytest.mark.parametrize(("decision", "kept"), [("on", ""), ("undecided", ", so time is kept"), ("off", "")])
def test_the_answer_in_words(decision, kept):
    """Catches time that is said to be kept where it is not."""
    assert of_screen(TimeScreen(decision, "why", None, None, None, 0.0)) == f"time is {decision}{kept}: why"


def test_no_change_has_no_sign():
    """Catches a change of PSNR by "-0.00 dB"."""
    (line,) = lines(OnDemand(direction=Direction(kept=0.25, loss_db=0.001, frame_ms=2.0, frame_ms_without=1.5)))
    assert "PSNR would change by 0.00 dB" in line


def test_a_gate_in_words():
    """Catches removed Gaussians that count as left, and a loss in PSNR that reads as a gain."""
    rows = {"refined": 1, "conditioned": 2, "static": 3, "removed": 4}
    gate = Gate(0.1, 0.1, 0.01, rows, {}, 3_000_000, 1_000_000, 100, "val", 0.0, 0.02, 2.0, 1.0, 0.5)
    direction = Direction(kept=0.25, loss_db=0.1, frame_ms=2.0, frame_ms_without=1.5)
    assert lines(OnDemand(gates=[gate, Gate(0.1, 0.1, -0.01, {"static": 3}, {}, 1, 1)], direction=direction)) == [
        "gate after step 100: 6 of 10 Gaussians are left (1 refined by AGR, 2 conditioned, 3 static); PSNR on val "
        "-0.010 dB, on the evaluated views -0.020 dB, a frame 2.00 -> 1.00 ms, 3.00 -> 1.00 MB; in a frame, 50% of "
        "AGR's Gaussians are invisible at its time and left out",
        "gate after training: 3 of 3 Gaussians are left (3 static); PSNR on val +0.010 dB, 0.00 -> 0.00 MB",
        "direction: 25% of the Gaussians depend on it; if none did, PSNR would change by -0.10 dB and a frame from "
        "2.00 to 1.50 ms",
    ]


def test_directions_of_cameras_side_by_side():
    """By hand: two cameras 2 apart that look along z, seen from 3 in front. Catches a point behind them or beside."""
    poses = [torch.eye(4), torch.eye(4)]
    poses[0][0, 3], poses[1][0, 3] = 1, -1  # at x = -1 and x = 1
    views = [View("a", Camera(pose, torch.eye(3), 1, 1), 0.0, torch.zeros(1, 1, 3)) for pose in poses]
    basis = static_fit_residuals.camera_basis(views)
    expected = 0.48860251 / np.sqrt(10) * np.array([[0, -3, 1], [0, -3, -1]])  # -y, z, -x of the unit vectors
    np.testing.assert_allclose(basis[:, 1:4], expected, atol=1e-7)


@pytest.mark.parametrize(
    ("miss", "depth", "meets"), [(0.0, 4, True), (1.9, 4, True), (2.1, 4, False), (0.0, -4, False)]
)
def test_the_centre_is_where_optical_axes_nearly_meet(miss, depth, meets):
    """Catches a centre of cameras that look past each other, or away from it: each of two axes passes it at `miss`."""
    poses = [torch.eye(4), torch.tensor([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])]  # along z and x
    for pose, side in zip(poses, (1, -1), strict=True):
        pose[:3, 3] = torch.tensor([0.0, side * miss, depth])
    views = [View("a", Camera(pose, torch.eye(3), 1, 1), 0.0, torch.zeros(1, 1, 3)) for pose in poses]
    center = static_fit_residuals.center_of(views)
    assert (center is not None) == meets
    assert center is None or torch.allclose(center, torch.zeros(3), atol=1e-6)


def test_small_columns_count_as_large_ones():
    """Catches a threshold that is not relative to the largest singular value."""
    columns = torch.randn(8, 3, generator=torch.Generator().manual_seed(1)).double().numpy()
    columns = np.concatenate([columns, columns[:, :1]], axis=1)
    assert {permutation_test._range(scale * columns).shape for scale in (1e-9, 1.0, 1e9)} == {(8, 3)}
    assert permutation_test._range(0 * columns).shape == (8, 0)


def test_initial_points_of_a_fit_follow_the_seed():
    """Catches a random subset that is another one each time, and colours of other points."""
    means = torch.rand(2 * static_fit_residuals.POINTS, 3)
    scene = SimpleNamespace(points=Points(means, 1 - means))
    first, second = (static_fit_residuals.scene_points([], scene, torch.Generator().manual_seed(3)) for _ in range(2))
    assert len(first.means) == static_fit_residuals.POINTS
    assert torch.equal(first.means, second.means)
    assert torch.equal(first.colors, 1 - first.means)


def test_imports_are_no_seconds_of_the_screen():
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
    done = python("-c", code, env=os.environ | {"PYTHONPATH": path})
    assert done.stdout == "0\n", done.stderr


def test_the_level_of_the_test(monkeypatch):
    """Catches a permutation test that is wrong too often, of residuals that only the camera explains."""
    monkeypatch.setattr(permutation_test, "PERMUTATIONS", 199)
    random = np.random.default_rng(0)
    camera = random.standard_normal((40, 9))
    gradients = camera @ random.standard_normal((9, 50)) * 3 + random.standard_normal((40, 50))
    p = np.array([follow_time(gradients @ gradients.T, random.permutation(40) / 39, camera, k).p for k in range(300)])
    assert np.mean(p <= 0.05) == pytest.approx(0.05, abs=0.035)
    assert np.mean(p <= 0.01) <= 0.027


@pytest.mark.parametrize(("wave", "is_slow"), [(1, True), (2, True), (3, True), (4, True), (5, False)])
def test_the_waves_that_are_looked_for(wave, is_slow):
    """Catches a constant among the slow waves in place of the fastest, and faster ones: cos(pi k t), k = 1 to 4."""
    times = (np.arange(40) + 0.5) / 40
    gradients = np.cos(np.pi * wave * times)[:, None] + 0.1 * np.random.default_rng(0).standard_normal((40, 20))
    p = follow_time(gradients @ gradients.T, times, np.ones((40, 1)), 0).p
    assert p == 0.001 if is_slow else p > 0.05


def test_only_those_that_can_be_chosen_tie():
    """Catches a tie with a training that exceeds the budget, and one that is not told."""
    fast, slow = Candidate("3dgs", 30.0, 1.0), Candidate("7dgs", 30.0, 9.0, "9 ms a frame")
    assert "cannot decide" not in of_comparison(ModelComparison(7, "3dgs", [fast, slow]))
    tie = of_comparison(ModelComparison(7, "6dgs", [fast, Candidate("6dgs", 30.0, 2.0), slow]))
    assert "after 7 iterations: PSNR cannot decide between 3dgs, 6dgs, so the last of them is taken\n" in tie


def test_the_command(capsys):
    """Catches a command whose JSON is not what the page promises, another seed, and a stack trace for bad input."""
    assert command.main([str(EMBEDDED / "moving-matte"), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)["time"]
    assert answer["decision"] == "on"
    assert answer["p"] == 0.001
    assert answer.keys() >= {"z", "free", "seconds", "reason"}
    assert answer["z"] == screen_time(scenes.load(EMBEDDED / "moving-matte"), 0).z
    assert 0 < answer["seconds"] < 600
    for wrong, line in (
        ([], "expected one of"),
        (["x", "--checkpoint", "y"], "expected one of"),
        (["/nowhere"], "/nowhere"),
        (["--checkpoint", "/nowhere"], "/nowhere"),
        (["--checkpoint", "x", "--budget-db", "nan"], "--budget-db: expected a finite number"),
        (["x", "--data-root", "y"], "--data-root: expected none with SCENE_FOLDER"),
        (["--checkpoint", "x", "--seed", "1"], "--seed: expected none with --checkpoint"),
        *((["x", "--seed", seed], "--seed") for seed in ("-1", str(2**63), "9" * 5000)),
    ):
        assert command.main(wrong) == 2
        error = capsys.readouterr().err
        assert line in error
        assert error.count("\n") == 1


def test_a_long_film_takes_no_more_than_its_share(monkeypatch):
    """Catches a screen that draws the views of a long film more often: a fit of the same steps, and each view once."""
    drawn, counts = [], []
    draw = static_fit_residuals.rasterize_slice
    monkeypatch.setattr(static_fit_residuals, "rasterize_slice", lambda *x: drawn.append(1) or draw(*x))
    for views in (40, 90):
        drawn.clear()
        assert screen_time(filmed(moving, views=views)).decision == "on"
        counts.append(len(drawn))
    assert counts[1] - counts[0] == 50

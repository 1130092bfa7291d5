"""A scene is trained at a standard place and size, wherever it lies, and goes out in the user's coordinates."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from capture import Capture, circle
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tiny_run import overrides, run_here, write_moving_square
from tiny_scene import edit, write_image

from gsbench import load_run, load_scene
from gsbench.errors import InputError
from gsbench.export import main as export
from gsbench.scenes import Scene, sample
from gsbench.scenes.gaussian_ply import read_trained
from gsbench.scenes.placement import place_and_size
from gsbench.scenes.points import far_outside, size_of
from gsbench.scenes.scene import STANDARD, Points
from gsbench.view import video

COUNT = 16
MOVES = {
    "offset": (1.0, (100.0, 100.0, 0.0)),
    "kilometres": (1.0, (1000.0, 2000.0, 30.0)),
    "utm": (1.0, (431000.0, 5412000.0, 320.0)),
    "millimetres": (0.001, (0.0, 0.0, 0.0)),
    "odd unit": (0.003, (0.0, 0.0, 0.0)),
    "centimetres": (100.0, (0.0, 0.0, 0.0)),
    "all": (0.003, (30.0, -6.0, 1.2)),
}


def write_capture(
    root: Path,
    scale: float = 1.0,
    offset: tuple[float, ...] = (0, 0, 0),
    *,
    viewmats: np.ndarray | None = None,
    points: np.ndarray | None = None,
) -> Path:
    """Write a capture of cameras on a circle, all of which is scaled and then moved."""
    viewmats = circle(COUNT) if viewmats is None else viewmats
    points = np.random.default_rng(0).normal(0, 0.5, (200, 3)) if points is None else points
    moved = viewmats.copy()
    moved[:, :3, 3] = scale * viewmats[:, :3, 3] - viewmats[:, :3, :3] @ np.array(offset)
    names = [f"frame_{i:03d}.png" for i in range(len(viewmats))]
    for name in names:
        write_image(root / "images" / name, np.full((12, 20, 3), 90, np.uint8))
    lens = (20.0, 20.0, 10.0, 6.0)
    Capture("PINHOLE", 20, 12, lens, names, moved, scale * points + np.array(offset)).write(root, "bin")
    return root


def cameras_of(scene: Scene) -> torch.Tensor:  # [C, 4, 4]
    return torch.stack([view.camera.viewmat for view in (*scene.train, *scene.test)])


@pytest.mark.parametrize("name", ["moving-matte", "pendulum", "suzanne"])
def test_embedded_scenes_stay_where_they_are(name):
    """Catches published trainings that change their bits."""
    scene = load_scene(sample.folder() / name, downscale=8)
    assert scene.placement.is_identity
    assert scene.notes == ()


@pytest.mark.parametrize("name", MOVES)
def test_a_moved_scene_is_trained_where_it_would_have_been(name, tmp_path):
    """Catches cameras or points that single precision rounds, a unit that is left out, and a direction of the move."""
    scale, offset = MOVES[name]
    plain = load_scene(write_capture(tmp_path / "plain"))
    moved = load_scene(write_capture(tmp_path / "moved", scale, offset))
    assert plain.placement.is_identity
    assert not moved.placement.is_identity
    torch.testing.assert_close(cameras_of(moved), cameras_of(plain), rtol=0, atol=2e-6)
    torch.testing.assert_close(moved.points.means, plain.points.means, rtol=0, atol=2e-6)
    assert moved.points.means.dtype == moved.train[0].camera.viewmat.dtype == torch.float32
    assert moved.extent == pytest.approx(plain.extent, rel=1e-6)
    assert moved.up == pytest.approx(plain.up, abs=1e-6)
    there = moved.placement.to_user(plain.points.means).numpy()
    np.testing.assert_allclose(there, scale * plain.points.means.double().numpy() + offset, rtol=0, atol=1e-6 * scale)
    assert any("stay in your coordinates" in note for note in moved.notes)


@settings(max_examples=25)
@given(
    st.floats(-4, 4).map(lambda power: 10**power),
    st.tuples(*[st.floats(-1e6, 1e6)] * 3),
    st.sampled_from(["inwards", "parallel", "outwards"]),
)
def test_any_scene_comes_to_a_standard_place(tmp_path_factory, scale, offset, kind):
    """Catches a kind of cameras without a place: content is around the origin, cameras a few units away."""
    random, viewmats, points = np.random.default_rng(0), circle(COUNT), None
    if kind == "parallel":  # an array of cameras in front of a wall
        viewmats = np.tile(np.eye(4), (COUNT, 1, 1))
        viewmats[:, :2, 3] = random.normal(0, 0.2, (COUNT, 2))
        points = random.normal([0, 0, 5], [1.5, 1, 1], (200, 3))
    if kind == "outwards":  # in the middle of a room
        viewmats = np.tile(np.eye(4), (COUNT, 1, 1))
        turns = np.linspace(0, 2 * np.pi, COUNT, endpoint=False)[:, None] * [0, 1, 0]
        viewmats[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
        viewmats[:, :3, 3] = random.normal(0, 0.1, (COUNT, 3))
        points = random.normal(0, 1, (400, 3))
        points *= 5 / np.linalg.norm(points, axis=1, keepdims=True)
    scale = max(scale, 1e-8 * max(map(abs, offset)))  # of float64 something must be left
    root = write_capture(tmp_path_factory.mktemp("any"), scale, offset, viewmats=viewmats, points=points)
    scene = load_scene(root)
    middle = scene.points.means.double().median(0).values
    distances = (torch.stack([view.camera.center for view in scene.train]).double() - middle).norm(dim=1)
    assert middle.norm() < 0.5 * STANDARD
    if kind != "outwards":
        assert 0.5 * STANDARD < distances.median() < 2 * STANDARD


@pytest.mark.parametrize("count", [1, 3])
def test_wrong_poses_do_not_decide(count, tmp_path):
    """Catches a mean and a maximum over cameras: some of 16 poses lie 10,000 units away and look elsewhere."""
    viewmats = circle(COUNT)
    viewmats[3 : 3 + count, :3, 3] += np.array([5e3, 8e3, 1e3]) * np.arange(1, 1 + count)[:, None]
    plain = load_scene(write_capture(tmp_path / "a"))
    wrong = load_scene(write_capture(tmp_path / "b", viewmats=viewmats))
    assert wrong.placement == plain.placement
    assert wrong.extent == pytest.approx(plain.extent, rel=0.1)
    assert any(f"{count} of 14 training cameras lie far from the others" in note for note in wrong.notes)


def test_a_fixed_camera_has_the_size_of_its_points():
    """Catches a division by the spread of the cameras, which is 0."""
    centers, axes = np.zeros((5, 3)), np.tile([0.0, 0, 1], (5, 1))
    points = np.array([[0.0, 0, 3], [0, 1, 4], [1, 0, 5]])
    middle, size = place_and_size(centers, axes, (points, points[:, 2]))
    np.testing.assert_array_equal(middle, [0, 0, 4])
    assert size == 4
    assert place_and_size(centers, axes)[1] == 0


@pytest.mark.parametrize("shape", ["cube", "normal", "flat"])
def test_no_point_of_a_plain_cloud_is_far_outside(shape):
    """Catches a bound so low that random initial points get another size, and other bits."""
    draws = torch.rand(3000, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    if shape != "cube":
        draws = torch.erfinv(draws)
    if shape == "flat":
        draws[:, 2] *= 1e-3
    assert not far_outside(draws).any()
    assert size_of(Points(draws, draws)) == float(draws.std(0).mean())


@pytest.mark.parametrize(("count", "away"), [(1, 1e4), (30, 300.0), (30, 1e6)])
def test_far_points_do_not_count(count, away, tmp_path):
    """Catches a standard deviation over all points: the clock of 4DGS and the units of AGR follow the size."""
    random = np.random.default_rng(1)
    points = random.normal(0, 0.5, (3000, 3))
    far = np.concatenate([points, away * random.uniform(0.5, 1, (count, 3))])
    scene = load_scene(write_capture(tmp_path, points=far))
    plain = torch.from_numpy(points).float()
    assert size_of(scene.points) == pytest.approx(size_of(Points(plain, plain)), rel=1e-3)
    assert scene.placement.is_identity
    assert any(f"{count} of {3000 + count} points lie far outside" in note for note in scene.notes)


def test_points_of_another_place_are_told_or_refused(tmp_path):
    """Catches a training from points none of which a camera sees: 12.9 dB instead of 34 without a word."""
    away = np.random.default_rng(1).normal([0, 500, 0], 5, (40, 3))
    with pytest.raises(InputError, match=r"they see none of the 40: .*same coordinates"):
        load_scene(write_capture(tmp_path / "none", points=away))
    scene = load_scene(write_capture(tmp_path / "few", points=np.concatenate([away, np.zeros((2, 3))])))
    assert any("see 4.8% of the points" in note for note in scene.notes)
    scene = load_scene(write_capture(tmp_path / "far", points=away[:, [1, 0, 2]]))  # where some cameras look
    assert any("half of the points lie over 10 times as far away" in note for note in scene.notes)


@pytest.mark.parametrize("counts", [(8, 6), (2, 12), (8, 8)])
def test_two_fixed_cameras_side_by_side_look_at_one_point(counts):
    """Catches a scene in units of 2e-16: the camera with more images drew the point to its own place."""
    centers = np.repeat([[-0.2, -4.0, 0.5], [0.2, -4.0, 0.5]], counts, axis=0)
    place, size = place_and_size(centers, -centers / np.linalg.norm(centers, axis=1, keepdims=True))
    assert np.linalg.norm(place) < 0.5
    assert size == pytest.approx(4, abs=0.5)


def test_a_camera_that_only_turns_is_at_one_place(tmp_path):
    """Catches rounding errors of its position taken for the size of the scene: units of 4e-16."""
    turned, place = circle(COUNT), np.array([0.3, -4.1, 0.7])
    turned[:, :3, 3] = -turned[:, :3, :3] @ place
    points = place + np.random.default_rng(0).normal(0, 3, (200, 3))
    scene = load_scene(write_capture(tmp_path, viewmats=turned, points=points))
    assert scene.extent == 0  # which a run refuses
    assert 0.1 < scene.placement.unit < 10


def moved_square(root: Path, scale: float, offset: tuple[float, float, float]) -> Path:
    """The moving square, scaled and moved as a whole."""

    def move(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            for row, by in zip(frame["transform_matrix"], offset, strict=False):
                row[3] = scale * row[3] + by

    edit(write_moving_square(root) / "square", move, "train", "val", "test")
    return root


def test_a_run_is_trained_anywhere_and_exported_in_the_users_coordinates(tmp_path, capsys):
    """Catches PLY files in other coordinates than the cameras', and a start from a PLY that is taken as it is."""
    offset = (500.0, -200.0, 300.0)
    records, trained = {}, {}
    for name, data in {
        "plain": write_moving_square(tmp_path / "plain"),
        "moved": moved_square(tmp_path / "moved", 100.0, offset),
    }.items():
        records[name], folder = run_here(*overrides(data, tmp_path / f"r_{name}", "model=4dgs", "agr=true"))
        assert records[name].status == "ok", records[name].reason
        assert export([str(folder), "--ply", str(tmp_path / f"{name}.ply"), "--time", "0.5"]) == 0
        trained[name] = read_trained(tmp_path / f"{name}.ply")
    plain, moved = records["plain"].metrics, records["moved"].metrics
    assert moved["psnr"] == pytest.approx(plain["psnr"], abs=0.01)
    assert "trained in units of 100" in " ".join(records["moved"].provenance.data_notes)
    there = 100 * trained["plain"].means + torch.tensor(offset)
    torch.testing.assert_close(trained["moved"].means, there, rtol=0, atol=0.05)
    torch.testing.assert_close(
        trained["moved"].log_scales, trained["plain"].log_scales + np.log(100), rtol=0, atol=0.01
    )
    assert "seen by at least one camera" in capsys.readouterr().err
    slow = "model.lr.means.start=1e-6"  # one step moves means by 1e-6 of the scene's extent
    words = overrides(tmp_path / "moved", tmp_path / "again", "model=3dgs", "train.iterations=1", slow)
    started, folder = run_here(*words, f"+init.ply={tmp_path}/moved.ply")
    assert started.status == "ok", started.reason
    means = load_run(folder).model.splats["means"]
    torch.testing.assert_close(means, trained["plain"].means, rtol=0, atol=2e-3)


@pytest.mark.parametrize("near", [None, 1.0, 300.0, 500.0, 600.0])
def test_a_near_plane_is_in_the_users_units(near, tmp_path):
    """Catches a near plane in units of the training, and a training, a measurement or a loaded run without it. The
    cameras are at 400 from the square, whose half size is 150. Few of the initial points are farther than 500."""
    data = moved_square(tmp_path / "data", 100.0, (0.0, 0.0, 0.0))
    words = overrides(data, tmp_path / "r", "model=3dgs", "train.iterations=5", f"data.near={near or 'null'}")
    record, folder = run_here(*words)
    if near == 600:
        assert "lower data.near" in str(record.reason)
        return
    is_cut = near == 500
    assert (record.metrics["psnr"] < record.metrics["psnr_background_only"] + 0.3) == is_cut  # else + 0.9
    assert record.metrics["psnr_float32"] < 0.01  # dB: the float64 image is cut too
    run = load_run(folder)
    (image,) = video.frames(run, [(video.around(run, 0.0, 0.3), 0.5)])
    assert (image.mean() < 17) == is_cut  # 14, else 20; the background is black


def test_points_that_no_camera_sees_are_refused(tmp_path):
    """Catches a training whose Gaussians lie behind all cameras, in silence."""
    data = write_moving_square(tmp_path / "data")
    words = overrides(data, tmp_path / "r", "model=3dgs", "data.initial_half_width=100000")
    record, _ = run_here(*words)
    assert record.status == "failed"
    assert "of which cameras see at least 25%" in (record.reason or "")
    assert "set data.initial_half_width" in (record.reason or "")

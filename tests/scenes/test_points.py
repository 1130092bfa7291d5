"""Initial points: drawn, read from a PLY, and their spacing."""

import io
import math
import random
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hostile.mutations import damage_bytes, replace_file
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from plyfile import PlyData, PlyElement

from gsbench.config import DataConfig
from gsbench.errors import InputError, TooLargeError
from gsbench.process import memory
from gsbench.run.fitting import initial_points
from gsbench.scenes.gaussian_ply import read_trained
from gsbench.scenes.points import frustum_points, nearest_distances, random_points, read_ply
from gsbench.scenes.scene import Camera, Points, Scene, View

VERTEX = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
KINDS = ("f4", "f8", "u1", "u2", "u4", "i1", "i2", "i4")


def ply(vertices: np.ndarray, byte_order: str = "<", faces: np.ndarray | None = None) -> bytes:
    """The bytes of a PLY; byte order "" is ascii."""
    elements = {"vertex": vertices} | ({} if faces is None else {"face": faces})
    listed = [PlyElement.describe(table, name) for name, table in elements.items()]
    file = io.BytesIO()
    PlyData(listed, text=not byte_order, byte_order=byte_order or "=").write(file)
    return file.getvalue()


def save(tmp_path: Path, data: bytes) -> Path:
    path = tmp_path / "points3d.ply"
    path.write_bytes(data)
    return path


@given(
    hnp.arrays(np.float32, st.tuples(st.integers(1, 9), st.just(3)), elements=st.floats(-1e6, 1e6, width=32)),
    st.sampled_from(["", "<", ">"]),
    st.sampled_from(KINDS),
    st.integers(0, 255),
)
def test_ply_round_trip(tmp_path, means, byte_order, kind, red):
    """Catches swapped columns, a wrong stride or width, lost digits and a colour off by its scale, in each encoding."""
    vertices = np.zeros(len(means), [*VERTEX[:3], ("other", kind), *VERTEX[3:]])
    vertices["x"], vertices["y"], vertices["z"] = means.T
    vertices["red"], vertices["blue"] = red, 255
    points = read_ply(save(tmp_path, ply(vertices, byte_order)))
    assert points.means.dtype == torch.float64
    assert points.colors.dtype == torch.float32
    np.testing.assert_array_equal(points.means.numpy(), means)
    np.testing.assert_allclose(points.colors.numpy(), np.tile([red / 255, 0, 1], (len(means), 1)), atol=1e-7)


def test_ply_of_3dgs(tmp_path):
    """3DGS stores f_dc: colour 0.5 + C0 f_dc, clamped. Catches properties in between that are not stepped over, and
    faces after the vertices, which are not read, taken for a list of theirs."""
    names = ("x", "y", "z", "nx", "f_dc_0", "f_dc_1", "f_dc_2")
    vertices = np.zeros(2, [(name, "f4") for name in names])
    vertices["f_dc_0"], vertices["f_dc_1"] = 1.0, 9.0
    faces = np.empty(1, [("vertex_indices", object)])
    faces["vertex_indices"][0] = np.arange(3, dtype="i4")
    colors = read_ply(save(tmp_path, ply(vertices, faces=faces))).colors
    torch.testing.assert_close(colors[1], torch.tensor([0.5 + 0.28209479177387814, 1.0, 0.5]))


@pytest.mark.parametrize(("kind", "white"), [("u1", 255), ("i4", 255), ("u4", 255), ("u2", 255), ("u2", 65535)])
@pytest.mark.parametrize("byte_order", ["", "<"])
def test_integer_colours_of_any_type(kind, white, byte_order, tmp_path):
    """Catches points that are black, as 255 of an int is divided by the largest int, and labels beside f_dc_0..2."""
    vertices = np.zeros(2, [*VERTEX[:3], *((name, kind) for name, _ in VERTEX[3:])])
    vertices["red"], vertices["green"] = (0, white), white // 5
    colors = read_ply(save(tmp_path, ply(vertices, byte_order))).colors
    torch.testing.assert_close(colors, torch.tensor([[0, 0.2, 0], [1, 0.2, 0]]))
    trained = np.zeros(2, [*vertices.dtype.descr, *((f"f_dc_{i}", "f4") for i in range(3))])
    trained["red"] = 9
    assert (read_ply(save(tmp_path, ply(trained, byte_order))).colors == 0.5).all()


def test_ply_of_several_frames(tmp_path, capsys):
    """Catches times that are read as positions, in another type, where a cloud has none, or dropped in silence."""
    path = save(tmp_path, ply(np.zeros(3, [*VERTEX, ("nx", "f4"), ("t", "f4")])))
    read_ply(path)
    assert capsys.readouterr().err == f"{path}: columns of its points that are not read: t\n"
    vertices = np.zeros(3, [*VERTEX, ("time", "f4")])
    vertices["time"] = 0.0, 0.25, 1.0
    times = read_ply(save(tmp_path, ply(vertices))).times
    assert times is not None
    torch.testing.assert_close(times, torch.tensor([0.0, 0.25, 1.0]))
    assert read_ply(save(tmp_path, GOOD)).times is None


GOOD = ply(np.ones(3, VERTEX))
GOOD_ASCII = ply(np.ones(3, VERTEX), "")
BAD_PLY = {
    "not a ply": (b"solid cube", "'ply'"),
    "no end of header": (GOOD[:60], "end_header"),
    "middle endian": (GOOD.replace(b"little", b"middle"), "format"),
    "no vertex": (GOOD.replace(b"vertex", b"face"), "element vertex"),
    "count negative": (GOOD.replace(b"vertex 3", b"vertex -3"), "element vertex"),
    "count zero": (GOOD.replace(b"vertex 3", b"vertex 0"), "element vertex"),
    "count beyond the file": (GOOD.replace(b"vertex 3", b"vertex 999999999999"), "truncated"),
    "count beyond the file, ascii": (GOOD_ASCII.replace(b"vertex 3", b"vertex 999999999999"), "truncated"),
    "truncated": (GOOD[:-1], "truncated"),
    "count below the file": (GOOD.replace(b"vertex 3", b"vertex 2"), "end after the 2 rows"),
    "count below the file, ascii": (GOOD_ASCII.replace(b"vertex 3", b"vertex 2"), "end after the 2 rows"),
    "list property": (GOOD.replace(b"property uchar red", b"property list uchar int red"), "scalar properties"),
    "unknown type": (GOOD.replace(b"uchar red", b"colour red"), "scalar properties"),
    "property twice": (GOOD.replace(b"float y", b"float x"), "scalar properties"),
    "no position": (GOOD.replace(b"float z", b"float w"), "z: expected"),
    "no colour": (GOOD.replace(b"uchar red", b"uchar r"), "f_dc_0"),
    "half a colour": (GOOD.replace(b"uchar blue", b"uchar b"), "blue"),
    "not a number, ascii": (GOOD_ASCII.replace(b"\n1 1", b"\n1 one"), "expected numbers"),
    "colour 256, ascii": (GOOD_ASCII.replace(b"1 1 1\n", b"1 1 256\n"), "blue"),
    "position not finite": (GOOD_ASCII.replace(b"\n1 1", b"\n1 nan"), "y: expected finite numbers, 3 of 3"),
    "time after the end": (ply(np.full(1, 2, [*VERTEX, ("time", "f4")])), "from 0 to 1, got 2 to 2: scale them"),
    "time before the start": (
        GOOD_ASCII.replace(b"uchar red", b"float time\nproperty uchar red").replace(b"1 1 1\n", b"-0.5 1 1 1\n"),
        "time: expected numbers from 0 to 1, got -0.5",
    ),
    "float colour of 255": (ply(np.full(1, 255, [(n, "f4") for n, _ in VERTEX])), "got 255 to 255 as float32"),
    "colours of 32 bits": (ply(np.full(1, 70000, [(n, "i4") for n, _ in VERTEX])), "got 70000 to 70000 as int32"),
    "colours of two types": (ply(np.ones(1, [*VERTEX[:5], ("blue", "f4")])), "as uint8, uint8, float32: convert"),
    "a pointer of git lfs": (b"version https://git-lfs.github.com/spec/v1", "begins with b'version https://'"),
}


@pytest.mark.parametrize("fault", BAD_PLY)
def test_bad_ply(tmp_path, fault):
    """Catches a fault let through (a huge count allocates nothing) and a message without file or field."""
    data, part = BAD_PLY[fault]
    with pytest.raises(InputError) as caught:
        read_ply(save(tmp_path, data))
    assert "points3d.ply" in str(caught.value)
    assert part in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_ascii_ply_without_memory_is_refused(tmp_path, monkeypatch):
    """Catches a process that Linux kills while it parses text, which takes many times the size of the file."""
    path = save(tmp_path, ply(np.ones(120_000, VERTEX), ""))
    monkeypatch.setattr(memory, "available", lambda: 64 << 20)
    with pytest.raises(TooLargeError, match=r"720000 values in ascii need .* write a binary PLY"):
        read_ply(path)


TRAINED = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *(f"{name}_{i}" for name, count in (("scale", 3), ("rot", 4), ("f_rest", 9)) for i in range(count)),
)
LINES = [
    *("property list uchar int vertex_indices", "property float x", "property half nx", "property", "property uchar y"),
    "element face 1000000000000",
    *(f"element vertex {count}" for count in ("0", "-1", "1e3", "2", "9" * 18, "9" * 30)),
    *("comment " + "x" * 70_000, "comment \xff\x80"),
    *("format ascii 1.0", "format binary_big_endian 1.0", "end_header", ""),
]
NUMBERS = ("nan", "inf", "-inf", "1e39", "1e400", "-1", "256", "0x10", "1_0", "9" * 400, "\xff", "1 1", "")


@pytest.mark.parametrize("byte_order", ["", "<", ">"])
@pytest.mark.parametrize("seed", range(40))
def test_a_damaged_ply_is_finite_or_an_input_error(seed, byte_order, tmp_path):
    """Catches any other exception, an array of 10^12 points, a read that does not end, and values that are NaN, in a
    cloud of points and in trained Gaussians: of lines of the header, values, bytes and files."""
    r = random.Random(f"{byte_order} {seed}")
    is_cloud = r.random() < 0.5
    data = ply(np.ones(3, VERTEX if is_cloud else [(name, "f4") for name in TRAINED]), byte_order)
    lines = data.split(b"\n")
    match r.choice(("none", "line", "line", "more", "fewer", "number", "bytes", "bytes", "file", "ending")):
        case "line":
            lines[r.randrange(len(lines) - 1)] = r.choice(LINES).encode("latin-1")
        case "more":
            lines.insert(r.randrange(len(lines)), r.choice((*lines, r.choice(LINES).encode("latin-1"))))
        case "fewer":
            lines.pop(r.randrange(len(lines)))
        case "number":
            lines[-2] = b" ".join([r.choice(NUMBERS).encode("latin-1"), *lines[-2].split()[1:]])
        case "ending":
            lines = [line + b"\r" for line in lines]
        case "bytes":
            lines = [damage_bytes(r, data)[0]]
    path = save(tmp_path, b"\n".join(lines))
    if r.random() < 0.1:
        replace_file(r, path)
    try:
        read = vars(read_ply(path) if is_cloud else read_trained(path))
    except InputError as error:
        assert "\n" not in str(error)  # noqa: PT017  reading well is fine, too
        return
    tensors = [value for value in read.values() if isinstance(value, torch.Tensor)]
    assert len(tensors) == (2 if is_cloud else 6)
    assert all(x.isfinite().all() and len(x) == len(tensors[0]) > 0 for x in tensors)
    assert not is_cloud or 0 <= read["colors"].min() <= read["colors"].max() <= 1


def test_random_points_fill_the_cube_from_the_seed():
    """Catches a ball, a half cube, colours off grey, and draws that do not come from the generator."""
    points = random_points(20_000, 1.3, torch.Generator().manual_seed(7))
    again = random_points(20_000, 1.3, torch.Generator().manual_seed(7))
    assert torch.equal(points.means, again.means)
    assert torch.equal(points.colors, again.colors)
    assert points.means.abs().max() <= 1.3
    counts = torch.histc(points.means[:, 1], bins=4, min=-1.3, max=1.3)
    assert (counts - 5000).abs().max() < 5 * math.sqrt(5000)  # five standard deviations of a fair draw
    corners = (points.means.abs() > 1.3 * 0.8).all(dim=1).double().mean()
    assert corners == pytest.approx(0.2**3, rel=0.4)
    assert 0.5 <= points.colors.min() < points.colors.max() <= 0.5 + 0.2821 / 255


def opposed(distance: float) -> list[Camera]:
    """Two cameras of portrait images on the z axis, which face each other, or turn their backs if `distance` < 0."""
    K = torch.tensor([[30.0, 0.0, 12.0], [0.0, 30.0, 20.0], [0.0, 0.0, 1.0]])
    ahead, back = torch.eye(4), torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    ahead[2, 3] = back[2, 3] = distance / 2
    return [Camera(viewmat, K, 24, 40) for viewmat in (ahead, back)]


def scene_of(cameras: list[Camera], points: Points | None = None) -> Scene:
    train = [View(f"train/{i}", camera, None, torch.zeros(40, 24, 3)) for i, camera in enumerate(cameras)]
    return Scene("opposed", train, [], [], (0.0, 0.0, 0.0), 1.0, points, "made here")


def test_cameras_that_look_away_are_told():
    """Catches poses of OpenCV in a file of OpenGL's, and a message that asks for another cube only."""
    config = DataConfig(initial_points=200, initial_half_width=1.3)
    with pytest.raises(InputError, match="2 of 2 cameras look away from it: are their axes right"):
        initial_points(config, scene_of(opposed(-8.0)), torch.Generator())


@pytest.mark.parametrize("half_width", [1.3, None])
@pytest.mark.parametrize("points", [None, Points(torch.zeros(9, 3), torch.ones(9, 3))])
def test_a_near_plane_beyond_all_points_is_refused(points, half_width, capsys):
    """Catches a training of an empty picture, as no camera draws a Gaussian nearer than data.near."""
    config, g = DataConfig(initial_points=200, initial_half_width=half_width), torch.Generator().manual_seed(0)
    scene = scene_of(opposed(8.0), points)
    for near in (None, 3.0):
        shown = scene if near is None else scene.with_near(near)
        assert len(initial_points(replace(config, near=near), shown, g).means) == (200 if points is None else 9)
    with pytest.raises(InputError, match=r"see 0.0% beyond 1000: lower|lower data.near(=1000, or set|$)"):
        initial_points(replace(config, near=1000.0), scene.with_near(1000.0), g)
    if points is not None:
        few = torch.tensor([[0.0, 0.0, z] for z in (*[0.0] * 7, 2.0)])  # at depths 4 and 6 of the first camera
        scene = replace(scene, points=Points(few, points.colors[:8])).with_near(5.0)
        assert len(initial_points(replace(config, near=5.0), scene, g).means) == 8
        assert "of 8 initial points, training cameras see 12.5% beyond data.near=5" in capsys.readouterr().err


def test_points_between_cameras_that_face_each_other():
    """Catches points behind a camera, whose projections are mirrored into its image, points of a scene at which only
    its first camera looks, and cameras back to back, which see nothing in common."""
    cameras = opposed(8.0)
    scene = scene_of(cameras)
    config, g = DataConfig(initial_points=200, initial_half_width=None), torch.Generator().manual_seed(0)
    for means in (frustum_points(300, cameras, 1.0, g).means, initial_points(config, scene, g).means):
        for camera in cameras:
            x = means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
            assert (x[:, 2] > 0).float().mean() > 0.95
            assert len(means) == 200 or (x[:, 2] > 0).all()
            assert len(means) == 200 or ((x[:, :2] / x[:, 2:]).abs() <= torch.tensor([12, 20]) / 30 + 1e-5).all()
    again = [frustum_points(9, cameras, 1.0, torch.Generator().manual_seed(7)).means for _ in range(2)]
    assert torch.equal(*again)
    with pytest.raises(InputError, match="see something in common"):
        frustum_points(300, opposed(-8.0), 1.0, g)


def test_nearest_distances_against_brute_force():
    """Catches the point itself among its neighbours, a mean of distances for a mean of squares, a missing root."""
    means = torch.rand(200, 3, generator=torch.Generator().manual_seed(3))
    pairs = torch.cdist(means.double(), means.double()).fill_diagonal_(math.inf)
    expected = pairs.topk(3, largest=False).values.square().mean(dim=1).sqrt()
    torch.testing.assert_close(nearest_distances(means), expected.float())


def test_nearest_distances_at_their_ends():
    """3DGS clamps distCUDA2 at 1e-7. Catches a scale of zero, whose logarithm is not finite, an infinite spacing of too
    few points, and a crash in the tree for points that are not finite."""
    torch.testing.assert_close(nearest_distances(torch.ones(5, 3)), torch.full((5,), math.sqrt(1e-7)))
    with pytest.raises(InputError, match="more than 3"):
        nearest_distances(torch.zeros(3, 3))
    with pytest.raises(InputError, match="finite"):
        nearest_distances(torch.full((9, 3), math.nan))

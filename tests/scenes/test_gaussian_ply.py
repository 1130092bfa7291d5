"""PLYs of trained Gaussians as they are found: in any encoding, of any degree, with and without what is not needed."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from gsbench.errors import InputError
from gsbench.kernels.headers import ALPHA_MAX
from gsbench.models.factors import rotation
from gsbench.raster import rasterize
from gsbench.scenes.gaussian_ply import TrainedGaussians, ply_of, read_trained, share_seen
from gsbench.scenes.scene import Camera

N = 5
NEEDED = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
NEEDED += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
BEFORE = [
    PlyElement.describe(np.full(3, 7, [("view_px", "f4"), ("frame", "u1")]), "camera"),
    PlyElement.describe(np.full(2, 9, [("id", "i4")]), "shot"),
]


def rows(degree: int = 0, *more: str, without: str = "", kind: str = "f4", **values: Any) -> np.ndarray:
    """N Gaussians of ones but for scales and some values; the columns are in no order that anyone agreed on."""
    rest = [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    names = [*sorted({*NEEDED, *rest, *values} - {without}, key=lambda name: name[::-1]), *more]
    table = np.ones(N, [(name, kind) for name in names])
    for name, column in (dict.fromkeys(NEEDED[7:10], -1) | values).items():
        if name in names:
            table[name] = column
    return table


def write(path: Path, table: np.ndarray, *before: PlyElement, **form: Any) -> Path:
    """Write a PLY by plyfile, which knows `text` and `byte_order`; return its path."""
    PlyData([*before, PlyElement.describe(table, "vertex")], **form).write(str(path))
    return path


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.ply"


@pytest.mark.parametrize(
    ("form", "degree", "more", "kind"),
    [
        ({}, 3, ("nx", "ny", "nz"), "f4"),
        ({"byte_order": "<"}, 0, ("nx", "ny", "nz", "confidence"), "f4"),
        ({"byte_order": ">"}, 1, ("red", "green", "blue"), "f4"),
        ({"text": True}, 2, ("segment",), "f4"),
        ({}, 4, (), "f8"),
    ],
)
@pytest.mark.parametrize("before", [(), BEFORE])
def test_files_as_programs_write_them(form, degree, more, kind, before, path):
    """Catches columns that are taken by their place, bytes in the wrong order, harmonics with channels mixed up, and
    the values of an element before the vertices, such as a camera, read as those of Gaussians."""
    table, random = rows(degree, *more, kind=kind), np.random.default_rng(0)
    for name in table.dtype.names:
        table[name] = random.normal(size=N).astype(np.float32)
    read = read_trained(write(path, table, *before, **form))
    K = (degree + 1) ** 2
    rest = [f"f_rest_{channel * (K - 1) + k}" for k in range(K - 1) for channel in range(3)]
    fields = {"means": NEEDED[:3], "dc": NEEDED[3:6], "logits": NEEDED[6:7], "log_scales": NEEDED[7:10]}
    fields |= {"quats": NEEDED[10:], "rest": rest}
    for field, names in fields.items():
        expected = torch.tensor(np.stack([table[name] for name in names], 1) if names else np.zeros((N, 0)))
        torch.testing.assert_close(getattr(read, field).reshape(N, -1), expected.float())


def test_what_is_written_is_read(path):
    """Catches a column that is written in another place than it is read from; plyfile agrees on the header."""
    g = torch.Generator().manual_seed(0)
    shapes = ((N, 3), (N, 3), (N, 4), (N,), (N, 3), (N, 8, 3))
    trained = TrainedGaussians(*(torch.randn(shape, generator=g) for shape in shapes))
    path.write_bytes(ply_of(trained))
    read = read_trained(path)
    for name in ("means", "log_scales", "quats", "logits", "dc"):
        assert torch.equal(getattr(read, name), getattr(trained, name))
    assert torch.equal(read.rest[:, :8], trained.rest)
    assert not read.rest[:, 8:].any()
    assert PlyData.read(str(path))["vertex"].count == N


@pytest.mark.parametrize("text", [True, False])
def test_an_opacity_of_exactly_0_or_1_is_read(text, path, capsys):
    """Catches a PLY that was compressed and converted back, refused for its infinite logits, and a change unsaid."""
    write(path, rows(opacity=[np.inf, 3, -np.inf, np.inf, 20]), text=text)
    opacities = torch.sigmoid(read_trained(path).logits.double())
    expected = torch.sigmoid(torch.tensor([0, 3, 0, 0, 20], dtype=torch.float64))
    expected[[0, 2, 3]] = torch.tensor([ALPHA_MAX, 1 - ALPHA_MAX, ALPHA_MAX], dtype=torch.float64)
    torch.testing.assert_close(opacities, expected, rtol=0, atol=1e-7)
    assert "a.ply: 3 of 5 opacities are exactly 0 or 1" in capsys.readouterr().err


def spoilt(value: float) -> list[float]:
    """A column with one value that is not to be used."""
    return [1, 1, value, 1, 1]


REFUSED = [
    (rows(without="rot_3"), "'rot_3'"),
    (rows(without="scale_2"), r"two scales, of surfels \(2DGS\)"),
    (np.ones(N, [(name, "f4") for name in "xyz"]), "cloud of points"),
    (rows(1, without="f_rest_8"), "f_rest"),
    (rows(1, "f_rest_33", without="f_rest_3"), "'f_rest_3'"),
    (rows(x=spoilt(np.nan)), r"a\.ply: x: expected finite numbers, 1 of 5 vertices"),
    (rows(scale_1=spoilt(-np.inf)), "scale_1: expected finite numbers, 1 of 5"),
    (rows(opacity=spoilt(np.nan)), "opacity: expected finite numbers, 1 of 5"),
    (rows(rot_0=spoilt(0), rot_1=0, rot_2=0, rot_3=0), "expected quaternions, 1 of 5 are zero: remove them"),
    (rows(scale_0=spoilt(120)), r"scale_0: .* 1 of 5 vertices have others, or larger ones than 40: remove them"),
    (
        rows(kind="u1", scale_0=9, scale_1=9, scale_2=9),
        r"x, y, z: expected float or double, got uint8, as of quantised",
    ),
    (rows(filter_3D=spoilt(-0.1)), "filter_3D: expected sizes of at least 0"),
    (rows(1, "trbf_center", "trbf_scale"), "trbf_center, trbf_scale are of Spacetime Gaussians"),
    (rows(1, *(f"motion_{i}" for i in range(9))), "motion_0..8 are of Spacetime Gaussians"),
    (rows(1, "omega_0", "omega_1", "nx"), "omega_0..1 are of Spacetime Gaussians"),
    (rows(1, "f_t_0", "f_t_1", "nx"), "f_t_0..1 are of Spacetime Gaussians"),
    (rows(1, "beta"), "beta are of Beta Splatting"),
    (rows(1, "sb_params_0", "sb_params_1"), "sb_params_0..1 are of Beta Splatting"),
    (rows(1, "t", "scale_t", "rot_r_0", "rot_r_1"), "t, scale_t, rot_r_0..1 are of 4DGS"),
    (rows(1, "f_anchor_feat_0", "f_offset_0"), "are of Scaffold-GS"),
    (rows(1, "metallic", "roughness", "nx"), "found metallic, roughness too, which gsbench does not know"),
    (rows(1, "scale_3"), "found scale_3 too"),
    (rows(1, "f_rest_x"), "f_rest"),
    (rows(1, "velocity_" + 6000 * "1"), "found velocity_1"),
]


@pytest.mark.parametrize(("table", "message"), REFUSED)
def test_what_is_not_trained_gaussians_of_3dgs_is_refused(table, message, path):
    """Catches a KeyError, values drawn as NaN, and other Gaussians because another method's column was dropped."""
    with pytest.raises(InputError, match=message) as caught:
        read_trained(write(path, table))
    assert "a.ply" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 600


def test_columns_that_change_no_image_are_named_in_one_line(path, capsys):
    """Catches a column that is dropped in silence, and segmented Gaussians that are refused."""
    more = ("nx", "ny", "nz", "red", "green", "blue", "object_id", "label", "obj_dc_0", "obj_dc_1", "semantic_7")
    assert len(read_trained(write(path, rows(1, *more)))) == N
    listed = "nx, ny, nz, red, green, blue, object_id, label, obj_dc_0..1, semantic_7"
    assert capsys.readouterr().err == f"{path}: columns that change no image are left out: {listed}\n"
    read_trained(write(path, rows(1)))
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(("least", "asked"), [(0.0, True), (-0.1, False)])
def test_opacities_in_place_of_logits_are_asked_for(least, asked, path, capsys):
    """Catches a PLY of activated values, whose Gaussians are all half transparent and larger than a unit."""
    read_trained(write(path, rows(opacity=np.linspace(least, 1, N))))
    error = capsys.readouterr().err
    assert ("are they opacities?" in error) is asked
    assert "are they sizes?" not in error
    read_trained(write(path, rows(scale_0=np.linspace(least, 1, N) + 0.01, scale_1=0.02, scale_2=0.02)))
    assert ("are they sizes?" in capsys.readouterr().err) is asked


@pytest.mark.parametrize("network", ["deformation.pth", "../../deform/iteration_7/deform.pth"])
def test_a_deformation_network_beside_the_file_is_named(network, tmp_path, capsys):
    """Catches canonical Gaussians of 4DGaussians or Deformable 3DGS that are taken for those of the trained scene."""
    path = tmp_path / "point_cloud" / "iteration_7" / "point_cloud.ply"
    beside = (path.parent / network).resolve()
    for folder in (path.parent, beside.parent):
        folder.mkdir(parents=True, exist_ok=True)
    beside.touch()
    assert len(read_trained(write(path, rows()))) == N
    assert capsys.readouterr().err == (f"{path}: {beside} is not read: the Gaussians are those before it moves them\n")


def test_the_filter_of_mip_splatting_is_fused(path, capsys):
    """Catches Gaussians without their 3D filter: images are not those of Mip-Splatting's export."""
    draw = np.random.default_rng(0)
    means = draw.normal(size=(N, 3)) * 0.5
    scales, quats = draw.uniform(0.02, 0.2, (N, 3)), draw.normal(size=(N, 4))
    logits, filters = np.array([3, -1, 60, 0, 2.0]), np.array([0.15, 0.1, 0.05, 0, 0.3])
    names = [*NEEDED[:3], *NEEDED[7:], "opacity", "filter_3D"]
    table = rows(**dict(zip(names, [*means.T, *np.log(scales).T, *quats.T, logits, filters], strict=True)))
    read = read_trained(write(path, table))
    assert "filter_3D of Mip-Splatting" in capsys.readouterr().err
    assert float(read.logits[3]) == table["opacity"][3]  # without a filter to the bit
    assert read.log_scales[3].tolist() == [table[f"scale_{i}"][3] for i in range(3)]

    turn = rotation(torch.tensor(quats))
    covariances = turn * torch.tensor(scales)[:, None, :] ** 2 @ turn.mT
    filtered = covariances + torch.tensor(filters)[:, None, None] ** 2 * torch.eye(3, dtype=torch.float64)
    opacities = torch.sigmoid(torch.tensor(logits)) * (covariances.det() / filtered.det()).sqrt()
    fused = rotation(read.quats.double()) * read.log_scales.double().exp()[:, None, :]
    viewmat, K = torch.eye(4, dtype=torch.float64), torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]).double()
    viewmat[2, 3] = 4
    colors = torch.rand(N, 3, generator=torch.Generator().manual_seed(0)).double()

    def image(factors: torch.Tensor, alphas: torch.Tensor) -> torch.Tensor:
        return rasterize(
            torch.tensor(means), factors, alphas, colors, viewmat[None], K[None], 48, 32, backend="reference"
        ).image

    expected = image(torch.linalg.cholesky(filtered), opacities)
    torch.testing.assert_close(image(fused, torch.sigmoid(read.logits.double())), expected, rtol=0, atol=1e-6)
    unfiltered = image(torch.linalg.cholesky(covariances), torch.sigmoid(torch.tensor(logits)))
    assert (unfiltered - expected).abs().max() > 0.1


CHUNK = np.ones(1, [(f"{end}_{axis}", "f4") for end in ("min", "max") for axis in "xyz"])
PACKED = np.ones(N, [(f"packed_{name}", "u4") for name in ("position", "rotation", "scale", "color")])
LISTS = np.empty(1, [("indices", object)])
LISTS["indices"][0] = np.arange(3, dtype="i4")
OTHER_FILES: list[tuple[str, Callable[[Path], object], str]] = [
    ("a b.spz", lambda path: path.write_bytes(b"NGSP\4\0\0\0"), "(SPZ): {convert}"),
    ("a.spz", lambda path: path.write_bytes(b"\x1f\x8b\x08"), "as SPZ): {convert}"),
    ("renamed.ply", lambda path: path.write_bytes(b"NGSP\4\0\0\0"), "(SPZ): {convert}"),
    ("a.SOG", lambda path: path.write_bytes(b"PK\3\4"), "SOG): {convert}"),
    ("a.splat", lambda path: path.write_bytes(bytes(64)), "SPLAT): {convert}"),
    ("a.ksplat", lambda path: path.write_bytes(bytes(64)), "KSPLAT): {convert}"),
    ("a.ply", lambda path: write(path, PACKED, PlyElement.describe(CHUNK, "chunk")), "compressed"),
    ("a.ply", lambda path: write(path, PACKED, PlyElement.describe(CHUNK, "chunk")), "{convert}"),
    ("step-000029999.ckpt", lambda path: torch.save({"step": 1}, path), "checkpoint of PyTorch: export a PLY"),
    ("a.ply", lambda path: write(path, rows(), PlyElement.describe(LISTS, "face")), "element face: expected distinct"),
]


@pytest.mark.parametrize(("name", "create", "message"), OTHER_FILES)
def test_another_file_says_what_opens_it(name, create, message, tmp_path):
    """Catches 'expected a PLY' for a file that only has to be converted, or exported by the program that wrote it."""
    create(tmp_path / name)
    with pytest.raises(InputError) as caught:
        read_trained(tmp_path / name)
    quoted = f"'{tmp_path / name}'" if " " in name else tmp_path / name
    convert = f"npx -y @playcanvas/splat-transform@3.7.0 {quoted} trained.ply"
    assert message.format(convert=convert) in str(caught.value)


def test_the_share_of_gaussians_that_a_camera_sees():
    """Catches Gaussians behind all cameras, beside the image, too transparent, too small or too near that count."""
    eye = torch.eye(4)
    ahead = Camera(eye, torch.tensor([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]), 100, 60)
    aside = Camera(torch.tensor([[0.0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1]]), ahead.K, 100, 60)
    means = torch.tensor(
        [
            [0.0, 0, 4],  # in the middle
            [0, 0, -4],  # behind
            [0, 1.5, 4],  # below the image, whose height is 60 and not 100
            [0, 1.5, 4],  # reaches into it
            [0, 0, 4],  # too transparent
            [0, 0, 4],  # smaller than a pixel
            [4, 0, 0],  # the other camera sees it
        ]
    )
    sizes = torch.tensor([0.1, 0.1, 0.1, 0.5, 0.1, 0.001, 0.1])
    logits = torch.tensor([0.0, 0, 0, 0, -7, 0, 0])
    log_scales = sizes.log()[:, None].repeat(1, 3) - torch.tensor([0.0, 9, 9])
    flat = TrainedGaussians(means, log_scales, torch.ones(7, 4), logits, torch.zeros(7, 3), torch.zeros(7, 0, 3))
    assert share_seen(flat, [ahead], 1) == pytest.approx(2 / 7)
    assert share_seen(flat, [ahead, aside], 1) == pytest.approx(3 / 7)
    assert share_seen(flat, [ahead, aside], 0.1) == pytest.approx(2 / 7)  # enough
    assert share_seen(flat, [replace(ahead, near=4.5)], 1) == 0

"""PLYs of trained Gaussians as they are found: in any encoding, of any degree, with and without what is not needed."""

import io
from pathlib import Path

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
NEEDED = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
          "rot_0", "rot_1", "rot_2", "rot_3"]  # fmt: skip


def columns(degree: int = 3, *more: str) -> list[str]:
    """The columns of a file of that degree and others, in no order that anyone agreed on."""
    rest = [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    return sorted([*NEEDED, *rest, *more], key=lambda name: name[::-1])


def written(path: Path, names: list[str], *, order: str = "<", text: bool = False, kind: str = "f4") -> np.ndarray:
    """Write random values by plyfile and return them."""
    rows = np.zeros(N, [(name, kind) for name in names])
    values = np.random.default_rng(0)
    for name in names:
        rows[name] = values.normal(size=N).astype(np.float32)
    PlyData([PlyElement.describe(rows, "vertex")], text=text, byte_order="=" if text else order).write(str(path))
    return rows


@pytest.mark.parametrize(
    ("how", "degree", "more"),
    [
        ({}, 3, ("nx", "ny", "nz")),
        ({}, 3, ()),
        ({}, 0, ("nx", "ny", "nz", "confidence")),
        ({"order": ">"}, 1, ("red", "green", "blue")),
        ({"text": True}, 2, ("segment",)),
        ({"kind": "f8"}, 4, ()),
    ],
)
def test_what_is_found_in_the_wild_is_read(
    how: dict[str, object], degree: int, more: tuple[str, ...], tmp_path: Path
) -> None:
    """Catches columns that are taken by their place, bytes in the wrong order, and harmonics with channels mixed up."""
    path = tmp_path / "a.ply"
    rows = written(path, columns(degree, *more), **how)  # type: ignore[arg-type]
    read = read_trained(path)
    K = (degree + 1) ** 2
    assert read.rest.shape == (N, K - 1, 3)
    for field, names in (
        ("means", NEEDED[:3]),
        ("dc", NEEDED[3:6]),
        ("log_scales", NEEDED[7:10]),
        ("quats", NEEDED[10:]),
    ):
        expected = torch.tensor(np.stack([rows[name] for name in names], 1), dtype=torch.float32)
        torch.testing.assert_close(getattr(read, field), expected)
    torch.testing.assert_close(read.logits, torch.tensor(rows["opacity"], dtype=torch.float32))
    for k in range(K - 1):
        for channel in range(3):
            expected = torch.tensor(rows[f"f_rest_{channel * (K - 1) + k}"], dtype=torch.float32)
            torch.testing.assert_close(read.rest[:, k, channel], expected)


def test_what_is_written_is_read(tmp_path: Path) -> None:
    """Catches a column that is written in another place than it is read from; plyfile agrees on the header."""
    g = torch.Generator().manual_seed(0)
    shapes = ((N, 3), (N, 3), (N, 4), (N,), (N, 3), (N, 8, 3))
    trained = TrainedGaussians(*(torch.randn(shape, generator=g) for shape in shapes))
    (tmp_path / "a.ply").write_bytes(ply_of(trained))
    read = read_trained(tmp_path / "a.ply")
    assert all(torch.equal(getattr(read, name), getattr(trained, name)) for name in vars(trained)
               if name not in ("rest", "from_profiles"))  # fmt: skip
    assert torch.equal(read.rest[:, :8], trained.rest)
    assert not read.rest[:, 8:].any()
    assert PlyData.read(io.BytesIO(ply_of(trained)))["vertex"].count == N


@pytest.mark.parametrize("text", [True, False])
def test_an_opacity_of_exactly_0_or_1_is_read(text: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a PLY that was compressed and converted back, refused for its infinite logits, and a change unsaid."""
    rows = np.ones(N, [(name, "f4") for name in columns(0)])
    rows["opacity"] = [np.inf, 3, -np.inf, np.inf, 20]
    PlyData([PlyElement.describe(rows, "vertex")], text=text).write(str(tmp_path / "a.ply"))
    opacities = torch.sigmoid(read_trained(tmp_path / "a.ply").logits.double())
    expected = torch.sigmoid(torch.tensor([0, 3, 0, 0, 20], dtype=torch.float64))
    expected[[0, 2, 3]] = torch.tensor([ALPHA_MAX, 1 - ALPHA_MAX, ALPHA_MAX], dtype=torch.float64)
    torch.testing.assert_close(opacities, expected, rtol=0, atol=1e-7)
    assert "a.ply: 3 of 5 opacities are exactly 0 or 1" in capsys.readouterr().err


def spoilt(name: str, value: float) -> np.ndarray:
    """A file's rows with one value that is not to be used."""
    rows = np.ones(N, [(name, "f4") for name in columns(0)])
    rows[name][2] = value
    return rows


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (np.ones(N, [(name, "f4") for name in columns(0) if name != "rot_3"]), "'rot_3'"),
        (np.ones(N, [(name, "f4") for name in columns(0) if name != "scale_2"]), r"two scales, of surfels \(2DGS\)"),
        (np.ones(N, [(name, "f4") for name in "xyz"]), "cloud of points"),
        (np.ones(N, [(name, "f4") for name in columns(1)[:-1] if name != "f_rest_3"]), "f_rest"),
        (np.ones(N, [(name.replace("rest_3", "rest_33"), "f4") for name in columns(1)]), "'f_rest_3'"),
        (spoilt("x", np.nan), r"a\.ply: x: expected finite numbers, 1 of 5 vertices"),
        (spoilt("scale_1", -np.inf), "scale_1: expected finite numbers, 1 of 5"),
        (spoilt("opacity", np.nan), "opacity: expected finite numbers, 1 of 5"),
        (np.zeros(N, [(name, "f4") for name in columns(0)]), "quaternions"),
    ],
)
def test_what_is_not_trained_gaussians_is_refused(rows: np.ndarray, message: str, tmp_path: Path) -> None:
    """Catches a KeyError, and values that would be drawn as NaN."""
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "a.ply"))
    with pytest.raises(InputError, match=message) as caught:
        read_trained(tmp_path / "a.ply")
    assert "a.ply" in str(caught.value)
    assert "\n" not in str(caught.value)


def with_columns(*more: str, kind: str = "f4") -> np.ndarray:
    """The rows of a file that has some columns more than 3DGS."""
    return np.ones(N, [*((name, "f4") for name in columns(1)), *((name, kind) for name in more)])


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (("trbf_center", "trbf_scale"), "trbf_center, trbf_scale are of Spacetime Gaussians"),
        (tuple(f"motion_{i}" for i in range(9)), "motion_0..8 are of Spacetime Gaussians"),
        (("omega_0", "omega_1", "nx"), "omega_0..1 are of Spacetime Gaussians"),
        (("beta",), "beta are of Beta Splatting"),
        (("sb_params_0", "sb_params_1"), "sb_params_0..1 are of Beta Splatting"),
        (("t", "scale_t", "rot_r_0", "rot_r_1"), "t, scale_t, rot_r_0..1 are of 4DGS"),
        (("f_anchor_feat_0", "f_offset_0"), "are of Scaffold-GS"),
        (("metallic", "roughness", "nx"), "found metallic, roughness too, which gsbench does not know"),
        (("scale_3",), "found scale_3 too"),
        (("f_rest_x",), "f_rest"),
        (("velocity_" + 6000 * "1",), "found velocity_1"),
    ],
)
def test_columns_that_change_the_look_are_refused_by_name(more: tuple[str, ...], message: str, tmp_path: Path) -> None:
    """Catches Gaussians that look different from the file's, because a column of another method was dropped."""
    PlyData([PlyElement.describe(with_columns(*more), "vertex")]).write(str(tmp_path / "a.ply"))
    with pytest.raises(InputError, match=message) as caught:
        read_trained(tmp_path / "a.ply")
    assert len(str(caught.value)) < 600


def test_columns_that_change_no_image_are_named_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a column that is dropped in silence, and segmented Gaussians that are refused."""
    more = ("nx", "ny", "nz", "red", "green", "blue", "object_id", "label", "obj_dc_0", "obj_dc_1", "semantic_7")
    PlyData([PlyElement.describe(with_columns(*more), "vertex")]).write(str(tmp_path / "a.ply"))
    assert len(read_trained(tmp_path / "a.ply")) == N
    listed = "nx, ny, nz, red, green, blue, object_id, label, obj_dc_0..1, semantic_7"
    line = f"{tmp_path}/a.ply: columns that change no image are left out: {listed}\n"
    assert capsys.readouterr().err == line
    PlyData([PlyElement.describe(with_columns(), "vertex")]).write(str(tmp_path / "a.ply"))
    read_trained(tmp_path / "a.ply")
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("network", ["deformation.pth", "../../deform/iteration_7/deform.pth"])
def test_a_deformation_network_beside_the_file_is_named(
    network: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches canonical Gaussians of 4DGaussians or Deformable 3DGS that are taken for those of the trained scene."""
    path = tmp_path / "point_cloud" / "iteration_7" / "point_cloud.ply"
    path.parent.mkdir(parents=True)
    PlyData([PlyElement.describe(with_columns(), "vertex")]).write(str(path))
    beside = (path.parent / network).resolve()
    beside.parent.mkdir(parents=True, exist_ok=True)
    beside.touch()
    assert len(read_trained(path)) == N
    assert capsys.readouterr().err == (f"{path}: {beside} is not read: the Gaussians are those before it moves them\n")


def test_the_filter_of_mip_splatting_is_fused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Catches Gaussians without their 3D filter: images are not those of Mip-Splatting's export."""
    draw = np.random.default_rng(0)
    rows = with_columns("filter_3D")
    means = draw.normal(size=(N, 3)) * 0.5
    scales, quats = draw.uniform(0.02, 0.2, (N, 3)), draw.normal(size=(N, 4))
    logits, filters = np.array([3, -1, 60, 0, 2.0]), np.array([0.15, 0.1, 0.05, 0, 0.3])
    for name, column in zip(
        [*NEEDED[:3], *NEEDED[7:10], *NEEDED[10:], "opacity", "filter_3D"],
        [*means.T, *np.log(scales).T, *quats.T, logits, filters],
        strict=True,
    ):
        rows[name] = column
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "a.ply"))
    read = read_trained(tmp_path / "a.ply")
    assert "filter_3D of Mip-Splatting" in capsys.readouterr().err
    assert float(read.logits[3]) == rows["opacity"][3]  # without a filter to the bit
    assert read.log_scales[3].tolist() == [rows[f"scale_{i}"][3] for i in range(3)]

    turn = rotation(torch.tensor(quats))
    covariances = turn * torch.tensor(scales)[:, None, :] ** 2 @ turn.mT
    filtered = covariances + torch.tensor(filters)[:, None, None] ** 2 * torch.eye(3, dtype=torch.float64)
    opacities = torch.sigmoid(torch.tensor(logits)) * (covariances.det() / filtered.det()).sqrt()
    fused = rotation(read.quats.double()) * read.log_scales.double().exp()[:, None, :]
    viewmat, K = torch.eye(4, dtype=torch.float64), torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]).double()
    viewmat[2, 3] = 4
    colors = torch.rand(N, 3, generator=torch.Generator().manual_seed(0)).double()

    def image(factors: torch.Tensor, alphas: torch.Tensor) -> torch.Tensor:
        return rasterize(torch.tensor(means), factors, alphas, colors, viewmat[None], K[None], 48, 32,
                         backend="reference").image  # fmt: skip

    expected = image(torch.linalg.cholesky(filtered), opacities)
    torch.testing.assert_close(image(fused, torch.sigmoid(read.logits.double())), expected, rtol=0, atol=1e-6)
    unfiltered = image(torch.linalg.cholesky(covariances), torch.sigmoid(torch.tensor(logits)))
    assert (unfiltered - expected).abs().max() > 0.1
    rows["filter_3D"][1] = -0.1
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "a.ply"))
    with pytest.raises(InputError, match="filter_3D: expected sizes of at least 0"):
        read_trained(tmp_path / "a.ply")


@pytest.mark.parametrize("how", [{"byte_order": "<"}, {"byte_order": ">"}, {"text": True}])
def test_an_element_before_the_vertices_is_passed_by(how: dict[str, object], tmp_path: Path) -> None:
    """Catches a file whose first element is a camera, refused or with its values read as those of Gaussians."""
    rows = with_columns()
    rows["x"] = np.arange(N)
    first = [PlyElement.describe(np.full(3, 7, [("view_px", "f4"), ("frame", "u1")]), "camera"),
             PlyElement.describe(np.full(2, 9, [("id", "i4")]), "shot")]  # fmt: skip
    PlyData([*first, PlyElement.describe(rows, "vertex")], **how).write(str(tmp_path / "a.ply"))  # type: ignore[arg-type]
    assert read_trained(tmp_path / "a.ply").means[:, 0].tolist() == list(range(N))
    lists = np.empty(1, [("indices", object)])
    lists["indices"][0] = np.arange(3, dtype="i4")
    PlyData([PlyElement.describe(lists, "face"), PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "a.ply"))
    with pytest.raises(InputError, match="element face: expected distinct scalar properties"):
        read_trained(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("name", "data", "form"),
    [
        ("a b.spz", b"NGSP\4\0\0\0", "SPZ"),
        ("a.spz", b"\x1f\x8b\x08", "SPZ"),
        ("renamed.ply", b"NGSP\4\0\0\0", "SPZ"),
        ("a.SOG", b"PK\3\4", "SOG"),
        ("a.splat", bytes(64), "SPLAT"),
        ("a.ksplat", bytes(64), "KSPLAT"),
    ],
)
def test_a_compressed_file_says_what_opens_it(name: str, data: bytes, form: str, tmp_path: Path) -> None:
    """Catches 'expected a PLY' for a file that only has to be converted."""
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=form) as caught:
        read_trained(tmp_path / name)
    quoted = f"'{tmp_path / name}'" if " " in name else tmp_path / name
    assert f"splat-transform@3.7.0 {quoted} trained.ply" in str(caught.value)


def test_a_checkpoint_of_pytorch_is_not_called_compressed(tmp_path: Path) -> None:
    """Catches nerfstudio's .ckpt, a ZIP, for which a converter of splats is named."""
    path = tmp_path / "step-000029999.ckpt"
    torch.save({"step": 1}, path)
    with pytest.raises(InputError, match="checkpoint of PyTorch: export a PLY"):
        read_trained(path)


def test_a_compressed_ply_says_what_opens_it(tmp_path: Path) -> None:
    """Catches a compressed PLY of SuperSplat that is taken for a damaged one."""
    chunk = PlyElement.describe(
        np.ones(1, [(f"{end}_{axis}", "f4") for end in ("min", "max") for axis in "xyz"]), "chunk"
    )
    packed = np.ones(N, [(f"packed_{name}", "u4") for name in ("position", "rotation", "scale", "color")])
    PlyData([chunk, PlyElement.describe(packed, "vertex")]).write(str(tmp_path / "a.ply"))
    with pytest.raises(
        InputError, match=r"compressed .* npx -y @playcanvas/splat-transform@3\.7\.0 .*a\.ply trained\.ply"
    ):
        read_trained(tmp_path / "a.ply")


def test_the_share_of_gaussians_that_a_camera_sees() -> None:
    """Catches Gaussians behind all cameras, beside the image, too transparent or smaller than a pixel that count."""
    eye = torch.eye(4)
    ahead = Camera(eye, torch.tensor([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]), 100, 60)
    aside = Camera(torch.tensor([[0.0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1]]), ahead.K, 100, 60)
    means = torch.tensor([
        [0.0, 0, 4],  # in the middle
        [0, 0, -4],  # behind
        [0, 1.5, 4],  # below the image, whose height is 60 and not 100
        [0, 1.5, 4],  # reaches into it
        [0, 0, 4],  # too transparent
        [0, 0, 4],  # smaller than a pixel
        [4, 0, 0],  # the other camera sees it
    ])  # fmt: skip
    sizes = torch.tensor([0.1, 0.1, 0.1, 0.5, 0.1, 0.001, 0.1])
    logits = torch.tensor([0.0, 0, 0, 0, -7, 0, 0])
    flat = TrainedGaussians(means, sizes.log()[:, None].repeat(1, 3) - torch.tensor([0.0, 9, 9]),
                            torch.ones(7, 4), logits, torch.zeros(7, 3), torch.zeros(7, 0, 3))  # fmt: skip
    assert share_seen(flat, [ahead], 1) == pytest.approx(2 / 7)
    assert share_seen(flat, [ahead, aside], 1) == pytest.approx(3 / 7)
    assert share_seen(flat, [ahead, aside], 0.1) == pytest.approx(2 / 7)  # enough

"""PLYs of trained Gaussians as they are found: in any encoding, of any degree, with and without what is not needed."""

import io
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from gsbench.errors import InputError
from gsbench.kernels.headers import ALPHA_MAX
from gsbench.scenes.trained import TrainedGaussians, ply_of, read_trained

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
    ("rows", "said"),
    [
        (np.ones(N, [(name, "f4") for name in columns(0) if name != "rot_3"]), "'rot_3'"),
        (np.ones(N, [(name, "f4") for name in columns(0) if name != "scale_2"]), "'scale_2'"),
        (np.ones(N, [(name, "f4") for name in "xyz"]), "cloud of points"),
        (np.ones(N, [(name, "f4") for name in columns(1)[:-1] if name != "f_rest_3"]), "f_rest"),
        (np.ones(N, [(name.replace("rest_3", "rest_33"), "f4") for name in columns(1)]), "'f_rest_3'"),
        (spoilt("x", np.nan), r"a\.ply: x: expected finite numbers, 1 of 5 Gaussians"),
        (spoilt("scale_1", -np.inf), "scale_1: expected finite numbers, 1 of 5"),
        (spoilt("opacity", np.nan), "opacity: expected finite numbers, 1 of 5"),
        (np.zeros(N, [(name, "f4") for name in columns(0)]), "quaternions"),
    ],
)
def test_what_is_not_trained_gaussians_is_refused(rows: np.ndarray, said: str, tmp_path: Path) -> None:
    """Catches a KeyError, and values that would be drawn as NaN."""
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "a.ply"))
    with pytest.raises(InputError, match=said) as caught:
        read_trained(tmp_path / "a.ply")
    assert "a.ply" in str(caught.value)
    assert "\n" not in str(caught.value)

"""A slice as a PLY of 3DGS: read by plyfile and drawn from its columns alone, it is the image of the model."""

import io

import numpy as np
import pytest
import torch
from models.small import MODELS, VARIANTS, lively
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from gsbench.errors import InputError
from gsbench.models import CameraTime, GaussianModel
from gsbench.models.cameras import UP, intrinsics, look_at
from gsbench.models.render import render
from gsbench.raster import rasterize
from gsbench.scenes import Camera
from gsbench.scenes.gaussian_ply import ply_of
from gsbench.schedule import ActiveComponents
from gsbench.view.slice_ply import decompose, trained_of

SIZE = 48
BACKGROUND = torch.tensor([0.1, 0.2, 0.3])
COLUMNS = [
    *("x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45))),
    *("opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))),
]


def camera(x: float, y: float, z: float) -> Camera:
    """A camera there that looks at the origin."""
    return Camera(
        look_at(torch.tensor([x, y, z]), torch.zeros(3), torch.tensor(UP)), intrinsics(SIZE, SIZE), SIZE, SIZE
    )


def trained(variant: str) -> GaussianModel:
    """A model in the midst of a training, with everything switched on."""
    model = lively(variant, count=60).float()
    model.set_active(ActiveComponents(3, model.agr, True))
    return model.requires_grad_(False)


def drawn(data: bytes, view: Camera) -> torch.Tensor:
    """Draw a PLY by plyfile, numpy and the rasterizer: the conventions of 3DGS, written a second time."""
    rows = PlyData.read(io.BytesIO(data))["vertex"].data
    assert rows.dtype.names == tuple(COLUMNS)
    take = {
        name: np.stack([rows[name + end] for end in ends], 1).astype(np.float64)
        for name, ends in (("f_dc_", "012"), ("scale_", "012"), ("rot_", "0123"), ("", "xyz"))
    }
    R = Rotation.from_quat(np.roll(take["rot_"], -1, axis=1)).as_matrix()
    directions = take[""] - view.center.double().numpy()
    a, b, c = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).T
    xx, yy, zz = a * a, b * b, c * c
    basis = np.stack(
        [
            -0.4886025 * b,
            0.4886025 * c,
            -0.4886025 * a,
            1.0925484 * a * b,
            -1.0925484 * b * c,
            0.3153916 * (2 * zz - xx - yy),
            -1.0925484 * a * c,
            0.5462742 * (xx - yy),
            -0.5900436 * b * (3 * xx - yy),
            2.8906114 * a * b * c,
            -0.4570458 * b * (4 * zz - xx - yy),
            0.3731763 * c * (2 * zz - 3 * xx - 3 * yy),
            -0.4570458 * a * (4 * zz - xx - yy),
            1.4453057 * c * (xx - yy),
            -0.5900436 * a * (xx - 3 * yy),
        ],
        1,
    )
    rest = np.stack([rows[f"f_rest_{i}"] for i in range(45)], 1).reshape(-1, 3, 15)
    colors = np.clip(0.5 + 0.28209479 * take["f_dc_"] + np.einsum("nck,nk->nc", rest, basis), 0, None)
    opacities = 1 / (1 + np.exp(-rows["opacity"].astype(np.float64)))
    parts = (take[""], R * np.exp(take["scale_"])[:, None, :], opacities, colors)
    tensors = [torch.tensor(part, dtype=torch.float32) for part in parts]
    return rasterize(*tensors, view.viewmat[None], view.K[None], SIZE, SIZE, background=BACKGROUND).image[0]


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_ply_is_the_image(variant):
    """Catches scales, rotations, colours or opacities in another convention, and a mirrored rotation."""
    model, view = trained(variant), camera(0.3, -4.0, 1.0)
    gaussians = trained_of(model, CameraTime.of(view, 0.4))
    image = render(model, view, 0.4, BACKGROUND)
    assert (image - BACKGROUND).abs().max() > 0.1
    assert (drawn(ply_of(gaussians), view) - image).abs().max() < 2e-3


@pytest.mark.parametrize("variant", ["3dgs", "3dgs_agr", "4dgs", "4dgs_agr", "4dgs_constant_colors"])
def test_harmonics_are_right_from_everywhere(variant):
    """Catches f_rest in the wrong order, waves of time that are left out, or mean times that AGR has not moved."""
    model = trained(variant)
    data = ply_of(trained_of(model, CameraTime.at(torch.zeros(3), 0.4), keep_harmonics=True))
    for view in (camera(0.3, -4.0, 1.0), camera(3.0, 2.0, -2.0)):
        assert (drawn(data, view) - render(model, view, 0.4, BACKGROUND)).abs().max() < 2e-3


@pytest.mark.parametrize("name", MODELS)
def test_what_is_culled_is_left_out(name):
    """Catches a file of Gaussians that nobody sees, and an empty file."""
    model = trained(name)
    model.splats["opacities"][:20] = -20.0
    assert 0 < len(trained_of(model, CameraTime.of(camera(0.0, -4.0, 0.0), 0.4))) <= 40
    model.splats["opacities"][:] = -20.0
    with pytest.raises(InputError, match="no Gaussian"):
        trained_of(model, CameraTime.of(camera(0.0, -4.0, 0.0), 0.4))


def test_factors_are_decomposed():
    """Catches left-handed axes, and a scale of zero whose logarithm is not finite."""
    factors = torch.randn(200, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    factors[:5, :, 0] = 0
    log_scales, quats = decompose(factors)
    assert log_scales.isfinite().all()
    R = torch.from_numpy(Rotation.from_quat(quats.roll(-1, dims=1)).as_matrix())
    S = R * log_scales.exp()[:, None, :]
    torch.testing.assert_close(S @ S.mT, factors @ factors.mT, atol=1e-5, rtol=1e-5)


def test_a_ply_of_a_diverged_model_is_refused():
    """Catches a file of NaN."""
    model = trained("3dgs")
    model.splats["means"][3, 1] = float("nan")
    with pytest.raises(InputError, match="means"):
        ply_of(trained_of(model, CameraTime.at(torch.zeros(3), None)))

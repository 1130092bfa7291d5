"""Models as a training builds them: AGR's initial weights, sizes, and equal slices by kernels and in torch."""

import math
from dataclasses import replace

import pytest
import torch
from tiny_training import trainer

from gsbench.kernels.backends import AUTO, REFERENCE
from gsbench.models import CameraTime
from gsbench.models.gaussian_batch import tensors_of
from gsbench.train.batches import generator


@pytest.mark.parametrize("half", [True, False])
@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("name", ["3dgs", "4dgs", "6dgs", "7dgs"])
def test_a_model_shows_the_same_by_kernels_and_in_torch(name: str, degree: int, half: bool) -> None:
    """Catches a kernel's path that ignores directional_half, the harmonics' schedule, or AGR."""
    option = [f"model.options.directional_half={half}"] if name in ("6dgs", "7dgs") else []
    fitted = trainer(name, "agr=true", *option)
    model = fitted.model
    random = generator(1)
    with torch.no_grad():
        for splat in model.splats.values():
            splat.add_(0.3 * torch.randn(splat.shape, generator=random))
        assert model.refinement is not None
        model.refinement.weight_out.normal_(0, 0.02, generator=random)
    model.set_active(replace(model.active, sh_degree=degree, refine=True))
    shown = []
    for backend in (AUTO, REFERENCE):
        model.backend = backend
        shown.append(model.slice(CameraTime.at(fitted.scene.train[2].camera.center, 0.4)))
    drawn = shown[1].opacities > 1 / 200  # colours of what is not drawn are not computed
    assert drawn.sum() > 10
    for a, b in zip(*map(tensors_of, shown), strict=True):
        torch.testing.assert_close(a[drawn], b[drawn], rtol=1e-3, atol=1e-4)


def test_agr_starts_as_linear_layers_do() -> None:
    """Catches another initialisation than torch.nn.Linear's: uniform within 1 / sqrt(width), output layers zero."""
    refinement = trainer("7dgs").model.refinement
    assert refinement is not None
    bound = 1 / math.sqrt(7 + 2 * refinement.octaves)
    for values in (refinement.weight_in, refinement.bias_in):
        assert 0.9 * bound < values.abs().max() <= bound
        assert values.mean().abs() < 0.1 * bound
    assert refinement.weight_in.std().item() == pytest.approx(bound / math.sqrt(3), rel=0.05)
    assert not refinement.weight_out.any()
    assert not refinement.bias_out.any()


def test_the_size_of_4dgs_is_its_largest_in_space() -> None:
    """Catches the smallest scale, and a duration that counts as a size."""
    model = trainer("4dgs").model
    with torch.no_grad():
        model.splats["scales"].copy_(torch.tensor([0.0, 1.0, -1.0, 5.0]).expand(len(model), 4))
    torch.testing.assert_close(model.scales(), torch.full((len(model),), math.e))

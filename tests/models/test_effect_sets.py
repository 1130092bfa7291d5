"""Models whose rows have effects of their own: static rows, rows that AGR does not move, colours of fewer harmonics."""

import pytest
import torch
from small import CAMERA, VARIANTS, N, lively, seeded
from torch import Tensor

from gsbench.kernels.headers import LOG_SIZE_MAX
from gsbench.models import CameraTime, GaussianModel
from gsbench.models.cholesky import CholeskyModel
from gsbench.models.effect_sets import EffectSets
from gsbench.models.factors import rotation, rotation4d, turn_of_space
from gsbench.models.gaussian_batch import tensors_of
from gsbench.schedule import ActiveComponents

OBSERVING = [name for name in VARIANTS if not name.startswith("3dgs")]
QUERY = CameraTime.at(CAMERA, 0.45)


def classed(variant: str, count: int, refined: int, conditioned: int, sh_degree: int = 3) -> GaussianModel:
    """A lively model with orders from the constant colour to more than there is."""
    model = lively(variant, count, sh_degree=sh_degree)
    model.set_active(ActiveComponents(sh_degree, model.agr, True))
    model.effect_sets = EffectSets(
        refined, conditioned, torch.randint(0, 16, (count,), generator=seeded(3), dtype=torch.int32)
    )
    return model


@pytest.mark.parametrize("variant", VARIANTS)
def test_slice_has_gradients(variant: str) -> None:
    """Catches a wrong or lost derivative where rows are cut and put together again (central differences)."""
    model = classed(variant, 4, 1, 2, sh_degree=1)
    names = sorted(model.splats)
    values = [model.splats[name].detach()[:3].requires_grad_() for name in names]
    del model.splats
    model.effect_sets = model.effect_sets._replace(orders=model.effect_sets.orders[:3])  # a row of each class

    def sliced(*values: Tensor) -> tuple[Tensor, ...]:
        model.splats = dict(zip(names, values, strict=True))
        return tuple(tensors_of(model.slice(QUERY)))

    assert torch.autograd.gradcheck(sliced, values)


@pytest.mark.parametrize("variant", VARIANTS)
def test_rows_have_the_effects_of_their_class_only(variant: str) -> None:
    """Catches effect sets cut at another row: what is static is the same everywhere, what AGR leaves is as it was."""
    model, whole = classed(variant, N, 8, 15), lively(variant)
    whole.set_active(model.active)
    moved, everything, raw = model.refined(QUERY), whole.refined(QUERY), dict(whole.splats.items())
    for name in (*model.centers, *model.geometry):
        assert torch.equal(moved[name][8:], raw[name][8:])
        torch.testing.assert_close(moved[name][:8], everything[name][:8])
    other = CameraTime.at(torch.tensor([3.0, 1.0, 2.0], dtype=torch.float64), 0.9)
    here, there = model.slice(QUERY), model.slice(other)
    for x, y in zip(here[:3], there[:3], strict=True):
        assert torch.equal(x[15:], y[15:])
    moves = bool(model.observes)
    assert moves != torch.equal(here.means[8:15], there.means[8:15])
    assert torch.equal(here.opacities[15:], torch.sigmoid(model.splats["opacities"])[15:])
    constant = (model.effect_sets.orders == 0) & (torch.arange(N) >= 15)
    assert constant.any()
    assert torch.equal(here.colors[constant], there.colors[constant])
    varied = (model.effect_sets.orders % 4 > 0) & (torch.arange(N) >= 15)
    assert not torch.equal(here.colors[varied], there.colors[varied])


@pytest.mark.parametrize("variant", VARIANTS)
def test_effect_sets_that_leave_nothing_out_change_no_bit(variant: str) -> None:
    """Catches arithmetic that depends on whether a model has effect_sets."""
    model, whole = lively(variant), lively(variant)
    model.effect_sets = EffectSets(N, N, torch.full((N,), 31, dtype=torch.int32))
    for x, y in zip(tensors_of(model.slice(QUERY)), tensors_of(whole.slice(QUERY)), strict=True):
        assert torch.equal(x, y)


def test_agr_that_moves_nothing_is_not_called(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches networks that are evaluated on no row, which on a GPU costs as much as on a few."""
    model = classed("7dgs_agr", N, 0, 10)
    monkeypatch.setattr(model.refinement, "forward", None)
    assert all(x is model.splats[name] for name, x in model.refined(QUERY).items())


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_agr_moves_a_row_within_its_span_alone(dtype: torch.dtype) -> None:
    """Catches a Gaussian that AGR moves before its first time, or after its last one, by torch and by the kernel."""
    model = classed("7dgs_agr", N, 4, 10).to(dtype)
    query = CameraTime.at(CAMERA.to(dtype), 0.45)
    whole = model.refined(query)
    model.effect_sets = model.effect_sets._replace(
        intervals=torch.tensor([[0.5, 0.9], [0.1, 0.4], [0.4, 0.5], [0.0, 1.0]])
    )
    moved = model.refined(query)["means"]
    assert torch.equal(moved[:2], model.splats["means"][:2])
    torch.testing.assert_close(moved[2:], whole["means"][2:])
    assert (moved[2:4] != model.splats["means"][2:4]).any(1).all()


def freeze(model: GaussianModel) -> None:
    """Make every row an ordinary one that hardly changes: endlessly long in all that is observed, and not moving."""
    splats = model.splats
    with torch.no_grad():
        if isinstance(model, CholeskyModel):
            for kind in model.layout.kinds[1:]:
                splats[kind].zero_()
            splats["log_diagonal"][:, model.rows["t"] + model.rows["d"]] = LOG_SIZE_MAX
        else:
            splats["right_quats"].copy_(splats["left_quats"] * torch.tensor([1, -1, -1, 1]))
            splats["scales"][:, 3] = LOG_SIZE_MAX


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("variant", [name for name in OBSERVING if "agr" not in name])
def test_a_static_row_is_a_frozen_one(variant: str, dtype: torch.dtype) -> None:
    """Catches a static row that would look otherwise to whoever does not know of effect_sets, by kernels or by torch.

    An exponent of f_dir or f_temp is (q - mu)^2 / (2 e^32) = 1e-14 (q - mu)^2 there; factors may differ by a rotation
    from the right, covariances do not.
    """
    model = lively(variant).to(dtype)
    freeze(model)
    query, raw = CameraTime.at(CAMERA.to(dtype), 0.45), dict(model.splats.items())
    means, factors, opacities = tensors_of(model.slice_geometry(raw, query))
    model.effect_sets = EffectSets(0, 0, None)
    static = model.slice_geometry(raw, query)
    tolerance = {"rtol": 1e-11, "atol": 1e-11} if dtype == torch.float64 else {"rtol": 1e-5, "atol": 1e-5}
    torch.testing.assert_close(static[0], means, **tolerance)
    torch.testing.assert_close(static[1] @ static[1].mT, factors @ factors.mT, **tolerance)
    torch.testing.assert_close(static[2], opacities, **tolerance)


def test_turn_of_space() -> None:
    """Catches a sign or a place in the rotation of space that a left quaternion makes with its partner."""
    left = torch.randn(20, 4, generator=seeded(0), dtype=torch.float64)
    right = left * torch.tensor([1, -1, -1, 1])
    both = rotation4d(left, right)
    torch.testing.assert_close(both[:, :3, :3], rotation(turn_of_space(left)))
    torch.testing.assert_close(both[:, 3], torch.tensor([0.0, 0, 0, 1], dtype=torch.float64).expand(20, 4))
    assert torch.equal(turn_of_space(turn_of_space(left)), left)

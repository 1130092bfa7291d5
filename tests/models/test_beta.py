"""UBS and dBS: their equations by hand and against the conditional Gaussian, their gradients, and their profiles."""

import math

import pytest
import torch
from small import CAMERA, assert_culled_outside_its_intervals, moved, started
from torch import Tensor

from gsbench.errors import InputError
from gsbench.models import CameraTime, GaussianModel, build
from gsbench.models.beta import BetaModel, joint_factor, opacity_factor, softplus_inverse
from gsbench.models.camera_time import unit
from gsbench.models.gated import GatedModel
from gsbench.models.moving import DirectBetaModel
from gsbench.models.slicing import slice_gaussians

DIRECTION = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
QUERY = CameraTime(-DIRECTION, torch.tensor(0.7, dtype=torch.float64))  # seen from there, the origin lies in DIRECTION
NAMES = ("ubs", "ubs_static", "dbs", "dbs_static")


def lively(name: str, count: int = 30, **options: object) -> tuple[BetaModel, dict[str, Tensor]]:
    model = moved(started(build(name, **options), count))
    assert isinstance(model, BetaModel)
    return model, {key: value.detach() for key, value in model.splats.items()}


def test_the_equations_of_dbs() -> None:
    """Catches an exponent of another variable, weights b / 4 that are not those of V_qq delta, and exp for softplus."""
    model = build("dbs")
    assert isinstance(model, DirectBetaModel)
    view, time = math.log(0.4), math.log(math.sqrt(10))
    raw = {
        "means": torch.zeros(1, 3).double(),
        "scales": softplus_inverse(torch.tensor([[0.01, 0.02, 0.03]]).double()),
        "directions": torch.tensor([[0.0, 0, 1]]),
        "times": torch.full((1, 1), 0.5),
        "precision": torch.tensor([[view, 0.1, view, 0, 0, view, time]]),
        "coupling": torch.full((1, 12), 0.3),
        "betas": torch.tensor([[7.0, -3, -3, -3, 0]]),
    }
    shift, factor = model.change({key: value.double() for key, value in raw.items()}, QUERY)
    torch.testing.assert_close(shift, torch.full((1, 3), 0.0115723, dtype=torch.float64), rtol=1e-5, atol=0)
    torch.testing.assert_close(factor, torch.tensor([0.145891], dtype=torch.float64), rtol=1e-5, atol=0)


@pytest.mark.parametrize("name", ["ubs", "ubs_static"])
@pytest.mark.parametrize("modulation", ["whitened", "raw"])
def test_exponents_of_four_condition_a_gaussian(name: str, modulation: str) -> None:
    """Catches a covariance whose rows are in another order than the query, and a mean that B changes where B = I."""
    model, raw = lively(name, modulation=modulation)
    raw["betas"][:, 1:] = 0.5  # b = 6.6, of which B takes at most 4 / 4
    found = model.condition(raw, QUERY)
    q = [unit(raw["means"] - QUERY.center), torch.full((30, 1), 0.7)][: len(model.observes)]
    mean = torch.cat([raw["means"], raw["directions"], *([raw["times"]] if "times" in raw else [])], -1)
    expected = slice_gaussians(mean, joint_factor(raw), torch.cat(q, -1))
    torch.testing.assert_close(found.means, expected.mean)
    torch.testing.assert_close(found.factors @ found.factors.mT, expected.factor @ expected.factor.mT)


def test_both_modulations_agree_where_every_exponent_is_the_same() -> None:
    """Catches B on the wrong side of the whitening, and a covariance that loses the part I - B."""
    models = [lively("ubs", modulation=x) for x in ("whitened", "raw")]
    slices = []
    for model, raw in models:
        raw["betas"][:, 1:] = -0.7
        slices.append(model.condition(raw, QUERY))
    torch.testing.assert_close(slices[0].means, slices[1].means)
    covs = [one.factors @ one.factors.mT for one in slices]
    torch.testing.assert_close(*covs)
    assert not torch.allclose(covs[0], slices[0].factors.mT @ slices[0].factors)
    with pytest.raises(InputError, match="modulation 'white'"):
        build("ubs", modulation="white")


def test_the_whitened_covariance_is_definite_and_the_raw_one_is_not() -> None:
    """Catches a mix-up of the two: only the covariance of the authors' code can be indefinite, and is then flat."""
    flat = {}
    for modulation in ("whitened", "raw"):
        model, raw = lively("ubs", 200, modulation=modulation)
        raw["lower"] *= 10
        raw["betas"][:, 1:] = 2 * torch.randn(200, 4, generator=torch.Generator().manual_seed(1)).double() - 1
        flat[modulation] = int((torch.linalg.det(model.factors(raw)) == 0).sum())
    assert flat["whitened"] == 0
    assert flat["raw"] > 10


def test_opacity_factors_neither_cancel_nor_vanish() -> None:
    """Catches 1 - tanh(y^2) = 0 in float32 with a logarithm of -inf, and a floor other than the authors'."""
    y = torch.tensor([[0.0], [0.5], [3.5], [1e6]], requires_grad=True)
    betas = torch.zeros(4, 2)
    found = opacity_factor(y, betas + math.log(0.05))  # exponents 0.2
    expected = torch.tensor([1.0, (1 - math.tanh(0.25)) ** 0.2, 1.2e-7**0.2, 1.2e-7**0.2])
    torch.testing.assert_close(found, expected)
    found.sum().backward()
    assert y.grad is not None
    assert y.grad.isfinite().all()


@pytest.mark.parametrize("name", NAMES)
def test_gradients_of_a_slice(name: str) -> None:
    """Catches a gradient that autograd and finite differences see differently, such as that of a root at zero."""
    model, raw = lively(name, 4)
    names = [key for key in raw if key not in ("sh0", "shN", "opacities", *(["means"] if "dbs" in name else []))]

    def slice_of(*values: Tensor) -> tuple[Tensor, ...]:
        found = model.condition(raw | dict(zip(names, values, strict=True)), QUERY)
        assert found.beta_exponents is not None
        return found.means, found.factors @ found.factors.mT, found.opacity_factor, found.beta_exponents

    assert torch.autograd.gradcheck(slice_of, [raw[key].requires_grad_() for key in names], atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_they_start_as_their_authors_start(name: str) -> None:
    """Catches opacities of 0.1, directions that are unit vectors, and view exponents of 4 in a model with time."""
    model = started(build(name), 500)
    assert torch.sigmoid(model.splats["opacities"]).unique().tolist() == pytest.approx([0.5])
    assert -1 <= model.splats["directions"].min() < -0.9
    dynamic = "time" in model.observes
    assert model.splats["betas"].unique(dim=0).tolist() == [[0.0, *[-3.0 if dynamic else 0.0] * 3, *[0.0] * dynamic]]
    first = model.slice(CameraTime.at(CAMERA.float(), 0.3))
    assert first.beta_exponents is not None
    assert first.beta_exponents.unique().tolist() == [4.0]
    sizes = torch.linalg.matrix_norm(first.factors, ord=2)
    torch.testing.assert_close(model.scales(), sizes / math.sqrt(8), rtol=1e-3, atol=0)


@pytest.mark.parametrize("name", NAMES)
def test_children_look_1_6_times_smaller(name: str) -> None:
    """Catches children of another profile, and means that are drawn from the support, nearly three times too wide."""
    model, raw = lively(name, 4)
    rows = {key: value[:1].repeat(4000, *[1] * (value.dim() - 1)) for key, value in raw.items()}
    if "lower" in raw:
        rows["lower"] = rows["lower"] * 0  # so that nothing but the sizes is in the slice
    children = model.split(rows, torch.Generator().manual_seed(0))
    b = 4 * math.exp(float(raw["betas"][0, 0]))
    F = model.factors(rows)[0]
    drawn = (children["means"] - rows["means"]).T.cov()
    torch.testing.assert_close(drawn, F @ F.T / (2 * b), rtol=0.15, atol=float((F @ F.T).max()) * 0.01)
    torch.testing.assert_close(model.factors(rows | children)[0], F / 1.6)


@pytest.mark.parametrize("name", ["dbs", "dbs_static"])
def test_dbs_is_gated_and_ubs_is_not(name: str) -> None:
    """Catches a gate that makes of UBS what its parameters cannot express, and dBS without its profile once static."""
    model, raw = lively(name)
    assert isinstance(model, GatedModel)
    assert not isinstance(build("ubs"), GatedModel)
    assert torch.equal(model.static(raw).beta_exponents, model.condition(raw, QUERY).beta_exponents)


def test_outside_its_interval_a_gaussian_of_dbs_is_culled() -> None:
    """Catches a lifetime without its exponent, by which rows would be sorted into an order that saves nothing."""
    model: GaussianModel = lively("dbs", 100)[0]
    with torch.no_grad():
        model.splats["betas"].clamp_(min=-1.5)  # weaker ones end at the floor, where they may stay visible
    assert_culled_outside_its_intervals(model, torch.linspace(0, 1, 21, dtype=torch.float64), exact=False)
    assert started(build("ubs"), 5).visible_intervals() is None  # its rows are not sorted


@pytest.mark.parametrize("name", NAMES)
def test_sizes_are_held(name: str) -> None:
    """Catches a minimum that is that of the support: what looks like a Gaussian has to be as large as asked."""
    model = started(build(name), 20)
    model.hold_sizes(torch.full((20,), 0.7))
    assert (model.scales() >= 0.699).all()

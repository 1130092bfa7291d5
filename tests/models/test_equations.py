"""The slice of each model against the equations of its paper, in float64 with explicit inverses or by hand."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from numerics import population, slices
from numerics.cases import CASES
from small import CAMERA, CHOLESKY, MODELS, N, covariances, fresh, joint, lively, moved, raw, seeded, started

from gsbench.kernels.backends import REFERENCE
from gsbench.models import CameraTime, Gaussians3D, build
from gsbench.models.base import Raw
from gsbench.models.beta import BetaModel, joint_factor, opacity_factor
from gsbench.models.camera_time import unit
from gsbench.models.cholesky import CholeskyModel
from gsbench.models.gaussian_batch import tensors_of
from gsbench.models.gaussians4d import TIME_OPACITY_FACTOR_MIN
from gsbench.models.slicing import slice_gaussians

TIME = 0.45
QUERY = CameraTime.at(CAMERA, TIME)
ORDERS = {"paper": "ptd", "conditioned_first": "dtp"}
SCHEMES = ("square_root", "schur", "cholesky")


def agree(sliced: Gaussians3D, means: np.ndarray, covs: np.ndarray, opacities: np.ndarray, rtol: float = 1e-8) -> None:
    np.testing.assert_allclose(sliced.means.detach().numpy(), means, rtol=rtol, atol=rtol)
    np.testing.assert_allclose(covariances(sliced).numpy(), covs, rtol=rtol, atol=rtol)
    np.testing.assert_allclose(sliced.opacities.detach().numpy(), opacities, rtol=rtol, atol=rtol / 100)


# ---- 6DGS, 7DGS and N-DGS: the model, its options, the 1/2 of f_dir (None: a joint gate)

LAMBDAS = {"lambda_t": 0.4, "lambda_d": 0.4}
CONDITIONED: dict[str, tuple[str, dict[str, Any], float | None]] = {
    "6dgs": ("6dgs", MODELS["6dgs"], 1.0),
    "7dgs": ("7dgs", MODELS["7dgs"], 0.5),
    "7dgs_nodir": ("7dgs_nodir", MODELS["7dgs_nodir"], None),
    "6dgs, half": ("6dgs", MODELS["6dgs"] | {"directional_half": True}, 0.5),
    "7dgs, no half": ("7dgs", MODELS["7dgs"] | {"directional_half": False}, 1.0),
    "6dgs, unit": ("6dgs", {"lambda_d": 0.4, "unit_directions": True}, 0.5),
    "7dgs, unit and bounded": ("7dgs", LAMBDAS | {"unit_directions": True, "bounded_times": True}, 0.5),
    "7dgs_nodir, bounded": ("7dgs_nodir", {"lambda_t": 0.4, "bounded_times": True}, None),
    "ndgs": ("ndgs", LAMBDAS, None),
}


def conditioned(case: str, count: int = N, **more: Any) -> CholeskyModel:
    """A model of CONDITIONED in the midst of a training, in float64."""
    name, options, _ = CONDITIONED[case]
    model = moved(started(build(name, **options | more), count))
    return model


def by_hand(case: str, model: CholeskyModel, order: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means [N, 3], covariances [N, 3, 3] and opacities [N] of a model of CONDITIONED at QUERY."""
    name, options, half = CONDITIONED[case]
    values = {name: value.numpy() for name, value in raw(model).items()}
    lambdas = {key: model.lambda_of(key).item() for key in model.log_lambda}
    variables = "p" + "t" * ("times" in values) + "d" * ("directions" in values)
    letters = "".join(x * (1 if x == "t" else 3) for x in order if x in variables)
    p, t, d = ([i for i, x in enumerate(letters) if x == which] for which in "ptd")
    below, means, covs, opacities = model.layout.join(raw(model)).numpy(), [], [], []
    for i, mean in enumerate(values["means"]):
        L, entries = np.diag(np.exp(values["log_diagonal"][i])), iter(below[i])
        for row in range(len(L)):  # off-diagonals row by row
            for column in range(row):
                L[row, column] = next(entries)
        if model.layout.form == "relative":
            L[np.ix_(p, p)] = np.diag(L.diagonal()[p]) @ (np.tril(L[np.ix_(p, p)], -1) + np.eye(3))
        S, offset_t, offset_d = L @ L.T, np.zeros(0), np.zeros(0)
        if d:
            mu_d = values["directions"][i]
            mu_d = mu_d / np.linalg.norm(mu_d) if name == "ndgs" or "unit_directions" in options else mu_d
            offset_d = (mean - CAMERA.numpy()) / np.linalg.norm(mean - CAMERA.numpy()) - mu_d
        if t:
            mu_t = values["times"][i]
            offset_t = TIME - (1 / (1 + np.exp(-mu_t)) if name == "ndgs" or "bounded_times" in options else mu_t)
        q, offset = t + d, np.concatenate([offset_t, offset_d])
        K = S[np.ix_(p, q)] @ np.linalg.inv(S[np.ix_(q, q)])
        means.append(mean + K @ offset)
        covs.append(S[np.ix_(p, p)] - K @ S[np.ix_(q, p)])
        if name == "ndgs":
            exponent = lambdas["time"] * offset @ np.linalg.inv(S[np.ix_(q, q)]) @ offset
        else:
            exponent = half * lambdas["direction"] * offset_d @ np.linalg.inv(S[np.ix_(d, d)]) @ offset_d if d else 0.0
            exponent += 0.5 * lambdas["time"] * offset_t[0] ** 2 / S[t[0], t[0]] if t else 0.0
        opacities.append(math.exp(-exponent) / (1 + math.exp(-values["opacities"][i])))
    return np.stack(means), np.stack(covs), np.array(opacities)


@pytest.mark.parametrize("form", ["relative", "raw"])
@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("case", CONDITIONED)
def test_cholesky_models(case, order, scheme, form):
    """Catches a wrong row order, a conditional block where f_temp or f_dir takes the marginal one or a marginal one in
    the joint gate, a wrong lambda or 1/2, a raw direction or time; the kernels get means as they are sliced."""
    model = conditioned(case, factor_order=order, scheme=scheme, off_diagonal=form)
    expected = by_hand(case, model, ORDERS[order])
    agree(model.slice(QUERY), *expected)
    if scheme == "square_root":
        agree(model.float().slice(CameraTime.at(CAMERA.float(), TIME)), *expected, rtol=1e-4)


@pytest.mark.parametrize("name", CHOLESKY)
@pytest.mark.parametrize("order", ORDERS)
def test_far_from_the_query(name, order):
    """Catches 0 x inf in the gradient of a Gaussian so thin in t or d that nothing of it is seen (float32)."""
    model = fresh(name, factor_order=order)
    for kind in model.layout.kinds:
        model.splats[kind].data.normal_(generator=seeded(1))
    model.splats["log_diagonal"].data.fill_(-30.0)
    sliced = model.slice(CameraTime.at(CAMERA.float(), TIME))
    sum(x.sum() for x in tensors_of(sliced)).backward()
    assert all(x.isfinite().all() for x in tensors_of(sliced))
    assert all(p.grad.isfinite().all() for p in model.splats.values())


def test_what_a_joint_gate_leaves_of_a_frozen_gaussian():
    """Catches a gate that is divided into marginal parts: what stays of time, and of both, is by formula; and a second
    lambda, which would be ignored or trained without a gradient."""
    model = conditioned("ndgs")
    assert [math.exp(x) for x in model.log_lambda.values()] == pytest.approx([0.4])
    assert len(build("ndgs", lambda_t=0.1, lambda_d=0.2, joint_gate=False).log_lambda) == 2
    values, S = raw(model), joint(model)
    whole, delta = torch.from_numpy(by_hand("ndgs", model, "dtp")[2]), model.offset(values, QUERY)
    along = torch.linalg.vecdot(delta[:, :3], torch.linalg.solve(S[:, 3:6, 3:6], delta[:, :3]))
    of_time, of_direction = torch.exp(-0.4 * delta[:, 3].square() / S[:, 6, 6]), torch.exp(-0.4 * along)
    frozen = model.frozen(values, [QUERY], torch.ones(1, len(model), dtype=torch.float64))
    remaining = {"direction": of_time, "time": of_direction, "static": torch.ones_like(of_time)}
    assert frozen.keys() == remaining.keys()
    for name, factor in remaining.items():
        opacities = torch.sigmoid(frozen[name]["opacities"])
        torch.testing.assert_close(opacities, (whole / factor).clamp(min=1e-6), rtol=1e-5, atol=1e-9)
    still = model.slice_geometry(values | frozen["direction"], QUERY).opacities  # of one view, the mean is itself
    torch.testing.assert_close(still[whole > 2e-6], whole[whole > 2e-6], rtol=1e-4, atol=1e-9)


# ---- 4DGS


def rotor_factor(left: np.ndarray, right: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """R S over (x, y, z, t), R v = l v conj(r) with v = (x, y, z, t) read as the quaternion x + y i + z j + t k."""

    def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.r_[a[0] * b[0] - a[1:] @ b[1:], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])]

    left, right = left / np.linalg.norm(left), right / np.linalg.norm(right) * [1, -1, -1, -1]
    return np.stack([product(product(left, e), right) for e in np.eye(4)], -1) * np.exp(scales)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_4dgs(scheme):
    """Catches a wrong slice of (R S)(R S)^T at t, a lambda_t that is ignored or not 1, and the opacity's exponent."""
    assert build("4dgs").lambda_of("time") == 1
    model = lively("4dgs", scheme=scheme)
    model.clock.fill_(0.8)  # world units that correspond to the time range
    model.splats["times"].data[:4] += 3  # too far to be drawn
    values = {name: value.numpy() for name, value in raw(model).items()}
    means, covs, opacities = [], [], []
    for i, mean in enumerate(values["means"]):
        F = rotor_factor(values["left_quats"][i], values["right_quats"][i], values["scales"][i])
        S, offset = F @ F.T, (TIME - values["times"][i, 0]) * model.clock.item()
        f = math.exp(-0.5 * model.lambda_of("time").item() * offset**2 / S[3, 3])
        means.append(mean + S[:3, 3] / S[3, 3] * offset * (f > 0.05))  # what is not drawn stays at mu_p
        covs.append(S[:3, :3] - np.outer(S[:3, 3], S[:3, 3]) / S[3, 3])
        opacities.append((f if f > 0.05 else 0.0) / (1 + math.exp(-values["opacities"][i])))
    agree(model.slice(QUERY), np.stack(means), np.stack(covs), np.array(opacities))
    assert 0 < opacities.count(0) < N


def test_4dgs_leaves_out_what_is_far_in_time():
    """Catches another threshold than f_temp > 0.05, and a size that is not the largest one in space."""
    model = fresh("4dgs").double()
    sigma = math.sqrt(1 / 5) / math.sqrt(MODELS["4dgs"]["lambda_t"])
    for factor, drawn in [(1 - 1e-4, True), (1 + 1e-4, False)]:
        model.splats["times"].data.fill_(TIME + factor * sigma * math.sqrt(-2 * math.log(0.05)))
        assert ((model.slice(QUERY).opacities > 0) == drawn).all()
    assert TIME_OPACITY_FACTOR_MIN == 0.05
    model.splats["scales"].data[:] = torch.tensor([0.0, 1.0, -1.0, 5.0])
    assert model.scales().tolist() == pytest.approx([math.e] * N)


def test_4dgs_that_is_long_in_time_keeps_its_digits():
    """Catches a reflection in float32 that loses what is thin in space: a Gaussian lasts 10^5 times its size."""
    model = lively("4dgs", 400)
    model.splats["scales"].data += torch.tensor([-5.0, -5, -5, 7])
    model.backend = REFERENCE
    exact = covariances(model.slice(QUERY)).flatten(1)
    single = model.float().slice(CameraTime.at(CAMERA.float(), TIME))
    error = (covariances(single).flatten(1) - exact).norm(dim=1) / exact.norm(dim=1)
    assert error.median() < 1e-6
    assert error.max() < 1e-3


# ---- all models that the audit of stability knows


@pytest.mark.parametrize("model", [*slices.JOINT, *slices.MOVING])
def test_what_mpmath_has_by_another_program(model):
    """Catches any wrong line of an equation or a coupling, exp for softplus, and a gradient by the mean through the
    direction of dGS and dBS."""
    assert population.verify(CASES["ordinary_gaussians"](model=model), 3) < 1e-9


@pytest.mark.parametrize("name", ["dgs", "ex4dgs", "freetime", "freetime_plus", "sharptime", "stg"])
def test_a_frozen_gaussian_is_the_mean_over_views(name):
    """Catches weights that are forgotten, and an opacity or a mean that is the one of a single view."""
    model, queries = lively(name, 100), [CameraTime.at(CAMERA, 0.2), CameraTime.at(-CAMERA, 0.7)]
    weights = torch.tensor([0.25, 0.75], dtype=torch.float64)[:, None].expand(2, len(model))
    static = raw(model) | model.frozen(raw(model), queries, weights)["static"]
    first, second = (model.slice(query) for query in queries)
    torch.testing.assert_close(static["means"], (0.25 * first.means + 0.75 * second.means).detach())
    opacities = (0.25 * first.opacities + 0.75 * second.opacities).clamp(1e-6).detach()
    torch.testing.assert_close(torch.sigmoid(static["opacities"]), opacities)


# ---- UBS, and what dBS shares with it

DIRECTION = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
FROM_ORIGIN = CameraTime(-DIRECTION, torch.tensor(0.7, dtype=torch.float64))  # from there, the origin is in DIRECTION
PROFILES = ("ubs", "ubs_static", "dbs", "dbs_static")


def profiles(name: str, count: int = 30, **options: Any) -> tuple[BetaModel, Raw]:
    model = lively(name, count, **options)
    return model, {key: value.detach() for key, value in model.splats.items()}


@pytest.mark.parametrize("name", ["ubs", "ubs_static"])
@pytest.mark.parametrize("modulation", ["whitened", "raw"])
def test_exponents_of_four_condition_a_gaussian(name, modulation):
    """Catches a covariance whose rows are in another order than the query, and a mean that B changes where B = I."""
    model, raw = profiles(name, modulation=modulation)
    raw["betas"][:, 1:] = 0.5  # b = 6.6, of which B takes at most 4 / 4
    sliced = model.condition(raw, FROM_ORIGIN)
    q = [unit(raw["means"] - FROM_ORIGIN.center), torch.full((30, 1), 0.7)][: len(model.observes)]
    mean = torch.cat([raw["means"], raw["directions"], *([raw["times"]] if "times" in raw else [])], -1)
    expected = slice_gaussians(mean, joint_factor(raw), torch.cat(q, -1))
    torch.testing.assert_close(sliced.means, expected.mean)
    torch.testing.assert_close(covariances(sliced), expected.factor @ expected.factor.mT)


def test_both_modulations_agree_where_every_exponent_is_the_same():
    """Catches B on the wrong side of the whitening, and a covariance that loses the part I - B."""
    slices = []
    for modulation in ("whitened", "raw"):
        model, raw = profiles("ubs", modulation=modulation)
        raw["betas"][:, 1:] = -0.7
        slices.append(model.condition(raw, FROM_ORIGIN))
    torch.testing.assert_close(slices[0].means, slices[1].means)
    torch.testing.assert_close(*map(covariances, slices))


def test_the_whitened_covariance_is_definite_and_the_raw_one_is_not():
    """Catches a mix-up of the two: only the covariance of the authors' code can be indefinite, and is then flat."""
    flat = {}
    for modulation in ("whitened", "raw"):
        model, raw = profiles("ubs", 200, modulation=modulation)
        raw["lower"] *= 10
        raw["betas"][:, 1:] = 2 * torch.randn(200, 4, generator=seeded(1)).double() - 1
        flat[modulation] = int((torch.linalg.det(model.factors(raw)) == 0).sum())
    assert flat["whitened"] == 0
    assert flat["raw"] > 10


def test_opacity_factors_neither_cancel_nor_vanish():
    """Catches 1 - tanh(y^2) = 0 in float32 with a logarithm of -inf, and a floor other than the authors'."""
    y = torch.tensor([[0.0], [0.5], [3.5], [1e6]], requires_grad=True)
    factors = opacity_factor(y, torch.full((4, 2), math.log(0.05)))  # exponents 0.2
    expected = torch.tensor([1.0, (1 - math.tanh(0.25)) ** 0.2, 1.2e-7**0.2, 1.2e-7**0.2])
    torch.testing.assert_close(factors, expected)
    factors.sum().backward()
    assert y.grad.isfinite().all()


@pytest.mark.parametrize("name", PROFILES)
def test_profiles_start_as_their_authors_start(name):
    """Catches directions that are unit vectors, and view exponents of 4 in a model with time."""
    model = fresh(name, 500)
    assert -1 <= model.splats["directions"].min() < -0.9
    dynamic = "time" in model.observes
    assert model.splats["betas"].unique(dim=0).tolist() == [[0.0, *[-3.0 if dynamic else 0.0] * 3, *[0.0] * dynamic]]
    exponents = model.slice(CameraTime.at(CAMERA.float(), 0.3)).beta_exponents
    assert exponents.unique().tolist() == [4.0]


@pytest.mark.parametrize("name", PROFILES)
def test_children_of_profiles_look_1_6_times_smaller(name):
    """Catches children of another profile, means that are drawn from the support, nearly three times too wide, and a
    minimum size that is that of the support: what looks like a Gaussian has to be as large as asked."""
    model, raw = profiles(name, 4)
    rows = {key: value[:1].repeat(4000, *[1] * (value.dim() - 1)) for key, value in raw.items()}
    if "lower" in raw:
        rows["lower"] = rows["lower"] * 0  # so that nothing but the sizes is in the slice
    children = model.split(rows, seeded(0))
    F, b = model.factors(rows)[0], 4 * math.exp(float(raw["betas"][0, 0]))
    drawn = (children["means"] - rows["means"]).T.cov()
    torch.testing.assert_close(drawn, F @ F.T / (2 * b), rtol=0.15, atol=float((F @ F.T).max()) * 0.01)
    torch.testing.assert_close(model.factors(rows | children)[0], F / 1.6)
    model.hold_sizes(torch.full((4,), 0.7, dtype=torch.float64))
    assert (model.scales() >= 0.699).all()

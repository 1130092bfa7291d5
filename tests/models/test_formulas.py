"""The slices of 4DGS, 6DGS and 7DGS against METHODS' formulas, in numpy float64 with explicit inverses."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from small import CAMERA, MODELS, TRIANGULAR, N, fresh, joint, lively, raw, seeded

from gsbench.models import CameraTime, GaussianModel, Gaussians3D, build
from gsbench.models.gaussian_batch import tensors_of
from gsbench.models.gaussians4d import TIME_OPACITY_FACTOR_MIN

TIME = 0.45
ORDERS = {"paper": "ptd", "conditioned_first": "dtp"}
SCHEMES = ("square_root", "schur", "cholesky")


def triangular_factor(log_diagonal: np.ndarray, off_diagonal: np.ndarray) -> np.ndarray:
    """exp on the diagonal, the rest row by row below it."""
    n = len(log_diagonal)
    L, entries = np.diag(np.exp(log_diagonal)), iter(off_diagonal)
    for i in range(n):
        for j in range(i):
            L[i, j] = next(entries)
    return L


def by_hand(model: GaussianModel, order: str, half: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means [N, 3], covariances [N, 3, 3] and opacities [N] of a model of TRIANGULAR at CAMERA and TIME."""
    values = {name: value.numpy() for name, value in raw(model).items()}
    there = "p" + "t" * ("times" in values) + "d" * ("directions" in values)
    letters = "".join(x * (1 if x == "t" else 3) for x in order if x in there)
    p, t, d = ([i for i, x in enumerate(letters) if x == which] for which in "ptd")
    below, form = model.layout.join(raw(model)).numpy(), model.layout.form
    means, covariances, opacities = [], [], []
    for i, mean in enumerate(values["means"]):
        L = triangular_factor(values["log_diagonal"][i], below[i])
        if form == "relative":
            L[np.ix_(p, p)] = np.diag(L.diagonal()[p]) @ (np.tril(L[np.ix_(p, p)], -1) + np.eye(3))
        S = L @ L.T
        away = mean - CAMERA.numpy()
        offset_d = away / np.linalg.norm(away) - values["directions"][i] if d else np.zeros(0)
        offset_t = TIME - values["times"][i] if t else np.zeros(0)
        q, offset = t + d, np.concatenate([offset_t, offset_d])
        K = S[np.ix_(p, q)] @ np.linalg.inv(S[np.ix_(q, q)])
        means.append(mean + K @ offset)
        covariances.append(S[np.ix_(p, p)] - K @ S[np.ix_(q, p)])
        exponent = 0.0
        if d:
            exponent = half * model.lambda_of("direction").item() * offset_d @ np.linalg.inv(S[np.ix_(d, d)]) @ offset_d
        if t:
            exponent += 0.5 * model.lambda_of("time").item() * offset_t[0] ** 2 / S[t[0], t[0]]
        opacities.append(math.exp(-exponent) / (1 + math.exp(-values["opacities"][i])))
    return np.stack(means), np.stack(covariances), np.array(opacities)


def agree(sliced: Gaussians3D, means: np.ndarray, covariances: np.ndarray, opacities: np.ndarray) -> None:
    np.testing.assert_allclose(sliced.means.detach().numpy(), means, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose((sliced.factors @ sliced.factors.mT).detach().numpy(), covariances, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(sliced.opacities.detach().numpy(), opacities, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("form", ["relative", "raw"])
@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("name", TRIANGULAR)
def test_triangular_models(name: str, order: str, scheme: str, form: str) -> None:
    """Catches a wrong row order, a conditional block where f_temp or f_dir takes the marginal one, a wrong lambda."""
    model = lively(name, factor_order=order, scheme=scheme, off_diagonal=form)
    agree(model.slice(CameraTime.at(CAMERA, TIME)), *by_hand(model, ORDERS[order], 1.0 if name == "6dgs" else 0.5))


@pytest.mark.parametrize("half", [True, False])
@pytest.mark.parametrize("name", ["6dgs", "7dgs"])
def test_directional_half(name: str, half: bool) -> None:
    """Catches the 1/2 of 7DGS in 6DGS, or its option without effect; the 1/2 of f_temp stays."""
    model = lively(name, directional_half=half)
    agree(model.slice(CameraTime.at(CAMERA, TIME)), *by_hand(model, "dtp", 0.5 if half else 1.0))
    assert MODELS["6dgs"]["directional_half"] is False


@pytest.mark.parametrize("name", TRIANGULAR)
def test_factor_orders_are_coordinates_of_one_family(name: str) -> None:
    """Catches an order that is another model: the same covariance, written in either, gives the same slice."""
    paper, first = lively(name, factor_order="paper"), lively(name, seed=3, factor_order="conditioned_first")
    for key, value in raw(paper).items():
        first.splats[key].data = value
    n = joint(paper).shape[-1]
    to_own = [*range(3, n), 0, 1, 2]  # from (p, d, t) to (d, t, p)
    factor = paper.factors(raw(paper))[:, to_own]
    for key, value in first.layout.parameters(factor).items():
        first.splats[key].data = value
    torch.testing.assert_close(joint(first), joint(paper))
    a, b = paper.slice(CameraTime.at(CAMERA, TIME)), first.slice(CameraTime.at(CAMERA, TIME))
    covariance = (a.factors @ a.factors.mT).detach().numpy()
    agree(b, a.means.detach().numpy(), covariance, a.opacities.detach().numpy())


@pytest.mark.parametrize("name", TRIANGULAR)
@pytest.mark.parametrize("order", ORDERS)
def test_far_from_the_query(name: str, order: str) -> None:
    """Catches 0 x inf in the gradient of a Gaussian so thin in t or d that nothing of it is seen (float32)."""
    model = fresh(name, factor_order=order)
    for kind in model.layout.kinds:
        model.splats[kind].data.normal_(generator=seeded(1))
    model.splats["log_diagonal"].data.fill_(-30.0)
    sliced = model.slice(CameraTime.at(CAMERA.float(), TIME))
    sum(x.sum() for x in tensors_of(sliced)).backward()
    assert all(x.isfinite().all() for x in tensors_of(sliced))
    assert all(p.grad.isfinite().all() for p in model.splats.values())


# ---- 4DGS


def rotor_factor(left: np.ndarray, right: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """R S over (x, y, z, t), R v = l v conj(r) with v = (x, y, z, t) read as the quaternion x + y i + z j + t k."""

    def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.r_[a[0] * b[0] - a[1:] @ b[1:], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])]

    left, right = left / np.linalg.norm(left), right / np.linalg.norm(right) * [1, -1, -1, -1]
    return np.stack([product(product(left, e), right) for e in np.eye(4)], -1) * np.exp(scales)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_4dgs(scheme: str) -> None:
    """Catches a wrong slice of (R S)(R S)^T at t, a lambda_t that is ignored or not 1 by default, and the opacity
    factor's exponent."""
    assert build("4dgs").lambda_of("time") == 1
    model = lively("4dgs", scheme=scheme)
    model.splats["times"].data[:4] += 3  # too far to be drawn
    values = {name: value.numpy() for name, value in raw(model).items()}
    means, covariances, opacities = [], [], []
    for i, mean in enumerate(values["means"]):
        F = rotor_factor(values["left_quats"][i], values["right_quats"][i], values["scales"][i])
        S, offset = F @ F.T, (TIME - values["times"][i, 0]) * model.clock.item()
        f = math.exp(-0.5 * model.lambda_of("time").item() * offset**2 / S[3, 3])
        means.append(mean + S[:3, 3] / S[3, 3] * offset * (f > 0.05))  # what is not drawn stays at mu_p
        covariances.append(S[:3, :3] - np.outer(S[:3, 3], S[:3, 3]) / S[3, 3])
        opacities.append((f if f > 0.05 else 0.0) / (1 + math.exp(-values["opacities"][i])))
    agree(model.slice(CameraTime.at(CAMERA, TIME)), np.stack(means), np.stack(covariances), np.array(opacities))
    assert 0 < opacities.count(0) < N


@pytest.mark.parametrize("native", [False, True])
def test_4dgs_is_the_same_in_metres_and_centimetres(native: bool) -> None:
    """Catches a rotation of space into time whose angle is a speed in one unit of length only."""
    dtype = torch.float32 if native else torch.float64
    model, larger = lively("4dgs").to(dtype), lively("4dgs").to(dtype)
    larger.clock *= 100
    for name, times, plus in (("means", 100.0, 0.0), ("scales", 1.0, math.log(100.0))):
        larger.splats[name].data.mul_(times).add_(plus)
    a, b = model.slice(CameraTime.at(CAMERA.to(dtype), TIME)), larger.slice(CameraTime.at(100 * CAMERA.to(dtype), TIME))
    torch.testing.assert_close(100 * a.means, b.means, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(100 * a.factors @ a.factors.mT, b.factors @ b.factors.mT / 100, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(a.opacities, b.opacities, rtol=1e-4, atol=1e-6)


def test_4dgs_leaves_out_what_is_far_in_time() -> None:
    """Catches another threshold than f_temp > 0.05."""
    model = fresh("4dgs").double()
    sigma = math.sqrt(1 / 5) / math.sqrt(MODELS["4dgs"]["lambda_t"])
    for factor, drawn in [(1 - 1e-4, True), (1 + 1e-4, False)]:
        model.splats["times"].data.fill_(TIME + factor * sigma * math.sqrt(-2 * math.log(0.05)))
        assert ((model.slice(CameraTime.at(CAMERA, TIME)).opacities > 0) == drawn).all()
    assert TIME_OPACITY_FACTOR_MIN == 0.05


def test_4dgs_at_a_time_of_its_own_is_3dgs() -> None:
    """Catches 4D rotations that do not contain the 3D ones: without any turn into t, the slice is R S in 3D."""
    model = lively("4dgs")
    q = model.splats["left_quats"].data
    # v -> l v conj(r) leaves the t axis (k) alone where r = -k l k: the rotation then acts on x, y, z only.
    model.splats["right_quats"].data = q * torch.tensor([1.0, -1, -1, 1])
    F = model.factors(raw(model)).numpy()
    np.testing.assert_allclose(F[:, 3, :3], 0, atol=1e-12)
    np.testing.assert_allclose(F[:, :3, 3], 0, atol=1e-12)
    R = F[:, :3, :3] / np.exp(raw(model)["scales"].numpy())[:, None, :3]
    assert np.abs(Rotation.from_matrix(R).as_matrix() - R).max() < 1e-9
    sliced = model.slice(CameraTime.at(CAMERA, TIME))
    covariance = (sliced.factors @ sliced.factors.mT).detach().numpy()
    np.testing.assert_allclose(covariance, F[:, :3, :3] @ F[:, :3, :3].swapaxes(1, 2), atol=1e-12)
    torch.testing.assert_close(sliced.means.data, model.splats["means"].data)

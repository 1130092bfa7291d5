"""Slices by the kernels against the models written in torch, with all rows conditioned, with some, with none."""

from itertools import product
from typing import Any

import pytest
import torch
from sliced_models import CASES, CENTER, TIME, assert_same, gradients, slice_of, sliced_model, weights_of

from gsbench.errors import InputError
from gsbench.kernels.backends import AUTO, REFERENCE
from gsbench.kernels.slices import slice_free_time, slice_rotated, slice_static, slice_triangular
from gsbench.models.camera_time import CameraTime, together
from gsbench.models.effect_sets import EffectSets
from gsbench.models.gaussian_batch import tensors_of

SHARES = (0.0, 0.03, 0.5, 0.98, 1.0)  # of 45 rows 0, 1, 22, 44 and all
WITHOUT_KERNEL: list[tuple[str, dict[str, Any]]] = [
    ("7dgs", {"scheme": "schur"}),
    ("4dgs", {"scheme": "schur"}),
    ("ubs", {"modulation": "raw"}),
    ("dgs", {"coupling": "none"}),
    ("dgs", {"coupling": "interpolated"}),
]
# Models whose kernels slice several views in one call, with the same parameters for all views and others for each; 3DGS
# without the latter has one slice for all views.
SEVERAL_VIEWS = [
    (name, options, per_view)
    for (name, options), per_view in product(CASES, (False, True))
    if options.get("scheme") != "cholesky"
    and name not in ("freetime_plus", "stg", "stg_full", "ex4dgs")
    and (name != "3dgs" or per_view)
]
CONDITIONED = [(name, options) for name, options in CASES if name not in ("3dgs", "ubs", "ubs_static")]


@pytest.mark.parametrize(("name", "options"), CASES)
def test_slice(name, options, place):
    """Catches a wrong row order, reflection, opacity factor, size that does not stop, or derivative by a parameter."""
    exact, raw = sliced_model(name, options, torch.float64)
    expected = slice_of(exact, raw)
    model, _ = sliced_model(name, options, torch.float32)
    model, single = model.to(place.device), {key: place.move(x) for key, x in raw.items()}
    if place.name == "cuda" and options.get("scheme") == "cholesky":
        with pytest.raises(InputError, match="expected the square-root scheme on a GPU"):
            slice_of(model, single)
        return
    actual = slice_of(model, single)
    assert_same(actual, expected)
    assert_same(
        gradients(actual, [*single.values(), *model.log_lambda.parameters()]),
        gradients(expected, [*raw.values(), *exact.log_lambda.parameters()]),
    )


@pytest.mark.parametrize(("name", "options"), CONDITIONED)
@pytest.mark.parametrize("share", SHARES)
def test_static_rows(name, options, share, place):
    """Catches a static row that reads a column of time or direction, fades, or has a gradient by what it lacks."""
    if place.name == "cuda" and options.get("scheme") == "cholesky":
        pytest.skip("refused on a GPU")
    exact, raw = sliced_model(name, options, torch.float64)
    model, _ = sliced_model(name, options, torch.float32)
    model, single = model.to(place.device), {key: place.move(x) for key, x in raw.items()}
    count = round(share * len(raw["means"]))
    whole = slice_of(model, single)
    exact.effect_sets = model.effect_sets = EffectSets(0, count, None)
    expected, actual = slice_of(exact, raw), slice_of(model, single)
    for x, y in zip(actual, whole, strict=True):
        assert torch.equal(x[:count], y[:count])
    assert count == len(actual[0]) or not torch.equal(actual[0][count:], whole[0][count:])
    want = gradients(expected, [*raw.values(), *exact.log_lambda.parameters()])
    got = gradients(actual, [*single.values(), *model.log_lambda.parameters()])
    assert_same(actual, expected)
    assert_same(got, want)
    for x, y in zip(got[: len(raw)], want, strict=False):
        assert not x.cpu()[count:][y[count:] == 0].any(), "what a static row does not depend on has a gradient"


@pytest.mark.parametrize(("name", "options", "per_view"), SEVERAL_VIEWS)
def test_several_views_in_one_call(name, options, per_view, cuda_device):
    """Catches a view that reads the camera, time or parameters of another, and gradients that are not their sum."""
    model, raw = sliced_model(name, options, torch.float32)
    assert model.takes_views
    model.to(cuda_device)
    if (name, options) in CONDITIONED:
        model.effect_sets = EffectSets(0, 22, None)  # the other rows are static
    raw = {key: x.to(cuda_device) for key, x in raw.items()}
    many = {key: torch.stack([x, 1.1 * x, 0.9 * x]) if per_view and key != "opacities" else x for key, x in raw.items()}
    many = {key: x.detach().requires_grad_() for key, x in many.items()}
    views = [CameraTime((CENTER + 0.3 * i).to(cuda_device), (TIME + 0.1 * i).to(cuda_device)) for i in range(3)]
    outputs = tensors_of(model.slice_geometry(many, together(views)))
    weights, expected = weights_of(outputs), {}
    for i, view in enumerate(views):
        single = {
            key: (x[i] if per_view and key != "opacities" else x).detach().requires_grad_() for key, x in many.items()
        }
        of_single = tensors_of(model.slice_geometry(single, view))
        for x, y in zip(outputs, of_single, strict=True):
            assert torch.equal(x[i], y)
        gradients = torch.autograd.grad(of_single, single.values(), [w[i] for w in weights])
        for key, gradient in zip(single, gradients, strict=True):
            expected.setdefault(key, []).append(gradient)
    for (key, x), gradient in zip(many.items(), torch.autograd.grad(outputs, many.values(), weights), strict=True):
        parts = expected[key]
        want = torch.stack(parts) if x.shape != raw[key].shape else sum(parts[1:], parts[0])
        assert torch.equal(gradient, want), key


@pytest.mark.usefixtures("instruction_set")
def test_opacities_of_the_largest_logits():
    """Catches exp2 beyond the exponents of float32: without AVX-512, the opacity of a logit of -100 was 1."""
    logits = torch.tensor([-1e30, -200.0, -150.0, -128.0, -100.0, -90.0, -88.0, -80.0, 0.0, 80.0, 100.0, 200.0, 1e30])
    quats = torch.eye(4)[:1].expand(len(logits), 4).contiguous()
    _, opacities = slice_static(torch.zeros(len(logits), 3), quats, logits)
    torch.testing.assert_close(opacities, torch.sigmoid(logits), rtol=1e-5, atol=1e-30)


@pytest.mark.usefixtures("instruction_set")
def test_sizes_of_beta_profiles_keep_their_digits():
    """Catches a softplus that loses the digits of small sizes, or that does not stop, with its derivative."""
    sizes = torch.tensor([-30.0, -15.0, -9.0, -4.0, -0.1, 0.0, 0.1, 4.0, 30.0, 1e7])
    results = []
    for dtype in (torch.float64, torch.float32):
        model, raw = sliced_model("dbs", {}, dtype)
        with torch.no_grad():
            raw["scales"][: len(sizes)] = sizes[:, None]
            raw["skew"].zero_()
        model.effect_sets = EffectSets(0, 0, None)
        factors = slice_of(model, raw)[1][: len(sizes)]
        (slopes,) = torch.autograd.grad(factors.sum(), raw["scales"])
        results.append((factors.diagonal(dim1=1, dim2=2).double(), slopes[: len(sizes)].double()))
    for got, want in zip(results[1], results[0], strict=True):
        torch.testing.assert_close(got, want, rtol=1e-5, atol=0)


@pytest.mark.parametrize(("name", "options"), WITHOUT_KERNEL)
def test_an_option_without_a_kernel_is_sliced_in_torch(name, options):
    """Catches a kernel that slices by another formula than the option says."""
    model, raw = sliced_model(name, options, torch.float64)
    slices = []
    for backend in (AUTO, REFERENCE):
        model.backend = backend
        slices.append(slice_of(model.float(), {key: x.float() for key, x in raw.items()}))
    assert all(torch.equal(x, y) for x, y in zip(*slices, strict=True))


def test_arguments_are_taken_by_name():
    """Catches a default that is not all rows, an input in the place of another, and a name that is dropped."""
    _, raw = sliced_model("freetime", {}, torch.float32)
    by_name = {key: x for key, x in raw.items() if key in slice_free_time.inputs} | {"time": TIME}
    in_order = slice_free_time(*(by_name.get(key) for key in slice_free_time.inputs), len(raw["means"]))
    assert all(torch.equal(x, y) for x, y in zip(slice_free_time(**by_name), in_order, strict=True))
    with pytest.raises(InputError, match=r"slice_free_time: expected means, times, .*, got colours too"):
        slice_free_time(**by_name, colours=TIME)
    with pytest.raises(InputError, match="slice_free_time: expected quats as a tensor, got NoneType"):
        slice_free_time(**by_name | {"quats": None})


def test_arguments_that_do_not_fit_are_refused():
    """Catches a slice of nothing, and a prefix longer than the arrays, which a kernel would read past their end."""
    rows, none, by_default = torch.ones(2, 3), torch.ones(2, 0), (None, None, None)
    shape = (rows, rows, none, none, torch.ones(2), torch.zeros(3))
    with pytest.raises(InputError, match="expected directions, times or both, got neither"):
        slice_triangular(rows, None, None, *shape, *by_default, conditioned_first=True)
    model, raw = sliced_model("7dgs", {}, torch.float32)
    for count in (46, -1):
        model.effect_sets = EffectSets(0, count, None)
        with pytest.raises(InputError, match="conditioned: expected a number of rows from 0 to 45"):
            slice_of(model, raw)
    rotating, single = sliced_model("4dgs", {}, torch.float32)
    ordered = [single[key] for key in ("means", "times", "scales", "left_quats", "right_quats", "opacities")]
    with pytest.raises(InputError, match="conditioned"):
        slice_rotated(*ordered, rotating.clock, TIME, rotating.log_lambda["time"], conditioned=46)

"""Fused slicing, colours and refinement against the models written in torch."""

from typing import Any

import pytest
import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels import refine as refining
from gsbench.kernels.colors import show_colors
from gsbench.kernels.operation import EVERY_ROW
from gsbench.kernels.refine import refine
from gsbench.kernels.slices import slice_rotated, slice_static, slice_triangular, slice_universal
from gsbench.models import Query, build
from gsbench.models.appearance import sh_colors, sh_time_colors
from gsbench.models.factors import OFF_DIAGONALS
from gsbench.models.gaussians3d import Gaussians3DModel
from gsbench.models.gaussians4d import Gaussians4DModel
from gsbench.models.query import unit
from gsbench.models.refinement import Refinement
from gsbench.models.sliced import Geometry, tensors_of
from gsbench.models.triangular import TriangularModel
from gsbench.models.ubs import UniversalBetaModel

VARIANTS: list[tuple[str, dict[str, Any]]] = [
    ("7dgs", {}),
    ("7dgs", {"factor_order": "paper"}),
    ("7dgs", {"off_diagonal": "raw"}),
    ("7dgs", {"off_diagonal": "row_scaled"}),
    ("6dgs", {}),
    ("7dgs", {"factor_order": "paper", "off_diagonal": "raw"}),
    ("6dgs", {"factor_order": "paper", "off_diagonal": "row_scaled", "directional_half": False}),
    ("7dgs_nodir", {}),
    ("7dgs_nodir", {"factor_order": "paper"}),
    ("7dgs_nodir", {"off_diagonal": "row_scaled"}),
]
# The scheme that is there for comparison, where it keeps its digits.
SUBTRACTING: list[tuple[str, dict[str, Any]]] = [
    ("7dgs", {"scheme": "cholesky"}),
    ("7dgs", {"scheme": "cholesky", "factor_order": "paper"}),
    ("6dgs", {"scheme": "cholesky", "off_diagonal": "row_scaled"}),
    ("7dgs_nodir", {"scheme": "cholesky"}),
]


def model_and_raw(name: str, options: dict[str, Any], dtype: torch.dtype) -> tuple[TriangularModel, dict[str, Tensor]]:
    g = torch.Generator().manual_seed(1)
    k, N = {"7dgs": 4, "6dgs": 3, "7dgs_nodir": 1}[name], 37
    raw = {"means": torch.randn(N, 3, generator=g), "directions": torch.randn(N, 3, generator=g),
           "log_diagonal": 0.3 * torch.randn(N, k + 3, generator=g) - 0.5,
           "shape": 0.5 * torch.randn(N, 3, generator=g), "motion": 0.5 * torch.randn(N, 3 * k, generator=g),
           "coupling": 0.5 * torch.randn(N, k * (k - 1) // 2, generator=g),
           "opacities": 2 * torch.randn(N, generator=g)}  # fmt: skip
    if options.get("scheme") != "cholesky":
        raw["log_diagonal"][3:6] = -4.0  # so narrow that next to nothing is left of them
        raw["log_diagonal"][7:9, 0] = torch.tensor([17.0, -17.0])  # beyond where the diagonal stops
    lambdas = {"lambda_d": 0.3, "lambda_t": 0.5}
    if name == "6dgs":
        del lambdas["lambda_t"]
    else:
        raw["times"] = torch.rand(N, 1, generator=g)
    if name == "7dgs_nodir":
        del lambdas["lambda_d"], raw["directions"], raw["coupling"]
    model = build(name, **lambdas, **options)
    assert isinstance(model, TriangularModel)
    model.log_lambda.requires_grad_(True)
    return model.to(dtype), {k: v.to(dtype).requires_grad_() for k, v in raw.items()}


def lambda_of(model: TriangularModel, variable: str) -> Tensor | None:
    return model.log_lambda[variable] if variable in model.observes else None


def gradients(outputs: list[Tensor], inputs: list[Tensor]) -> list[Tensor]:
    g = torch.Generator().manual_seed(2)
    weights = [torch.randn(x.shape, generator=g).to(x) for x in outputs]
    return list(torch.autograd.grad(outputs, inputs, weights))


def assert_same(actual: list[Tensor], expected: list[Tensor]) -> None:
    for a, b in zip(actual, expected, strict=True):
        assert (a - b).norm() <= 1e-4 * b.norm() + 1e-7
        noise = 1e-6 * (b.abs().max() if b.numel() else 0) + 1e-12
        assert not ((a == 0) & (b.abs() > noise)).any(), "something is missing"
        assert not ((b == 0) & (a.abs() > noise)).any(), "something should be zero"


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize(("name", "options"), VARIANTS + SUBTRACTING)
def test_slice(name: str, options: dict[str, Any]) -> None:
    """Catches a wrong row order, reflection, opacity factor or derivative by a parameter, in every instruction set."""
    center = torch.tensor([0.3, -0.2, -3.0])
    exact, raw = model_and_raw(name, options, torch.float64)
    seen = exact.condition(raw, Query(center.double(), torch.tensor(0.4, dtype=torch.float64)))
    expected = [seen.means, seen.factors, torch.sigmoid(raw["opacities"]) * seen.opacity_factor]
    model, single = model_and_raw(name, options, torch.float32)
    lambdas = list(model.log_lambda.parameters())
    actual = list(slice_triangular(
        single["means"], single.get("directions"), single.get("times"), single["log_diagonal"], single["shape"],
        single["motion"], single.get("coupling", torch.empty(37, 0)), single["opacities"], center, torch.tensor(0.4),
        lambda_of(model, "direction"), lambda_of(model, "time"),
        conditioned_first=options.get("factor_order") != "paper", form=OFF_DIAGONALS.index(model.triangle.form),
        directional_half=model.directional_half, subtracts=model.scheme == "cholesky",
    ))  # fmt: skip
    assert_same(actual, expected)
    assert_same(gradients(actual, [*single.values(), *lambdas]),
                gradients(expected, [*raw.values(), *exact.log_lambda.parameters()]))  # fmt: skip


def rotated(dtype: torch.dtype) -> tuple[Gaussians4DModel, dict[str, Tensor]]:
    g = torch.Generator().manual_seed(4)
    N = 45
    raw = {"means": torch.randn(N, 3, generator=g), "times": torch.rand(N, 1, generator=g),
           "scales": 0.5 * torch.randn(N, 4, generator=g) - 1, "left_quats": torch.randn(N, 4, generator=g),
           "right_quats": torch.randn(N, 4, generator=g), "opacities": 2 * torch.randn(N, generator=g)}  # fmt: skip
    raw["scales"][:20] = -3.0  # short in time
    model = Gaussians4DModel(lambda_t=0.7)
    model.clock.fill_(0.8)
    model.log_lambda.requires_grad_(True)
    return model.to(dtype), {k: v.to(dtype).requires_grad_() for k, v in raw.items()}


@pytest.mark.usefixtures("instruction_set")
def test_rotated_slice() -> None:
    """Catches a wrong sign of a quaternion's matrix, row order, opacity factor or derivative of any parameter."""
    exact, raw = rotated(torch.float64)
    seen = exact.condition(raw, Query(torch.zeros(3, dtype=torch.float64), torch.tensor(0.4, dtype=torch.float64)))
    expected = [seen.means, seen.factors, torch.sigmoid(raw["opacities"]) * seen.opacity_factor]
    assert 0 < (seen.opacity_factor == 0).sum() < len(seen.opacity_factor)  # some are culled
    model, single = rotated(torch.float32)
    actual = list(slice_rotated(*single.values(), model.clock, torch.tensor(0.4), model.log_lambda["time"]))
    assert_same(actual, expected)
    assert_same(gradients(actual, [*single.values(), *model.log_lambda.parameters()]),
                gradients(expected, [*raw.values(), *exact.log_lambda.parameters()]))  # fmt: skip


def static(dtype: torch.dtype) -> dict[str, Tensor]:
    g = torch.Generator().manual_seed(5)
    raw = {"scales": 0.5 * torch.randn(45, 3, generator=g) - 1, "quats": torch.randn(45, 4, generator=g),
           "opacities": 2 * torch.randn(45, generator=g)}  # fmt: skip
    raw["scales"][3:5, 0] = torch.tensor([17.0, -17.0])  # beyond where sizes stop
    return {k: v.to(dtype).requires_grad_() for k, v in raw.items()}


@pytest.mark.usefixtures("instruction_set")
def test_opacities_of_the_largest_logits() -> None:
    """Catches exp2 beyond the exponents of float32: without AVX-512, the opacity of a logit of -100 was 1."""
    logits = torch.tensor([-1e30, -200.0, -150.0, -128.0, -100.0, -90.0, -88.0, -80.0, 0.0, 80.0, 100.0, 200.0, 1e30])
    _, found = slice_static(torch.zeros(len(logits), 3), torch.eye(4)[:1].expand(len(logits), 4).contiguous(), logits)
    torch.testing.assert_close(found, torch.sigmoid(logits), rtol=1e-5, atol=1e-30)


@pytest.mark.usefixtures("instruction_set")
def test_static_slice() -> None:
    """Catches a wrong sign of a rotation's entry, a size that does not stop, or a derivative, at a vector's end too."""
    raw, single = static(torch.float64), static(torch.float32)
    expected = [Gaussians3DModel.factors(raw), torch.sigmoid(raw["opacities"])]
    actual = list(slice_static(*single.values()))
    assert_same(actual, expected)
    assert_same(gradients(actual, list(single.values())), gradients(expected, list(raw.values())))


def universal(name: str, dtype: torch.dtype) -> tuple[UniversalBetaModel, dict[str, Tensor]]:
    g = torch.Generator().manual_seed(6)
    k, N = {"ubs": 4, "ubs_static": 3}[name], 45
    raw = {"means": torch.randn(N, 3, generator=g), "directions": torch.randn(N, 3, generator=g),
           "scales": torch.randn(N, 3 + k, generator=g) - 1, "skew": 0.5 * torch.randn(N, 3, generator=g),
           "lower": 0.5 * torch.randn(N, 3 * k + k * (k - 1) // 2, generator=g),
           "betas": torch.randn(N, 1 + k, generator=g) - 1, "opacities": 2 * torch.randn(N, generator=g)}  # fmt: skip
    raw["betas"][:3] = 0.0  # the root of I - B is zero
    raw["betas"][3:5] = torch.tensor([17.0, -17.0])[:, None]  # beyond where exponents stop
    raw["scales"][5:7, 0] = torch.tensor([-7.0, -17.0])  # a size that 1 + e^x would round; one that stops
    raw["scales"][7:9, 3:] = -5.0  # so narrow that opacity factors are at their least
    if name == "ubs":
        raw["times"] = torch.rand(N, 1, generator=g)
    model = build(name)
    assert isinstance(model, UniversalBetaModel)
    return model, {key: x.to(dtype).requires_grad_() for key, x in raw.items()}


def covariances(geometry: Geometry) -> list[Tensor]:
    """What is the same for every square factor F of F F^T."""
    means, factors, *rest = tensors_of(geometry)
    return [means, factors @ factors.mT, *rest]


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("name", ["ubs", "ubs_static"])
def test_universal_slice(name: str) -> None:
    """Catches a reflection that loses a column of direction or time, a wrong B, a size that does not stop, or a wrong
    derivative, at a vector's end too."""
    center = torch.tensor([0.3, -0.2, -3.0])
    exact, raw = universal(name, torch.float64)
    query = Query(center.double(), torch.tensor(0.4, dtype=torch.float64))
    expected = covariances(exact.slice_geometry(raw, query))
    _, single = universal(name, torch.float32)
    actual = covariances(Geometry(*slice_universal(
        single["means"], single["directions"], single.get("times"), single["scales"], single["skew"], single["lower"],
        single["betas"], single["opacities"], center, torch.tensor(0.4),
    )))  # fmt: skip
    assert_same(actual, expected)
    assert_same(gradients(actual, list(single.values())), gradients(expected, list(raw.values())))


@pytest.mark.usefixtures("threads")
def test_threads_do_not_change_a_universal_slice() -> None:
    """Catches gradients that two threads add to the same row."""
    model, raw = universal("ubs", torch.float32)
    many = {key: x.detach().repeat(30, *[1] * (x.dim() - 1)).requires_grad_() for key, x in raw.items()}
    found = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        seen = list(model.slice_geometry(many, Query.at(torch.tensor([0.3, -0.2, -3.0]), 0.4)))
        found.append([*seen, *gradients(seen, list(many.values()))])
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


def color_inputs(waves: int, dtype: torch.dtype, N: int = 21) -> list[Tensor]:
    g = torch.Generator().manual_seed(3)
    shapes = [(N, 1, 3), (N, 16 * waves - 1, 3), (N, 3), (N, 1)]
    return [torch.randn(shape, generator=g).to(dtype).requires_grad_() for shape in shapes]


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("waves", [1, 3])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colors(degree: int, waves: int) -> None:
    """Catches a wrong harmonic, wave or derivative, and coefficients of degrees not yet in use that get a gradient."""
    center, opacities = torch.tensor([0.1, 0.2, -2.0]), torch.ones(21)
    sh0, shN, means, times = color_inputs(waves, torch.float64)
    directions = unit(means - center.double())
    all_of = torch.cat([sh0, shN], 1)
    if waves == 1:
        expected, inputs = sh_colors(all_of, directions, degree), 3
    else:
        expected, inputs = sh_time_colors(all_of.unflatten(1, (waves, 16)), directions, degree, 0.7 - times[:, 0]), 4
    single = color_inputs(waves, torch.float32)
    timed = (single[3], torch.tensor(0.7)) if waves > 1 else (None, None)
    actual = show_colors(*single[:3], opacities, center, degree, *timed, waves)
    assert_same([actual], [expected])
    g_exact = torch.autograd.grad(expected, (sh0, shN, means, times)[:inputs], torch.ones_like(expected),
                                  materialize_grads=True)  # fmt: skip
    assert_same(list(torch.autograd.grad(actual, single[:inputs], torch.ones_like(actual))), list(g_exact))


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("degree", [1, 3])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_what_cannot_be_drawn_has_no_color(share: float, degree: int) -> None:
    """Catches culling that is not exact (colours are left out below 1/255 only, and then get no gradient), and
    gradients that are not written, or in the wrong row, as the drawn are packed: chunks end within runs of either."""
    N, center, time = 1100, torch.tensor([0.1, 0.2, -2.0]), torch.tensor(0.7)
    inputs = color_inputs(3, torch.float32, N)
    random = torch.Generator().manual_seed(1)
    drawn = torch.rand(N, generator=random) < share
    colors, everything = (
        show_colors(*inputs[:3], opacities, center, degree, inputs[3], time, 3)
        for opacities in (torch.where(drawn, 1.01 / 255, 0.99 / 255), torch.ones(N))
    )
    assert torch.equal(colors, everything * drawn[:, None])
    weights = torch.randn(N, 3, generator=random)
    weights[::7] = 0
    got = torch.autograd.grad(colors, inputs, weights)
    want = torch.autograd.grad(everything, inputs, weights * drawn[:, None])
    for one, other in zip(got, want, strict=True):
        assert torch.equal(one, other)
        assert not one[~drawn | (weights == 0).all(1)].any()
        assert (share > 0) == bool(one.any())


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("degree", [1, 3])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_gradients_of_views_add_up(share: float, degree: int) -> None:
    """Catches a view whose gradient, of the rows that have one, lands in other rows of what views before it left."""
    N, random = 1100, torch.Generator().manual_seed(1)
    inputs = color_inputs(3, torch.float32, N)
    views = [
        show_colors(*inputs[:3], (torch.rand(N, generator=random) < share).float(), torch.tensor([0.1, 0.2, -z]),
                    degree, inputs[3], torch.tensor(0.7), 3)
        for z in (2.0, 3.0, 4.0)
    ]  # fmt: skip
    weights = [torch.randn(N, 3, generator=random) for _ in views]
    apart = [torch.autograd.grad(v, inputs, w, retain_graph=True) for v, w in zip(views, weights, strict=True)]
    for view, weight in zip(views, weights, strict=True):
        view.backward(weight)
    for x, *gradients in zip(inputs, *apart, strict=True):
        assert x.grad is not None
        assert x.grad.layout == torch.strided
        assert torch.equal(x.grad, sum(gradients[1:], gradients[0]))


def refined_exactly(N: int, widths: list[int]) -> tuple[Refinement, list[Tensor], list[Tensor]]:
    """A network of AGR in float64, the values of N Gaussians that it moves, and what it makes of them at 0.37."""
    g = torch.Generator().manual_seed(N)
    exact = Refinement(widths, g, units=0.5 + torch.rand(sum(widths), generator=g)).double()
    with torch.no_grad():
        for parameter in exact.parameters():
            parameter.add_(0.2 * torch.randn(parameter.shape, generator=g))
    parts = [*widths[:-1], 2, widths[-1] - 2]  # the last network moves two arrays
    values = [torch.randn(N, c, generator=g, dtype=torch.float64).requires_grad_() for c in parts]
    expected = exact(values, torch.tensor(0.37, dtype=torch.float64))
    return exact, values, expected


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("N", [1, 127, 300])
@pytest.mark.parametrize("widths", [[3, 1, 3, 28], [3, 7], [3, 3, 21]])
def test_refinement(N: int, widths: list[int]) -> None:
    """Catches a block's edge that is lost, a network that reads another's weights, and any wrong gradient."""
    exact, values, expected = refined_exactly(N, widths)

    single = Refinement(widths, torch.Generator())
    single.load_state_dict(exact.state_dict())
    inputs = [x.detach().float().requires_grad_() for x in values]
    actual = single(inputs, torch.tensor(0.37), by_kernel=True)
    for a, b in zip(actual, expected, strict=True):
        torch.testing.assert_close(a.double(), b, rtol=1e-5, atol=1e-5)
    assert_same(gradients(actual, [*inputs, *single.parameters()]),
                gradients(expected, [*values, *exact.parameters()]))  # fmt: skip


COMMON = torch.ones(16), *[torch.empty(0)] * 3  # units, no encoded time, no intervals


def nan_memory(what: str, like: Tensor, shape: tuple[int, ...]) -> Tensor:  # noqa: ARG001
    """`allocate` of what shows where nothing was written."""
    return like.new_full(shape, torch.nan)


def backward_of_refinement(values: list[Tensor], weights: list[Tensor], g_out: list[Tensor]) -> list[Tensor]:
    """By the kernel: gradients of the two features, then of the weights."""
    tensors = [*values, *weights, *COMMON]
    outputs, slots = refining._refine.run(tensors, (EVERY_ROW,))
    found = refining._refine.backward(tensors, slots, outputs, g_out, [True] * len(tensors))
    gradients = [g for g in found if g is not None]
    return [*gradients[:2], *gradients[4:]]


@pytest.mark.usefixtures("instruction_set", "threads")
@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("N", [0, 1, 127, 128, 129, 5000])
def test_refinement_of_what_has_no_gradient(N: int, share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches gradients in the wrong row, or not written, as those that have one are packed, or a row that counts as
    one without though one of its numbers is not zero; and sums that depend on the number of threads."""
    monkeypatch.setattr(refining, "allocate", nan_memory)
    g = torch.Generator().manual_seed(N)
    values = [torch.randn(N, c, generator=g) for c in (3, 1, 5, 7)]
    weights = [torch.randn(shape, generator=g) for shape in [(192, 4), (192,), (16, 64), (16,)]]
    drawn = torch.rand(N, generator=g) >= share
    g_out = [torch.randn(x.shape, generator=g) * drawn[:, None] for x in values]
    for i, x in enumerate(g_out):  # every fourth has a gradient in one array only, and there in its last number only
        x[::4, :-1] = 0
        x[::4, -1] *= torch.arange(len(x[::4])) % len(g_out) == i

    exact = [x.double().requires_grad_() for x in (*values[:2], *weights)]
    hidden = torch.relu(torch.cat(exact[:2], -1) @ exact[2].T + exact[3]).split(64, -1)
    layers = zip(hidden, exact[4].split([3, 1, 12]), exact[5].split([3, 1, 12]), strict=True)
    moved = torch.cat(exact[:2], -1), torch.cat([h @ w.T + b for h, w, b in layers], -1)
    everything = torch.cat([x.double() for x in g_out], -1)
    expected = list(torch.autograd.grad(moved, exact, (everything[:, :4], everything)))

    results = []
    for number in (1, 2, 3):
        torch.set_num_threads(number)
        results.append(backward_of_refinement(values, weights, g_out))
    assert_same([x.double() for x in results[0]], expected)
    assert all(torch.equal(x, y) for other in results[1:] for x, y in zip(results[0], other, strict=True))


TEN = torch.ones(10), torch.empty(0)


def test_errors() -> None:
    """Catches arrays that do not fit, which a kernel would read past their end."""
    sh0, shN, means, _ = color_inputs(1, torch.float32)
    with pytest.raises(InputError, match="coefficients"):
        show_colors(sh0, shN[:, :7], means, torch.ones(21), torch.zeros(3), 3)
    with pytest.raises(InputError, match="expected directions, times or both, got neither"):
        slice_triangular(torch.ones(2, 3), None, None, torch.ones(2, 3), torch.ones(2, 3), torch.ones(2, 0),
                           torch.ones(2, 0), torch.ones(2), torch.zeros(3), None, None, None,
                           conditioned_first=True)  # fmt: skip
    with pytest.raises(InputError, match="refine: expected"):
        refine([torch.ones(4, 3)], torch.ones(64, 3), torch.ones(64), torch.ones(3, 64), torch.ones(3), *TEN)
    values, out = [torch.ones(4, 3), torch.ones(4, 7)], torch.ones(10, 64)
    with pytest.raises(InputError, match="refine: expected weight_in of shape"):
        refine(values, torch.ones(128, 2), torch.ones(128), out, torch.ones(10), *TEN)
    with pytest.raises(InputError, match="refine: expected weight_in of shape"):
        refine(values[::-1], torch.ones(128, 3), torch.ones(128), out, torch.ones(10), *TEN)
    for rows in (0, 64, 127, 192):
        with pytest.raises(InputError, match="64 rows of weight_in for each feature"):
            refine(values, torch.ones(rows, 3), torch.ones(rows), out, torch.ones(10), *TEN)

"""Test the rasterizer in float32: single Gaussians against mpmath, many Gaussians against brute force in float64."""

import math
from collections.abc import Iterator
from functools import partial

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.headers import ALPHA_MIN
from gsbench.raster import EPS2D, NEAR, rasterize
from numerics import brute, oracle
from numerics.brute import Arguments
from numerics.cases import Case, Cell, device_of, fastest, worst

UNDECIDED = 1e-3  # relative distance to a threshold below which float32 may decide either way
# image and alpha [1, H, W, .], decided [1, H, W], gradients
ImageTruth = tuple[Tensor, Tensor, Tensor, dict[str, Tensor]]


def judge(case: Case, backends: list[str]) -> Iterator[Cell]:
    """Yield, for each backend, the largest errors of image and gradients over all images of one case."""
    pictures = case()
    truths = [(alone if case.area == "projection" else together)(arguments) for arguments in pictures]
    if math.isnan(case.bound.gradient):  # pixels are at a threshold on purpose, so all of them count
        truths = [(image, alpha, torch.ones_like(decided), {}) for image, alpha, decided, _ in truths]
    for backend in backends:
        errors = [compare(a, exact, backend) for a, exact in zip(pictures, truths, strict=True)]
        forward, gradient, bad = (torch.tensor(x, dtype=torch.float64) for x in zip(*errors, strict=True))
        drawn = sum(int((exact[1] > 0).any()) for exact in truths)
        yield Cell(
            case.area, case.name, "-", "-", backend, worst(forward),
            worst(gradient) if truths[0][3] else float("nan"), float(bad.mean()),
            fastest(partial(_all, pictures, backend)), case.bound,
            f"{drawn} of {len(pictures)} images not empty",
        )  # fmt: skip


def _all(pictures: list[Arguments], backend: str) -> None:
    for arguments in pictures:
        differentiate(arguments, backend, *weights(arguments))


def weights(arguments: Arguments) -> tuple[Tensor, Tensor]:
    """Return fixed random float64 weights of image and alpha; the loss is the weighted sum of their pixels."""
    shape, g = (1, arguments["height"], arguments["width"]), torch.Generator().manual_seed(1)
    channels = (arguments["colors"].shape[-1], 1)
    image, alpha = (torch.randn(*shape, D, generator=g, dtype=torch.float64) for D in channels)
    return image, alpha


def inputs_of(arguments: Arguments) -> list[str]:
    """Return the names of the arguments by which the loss is differentiated."""
    return [name for name in brute.DIFFERENTIABLE if name in arguments]


def together(arguments: Arguments) -> ImageTruth:
    """Compute the exact image of many Gaussians and the exact gradients of the loss by brute force in float64."""
    exact: Arguments = {k: v.double() if isinstance(v, Tensor) else v for k, v in arguments.items()}
    with torch.no_grad():
        picture = brute.render(**exact)
    decided = picture.slack > UNDECIDED
    weight, weight_alpha = (w * decided[..., None] for w in weights(arguments))
    return picture.image, picture.alpha, decided, brute.differentiate(exact, weight, weight_alpha)


def alone(arguments: Arguments) -> ImageTruth:
    """Compute the exact image of one Gaussian and the exact gradients of the loss in mpmath.

    The Gaussian has one colour channel with value 1, so that the image equals alpha.
    """
    width, height = arguments["width"], arguments["height"]
    pixels = [(i + 0.5, j + 0.5) for j in range(height) for i in range(width)]
    names = [name for name in inputs_of(arguments) if name != "colors"]
    x, shape = torch.cat([arguments[name].flatten() for name in names]).tolist(), (1, height, width, 1)
    if not x[2] > torch.tensor(arguments.get("near", NEAR)).item():  # camera axes are world axes, so z is the depth
        none = torch.zeros(shape, dtype=torch.float64)
        return none, none, none[..., 0] == 0, {k: torch.zeros_like(arguments[k]).double() for k in inputs_of(arguments)}
    view: Arguments = {"viewmat": arguments["viewmats"][0].tolist(), "K": arguments["Ks"][0].tolist(),
                       "size": (width, height), "eps2d": float(torch.tensor(EPS2D))}  # fmt: skip
    function = partial(oracle.alphas, **view)
    alphas = oracle.evaluate(partial(function, pixels=pixels), x)
    free = torch.tensor([float(v) for v in alphas], dtype=torch.float64).view(shape)
    decided = ((free / ALPHA_MIN - 1).abs() > UNDECIDED)[..., 0]
    if "beta_exponents" in arguments:  # float32 may decide either way at the rim of a Beta profile too
        squares = oracle.evaluate(partial(oracle.distances, pixels=pixels, **view), x)
        rim = torch.tensor([float(abs(1 - r2)) for r2 in squares], dtype=torch.float64).view(decided.shape)
        decided = decided & (rim > brute.RIM)
    shown = torch.where(free >= ALPHA_MIN, free, 0.0)
    weight = sum(weights(arguments)) * decided[..., None] * (shown > 0)
    counted = [(pixel, w) for pixel, w in zip(pixels, weight.flatten().tolist(), strict=True) if w]
    loss = partial(function, pixels=[pixel for pixel, _ in counted])
    gradient = torch.tensor([float(v) for v in oracle.gradient(loss, x, [w for _, w in counted])])
    split = gradient.split([arguments[name].numel() for name in names])
    gradients = {name: part.view_as(arguments[name]).double() for name, part in zip(names, split, strict=True)}
    image_weight = weights(arguments)[0] * decided[..., None]
    return shown, shown, decided, gradients | {"colors": (image_weight * shown).sum().view(1, 1)}


def differentiate(
    arguments: Arguments, backend: str, weight: Tensor, weight_alpha: Tensor
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """Render image and alpha in float32 with one backend, and compute the gradients of the loss."""
    inputs = {name: arguments[name].detach().clone().requires_grad_() for name in inputs_of(arguments)}
    device = device_of(backend)
    there: Arguments = {k: v.to(device) if isinstance(v, Tensor) else v for k, v in (arguments | inputs).items()}
    out = rasterize(**there, backend=backend)
    image, alpha = out.image.cpu().double(), out.alpha.cpu().double()
    loss = (image * weight).sum() + (alpha * weight_alpha).sum()
    gradients = torch.autograd.grad(loss, list(inputs.values()), materialize_grads=True)
    return image.detach(), alpha.detach(), dict(zip(inputs, gradients, strict=True))


def compare(arguments: Arguments, exact: ImageTruth, backend: str) -> tuple[float, float, float]:
    """Return the largest error of image and alpha, the largest error of gradients, and 1 if a value is not finite.

    Image errors are relative to the largest colour value, or to 1 if that is larger. Pixels within rounding error of a
    threshold do not count.
    """
    image, alpha, decided, exact_gradients = exact
    weight, weight_alpha = (w * decided[..., None] for w in weights(arguments))
    try:
        got, covered, gradients = differentiate(arguments, backend, weight, weight_alpha)
    except InputError:  # each case must be rendered, so a refusal is an error
        return float("nan"), float("nan"), 1.0
    finite = got.isfinite().all() & covered.isfinite().all() & all(g.isfinite().all() for g in gradients.values())
    brightest = max(1.0, float(arguments["colors"].abs().max())) if arguments["colors"].numel() else 1.0
    errors = torch.cat([(got - image).abs().amax(-1) / brightest, (covered - alpha).abs().amax(-1)])
    forward = worst(torch.where(torch.cat([decided, decided]), errors, 0.0))
    slopes = [_relative(gradients[name].double(), truth) for name, truth in exact_gradients.items()]
    return forward, max(slopes, default=0.0), float(not finite)


def _relative(got: Tensor, exact: Tensor) -> float:
    """Return |got - exact| / |exact|, or |got| if the exact gradient is zero."""
    size = float(exact.norm())
    return float((got - exact).norm()) / (size if size > 0 else 1.0)

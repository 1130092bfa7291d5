"""Test the rasterizer in float32 on hard inputs: single Gaussians against mpmath, many against brute force."""

import math
from collections.abc import Iterator
from functools import partial

import torch
from torch import Generator, Tensor

from gsbench.errors import InputError
from gsbench.kernels.headers import ALPHA_MIN
from gsbench.raster import EPS2D, NEAR, rasterize
from numerics import brute, oracle
from numerics.brute import Arguments
from numerics.cases import Case, Cell, case, device_of, fastest, worst

WIDTH, HEIGHT = 16, 12
FOCAL = 24.0
DEPTH = 4.0  # the default depth of means; a power of two, so that it is exact in float32
CROWD = 100_000
AT_A_LIMIT = {"forward": 1.01 / 255, "gradient": math.nan}  # bounds where float32 may skip a Gaussian or not


def intrinsics(fx: float = FOCAL, fy: float = FOCAL, cx: float = WIDTH / 2, cy: float = HEIGHT / 2) -> Tensor:
    """Return an intrinsic matrix [1, 3, 3], in pixels."""
    return torch.tensor([[[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]])


def single(mean: Tensor, factor: Tensor) -> Arguments:
    """Return one Gaussian, and one camera at the origin that looks along z; tensors are float32."""
    return {
        "means": mean.float()[None],
        "factors": factor.float()[None],
        "opacities": torch.tensor([0.9]),
        "colors": torch.ones(1, 1),
        "viewmats": torch.eye(4)[None],
        "Ks": intrinsics(),
        "width": WIDTH,
        "height": HEIGHT,
    }


def on_a_pixel(size: float) -> Arguments:
    """Return a round Gaussian whose mean is at a pixel centre; the size is in pixels."""
    unit = DEPTH / FOCAL
    return single(torch.tensor([0.5 * unit, 0.5 * unit, DEPTH]), size * unit * torch.eye(3))


def ordinary(g: Generator, size: float = 0.2) -> Arguments:
    """Draw a random Gaussian that is visible and a few pixels large."""
    mean = torch.tensor([0.2, -0.1, DEPTH]) + 0.1 * torch.randn(3, generator=g)
    return single(mean, size * torch.randn(3, 3, generator=g))


def crowd(g: Generator, N: int, size: float) -> Arguments:
    """Draw N visible Gaussians of about the same size at different depths."""
    spread = torch.tensor([1.0, 0.7, 1.0])
    means = (torch.rand(N, 3, generator=g) * 2 - 1) * spread + torch.tensor([0.0, 0.0, DEPTH])
    return {
        "means": means,
        "factors": size * torch.randn(N, 3, 3, generator=g),
        "opacities": 0.05 + 0.9 * torch.rand(N, generator=g),
        "colors": torch.rand(N, 3, generator=g),
        "viewmats": torch.eye(4)[None],
        "Ks": intrinsics(),
        "width": WIDTH,
        "height": HEIGHT,
        "background": torch.tensor([0.2, 0.5, 0.8]),
    }


# ---- projection


@case("projection")
def ordinary_splats(g: Generator, severity: float) -> list[Arguments]:
    """Project ordinary Gaussians, for which nothing is numerically hard, as the baseline of the hard cases."""
    return [ordinary(g) for _ in range(3)]


@case("projection")
def at_the_near_plane(g: Generator, severity: float) -> list[Arguments]:
    """Put means within rounding error of the near plane and behind the camera, where 1/z is infinite or negative."""
    near = 0.25
    pictures = []
    for depth in (near, near * (1 + 2**-22), near * (1 - 2**-22), 0.0, -1.0, -near):
        z = depth * severity + DEPTH * (1 - severity)
        pictures.append(single(torch.tensor([0.02, -0.01, z]), 0.02 * torch.randn(3, 3, generator=g)) | {"near": near})
    return pictures


@case("projection")
def far_off_axis(g: Generator, severity: float) -> list[Arguments]:
    """Put means outside the image (x/z up to 100) of Gaussians that reach into it; EWA's Jacobian is large there. Met
    in practice: diff-gaussian-rasterization issue 75."""
    away = [DEPTH * tangent**severity for tangent in (1.0, 10.0, 100.0)]
    return [single(torch.tensor([x, 0.3 * x, DEPTH]), 0.4 * x * torch.randn(3, 3, generator=g)) for x in away]


@case("projection")
def needle(g: Generator, severity: float) -> list[Arguments]:
    """Use axis ratios 10^5 : 1 : 1 and 10^5 : 10^5 : 1, for which the 2D determinant ab - c^2 cancels. Training makes
    such Gaussians at edges. Met in practice: UnityGaussianSplatting issue 14."""
    thin = 10 ** (-5 * severity)
    return [
        ordinary(g) | {"factors": (torch.linalg.qr(torch.randn(3, 3, generator=g))[0] * torch.tensor(sizes))[None]}
        for sizes in ([2.0, 2 * thin, 2 * thin], [2.0, 2.0, 2 * thin], [200.0, 200 * thin, 200 * thin])
    ]


@case("projection")
def pointlike(g: Generator, severity: float) -> list[Arguments]:
    """Use Gaussians of size 10^-8 and 0, whose projection has only the blur eps2d: no code may divide by their size."""
    sizes = (10 ** (-8 * severity), 0.0 if severity == 1 else 0.1)
    return [ordinary(g) | {"factors": size * torch.randn(1, 3, 3, generator=g)} for size in sizes]


@case("projection")
def larger_than_the_scene(g: Generator, severity: float) -> list[Arguments]:
    """Use Gaussians of size 10^3 to 10^7 (models allow no larger one), for which the 2D determinant overflows. Met in
    practice: UnityGaussianSplatting issue 196."""
    sizes = [10 ** (power * severity) for power in (3, 5, 7)]
    return [ordinary(g) | {"factors": size * torch.randn(1, 3, 3, generator=g)} for size in sizes]


@case("projection")
def extreme_focal_lengths(g: Generator, severity: float) -> list[Arguments]:
    """Use focal lengths of 10 and 10^5 pixels, as in crops of fisheye or telescope images."""
    wide, tele = 24 ** (1 - severity) * 10**severity, 24 ** (1 - severity) * 1e5**severity
    shrink = FOCAL / tele
    far = ordinary(g, 0.2 * shrink)
    far["means"] = far["means"] * torch.tensor([shrink, shrink, 1.0])
    return [ordinary(g) | {"Ks": intrinsics(wide, wide)}, far | {"Ks": intrinsics(tele, tele)}]


@case("projection")
def oblong_pixels(g: Generator, severity: float) -> list[Arguments]:
    """Use focal lengths with fx / fy = 100 or 1/100 (anamorphic lenses); a renderer with one focal length fails."""
    stretch = 10**severity
    return [ordinary(g, 0.1) | {"Ks": intrinsics(FOCAL * s, FOCAL / s)} for s in (stretch, 1 / stretch)]


@case("projection")
def principal_point_outside(g: Generator, severity: float) -> list[Arguments]:
    """Put the principal point ten image widths outside the image, as in crops. A renderer that clamps x/z around the
    image centre is wrong here. Met in practice: gsplat issue 305."""
    away, inputs = 10 * WIDTH * severity, ordinary(g)
    shift = away / FOCAL * DEPTH
    inputs["means"] = inputs["means"] - torch.tensor([shift, -shift, 0.0])
    return [inputs | {"Ks": intrinsics(cx=WIDTH / 2 + away, cy=HEIGHT / 2 - away)}]


@case("projection")
def beta_exponent_below_one(g: Generator, severity: float) -> list[Arguments]:
    """Use Beta profiles with exponents down to 10^-3: alpha drops to zero at the rim, where its slope is infinite."""
    return [
        ordinary(g, 1.0) | {"beta_exponents": torch.tensor([10 ** (-power * severity)])} for power in (0.3, 1.0, 3.0)
    ]


@case("projection")
def beta_of_large_exponents(g: Generator, severity: float) -> list[Arguments]:
    """Use exponents of 10^2 to 10^6, which multiply what rounding takes from 1 - r^2 where a Gaussian is seen."""
    exponents = [10 ** (power * severity) for power in (2, 4, 6)]
    return [ordinary(g, 0.3 * exponent**0.5) | {"beta_exponents": torch.tensor([exponent])} for exponent in exponents]


@case("projection", **AT_A_LIMIT)
def beta_at_the_rim(g: Generator, severity: float) -> list[Arguments]:
    """Put pixel centres within rounding error of the rim r = 1 of Beta profiles, where log(1 - r^2) is infinite. With
    these exponents alpha is below 1/255 at the rim, or within rounding error of it."""
    variance = 9 / (0.5 + 0.5 * severity)  # pixels^2; at severity 1 the rim is three pixels away
    inputs = on_a_pixel((variance - EPS2D) ** 0.5)
    return [inputs | {"beta_exponents": torch.tensor([shape])} for shape in (0.45, 1.0, 1e3)]


@case("projection", **AT_A_LIMIT)
def beta_opacity_at_its_limit(g: Generator, severity: float) -> list[Arguments]:
    """Use opacities within rounding error of 1/255, where the size of a Beta profile is a root of almost zero."""
    opacities = [1 / 255 * (1 + change * severity) for change in (-(2**-23), 0.0, 2**-22, 1e-3)]
    return [
        on_a_pixel(10.0) | {"opacities": torch.tensor([opacity]), "beta_exponents": torch.tensor([shape])}
        for opacity in opacities
        for shape in (1e-3, 0.5, 50.0)
    ]


# ---- blending


@case("blending")
def ordinary_crowd(g: Generator, severity: float) -> list[Arguments]:
    """Blend ordinary Gaussians, for which nothing is numerically hard, as the baseline of the hard cases."""
    return [crowd(g, 200, 0.15)]


@case("blending")
def beta_crowd(g: Generator, severity: float) -> list[Arguments]:
    """Blend Beta profiles of exponents from 0.1 to 10 together: discs with a rim before and behind small peaks."""
    exponents = 10 ** (severity * (2 * torch.rand(200, generator=g) - 1))
    return [crowd(g, 200, 0.4) | {"beta_exponents": exponents}]


@case("blending")
def faint_crowd(g: Generator, severity: float) -> list[Arguments]:
    """Blend 10^5 Gaussians of opacity 1/100 that all cover the image, so that each pixel sums many small terms."""
    inputs = crowd(g, max(10, int(CROWD**severity)), 5.0)
    few = {"width": 8, "height": 6, "Ks": intrinsics(cx=4.0, cy=3.0)}  # brute force takes seconds for these
    return [inputs | few | {"opacities": torch.full((len(inputs["means"]),), 0.01)}]


@case("blending")
def opaque_stack(g: Generator, severity: float) -> list[Arguments]:
    """Blend a thousand opaque Gaussians behind each other; the backward pass must not compute 0/0 from 1 - alpha."""
    return [crowd(g, 1000, 1.0) | {"opacities": 1 - 0.4 * (1 - severity) * torch.rand(1000, generator=g)}]


@case("blending")
def equal_depths(g: Generator, severity: float) -> list[Arguments]:
    """Put all Gaussians at the same depth: every backend must then blend them in the order of their indices."""
    inputs = crowd(g, 200, 0.3)
    inputs["means"][:, 2] = DEPTH + (1 - severity) * (inputs["means"][:, 2] - DEPTH)
    return [inputs]


@case("blending", **AT_A_LIMIT)
def alpha_at_its_limits(g: Generator, severity: float) -> list[Arguments]:
    """Use alphas within rounding error of the cut-offs at 1/255 and 0.999. In float32 a Gaussian at 1/255 may be
    skipped or not, which changes a pixel by at most 1/255."""
    inputs = crowd(g, 3, 1.0)
    inputs["factors"] = 1e4 * torch.eye(3).repeat(3, 1, 1)  # constant over the image
    faint = torch.tensor([1 / 255]) * torch.tensor([1 - 2**-23, 1.0, 1 + 2**-22]) ** severity
    full = torch.tensor([0.999]) * torch.tensor([1 - 2**-23, 1.0, 1 + 2**-23]) ** severity
    return [
        inputs | _only(inputs, slice(i, i + 1)) | {"opacities": opacity[None]}
        for opacities in (faint, full)
        for i, opacity in enumerate(opacities)
    ]


@case("blending", forward=1e-3, gradient=math.nan)
def transmittance_at_the_stop(g: Generator, severity: float) -> list[Arguments]:
    """Blend four Gaussians of alpha 0.9, so that the transmittance ends within rounding error of the limit 1e-4. In
    float32 the fourth Gaussian may be skipped or not, which changes a pixel by at most 9e-4."""
    inputs = crowd(g, 6, 1.0)
    inputs["factors"] = 1e4 * torch.eye(3).repeat(6, 1, 1)
    return [inputs | {"opacities": torch.full((6,), 0.9 * severity + 0.5 * (1 - severity))}]


@case("blending")
def brilliant_colors(g: Generator, severity: float) -> list[Arguments]:
    """Blend colours of about 10^4, which 3DGS allows; errors are relative to the largest colour value."""
    inputs = crowd(g, 200, 0.15)
    return [inputs | {"colors": inputs["colors"] * 10 ** (4 * severity)}]


@case("blending")
def no_gaussians(g: Generator, severity: float) -> list[Arguments]:
    """Render no Gaussians, or only culled ones: the image must be the background."""
    inputs = crowd(g, 20, 0.1)
    away = inputs["means"] - torch.tensor([0.0, 0.0, 50.0 * severity])
    return [inputs | _only(inputs, slice(0)), inputs | {"means": away}]


def _only(inputs: Arguments, rows: slice) -> Arguments:
    return {name: inputs[name][rows] for name in ("means", "factors", "colors", "opacities")}


# ---- the errors of a case

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
        slope = worst(gradient) if truths[0][3] else float("nan")
        measured = (worst(forward), slope, float(bad.mean()), fastest(partial(_all, pictures, backend)))
        note = f"{drawn} of {len(pictures)} images not empty"
        yield Cell(case.area, case.name, "-", "-", backend, *measured, case.bound, note)


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
    """Compute the exact image of one Gaussian and the exact gradients of the loss in mpmath. The Gaussian has one
    colour channel with value 1, so that the image equals alpha."""
    width, height = arguments["width"], arguments["height"]
    pixels = [(i + 0.5, j + 0.5) for j in range(height) for i in range(width)]
    names = [name for name in inputs_of(arguments) if name != "colors"]
    x, shape = torch.cat([arguments[name].flatten() for name in names]).tolist(), (1, height, width, 1)
    if not x[2] > torch.tensor(arguments.get("near", NEAR)).item():  # camera axes are world axes, so z is the depth
        none = torch.zeros(shape, dtype=torch.float64)
        return none, none, none[..., 0] == 0, {k: torch.zeros_like(arguments[k]).double() for k in inputs_of(arguments)}
    view: Arguments = {
        "viewmat": arguments["viewmats"][0].tolist(),
        "K": arguments["Ks"][0].tolist(),
        "size": (width, height),
        "eps2d": float(torch.tensor(EPS2D)),
    }
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
    threshold do not count."""
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

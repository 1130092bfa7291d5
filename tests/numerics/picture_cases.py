"""Define numerically hard inputs of the rasterizer: single Gaussians for projection, many Gaussians for blending."""

import math

import torch
from torch import Generator, Tensor

from gsbench.raster import EPS2D
from numerics.brute import Arguments
from numerics.cases import case

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
        "means": mean.float()[None], "factors": factor.float()[None], "opacities": torch.tensor([0.9]),
        "colors": torch.ones(1, 1), "viewmats": torch.eye(4)[None], "Ks": intrinsics(),
        "width": WIDTH, "height": HEIGHT,
    }  # fmt: skip


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
        "means": means, "factors": size * torch.randn(N, 3, 3, generator=g),
        "opacities": 0.05 + 0.9 * torch.rand(N, generator=g), "colors": torch.rand(N, 3, generator=g),
        "viewmats": torch.eye(4)[None], "Ks": intrinsics(), "width": WIDTH, "height": HEIGHT,
        "background": torch.tensor([0.2, 0.5, 0.8]),
    }  # fmt: skip


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
    """Put means outside the image (x/z up to 100) of Gaussians that reach into it; EWA's Jacobian is large there.

    Met in practice: diff-gaussian-rasterization issue 75.
    """
    away = [DEPTH * tangent**severity for tangent in (1.0, 10.0, 100.0)]
    return [single(torch.tensor([x, 0.3 * x, DEPTH]), 0.4 * x * torch.randn(3, 3, generator=g)) for x in away]


@case("projection")
def needle(g: Generator, severity: float) -> list[Arguments]:
    """Use axis ratios 10^5 : 1 : 1 and 10^5 : 10^5 : 1, for which the 2D determinant ab - c^2 cancels.

    Training makes such Gaussians at edges. Met in practice: UnityGaussianSplatting issue 14.
    """
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
    """Use Gaussians of size 10^3 to 10^7 (models allow no larger one), for which the 2D determinant overflows.

    Met in practice: UnityGaussianSplatting issue 196.
    """
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
    """Put the principal point ten image widths outside the image, as in crops.

    A renderer that clamps x/z around the image centre is wrong here. Met in practice: gsplat issue 305.
    """
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
    """Put pixel centres within rounding error of the rim r = 1 of Beta profiles, where log(1 - r^2) is infinite.

    With these exponents alpha is below 1/255 at the rim, or within rounding error of it.
    """
    variance = 9 / (0.5 + 0.5 * severity)  # pixels^2; at severity 1 the rim is three pixels away
    inputs = on_a_pixel((variance - EPS2D) ** 0.5)
    return [inputs | {"beta_exponents": torch.tensor([shape])} for shape in (0.45, 1.0, 1e3)]


@case("projection", **AT_A_LIMIT)
def beta_opacity_at_its_limit(g: Generator, severity: float) -> list[Arguments]:
    """Use opacities within rounding error of 1/255, where the size of a Beta profile is a root of almost zero."""
    opacities = [1 / 255 * (1 + change * severity) for change in (-(2**-23), 0.0, 2**-22, 1e-3)]
    return [on_a_pixel(10.0) | {"opacities": torch.tensor([opacity]), "beta_exponents": torch.tensor([shape])}
            for opacity in opacities for shape in (1e-3, 0.5, 50.0)]  # fmt: skip


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
    """Use alphas within rounding error of the cut-offs at 1/255 and 0.999.

    In float32 a Gaussian at 1/255 may be skipped or not, which changes a pixel by at most 1/255.
    """
    inputs = crowd(g, 3, 1.0)
    inputs["factors"] = 1e4 * torch.eye(3).repeat(3, 1, 1)  # constant over the image
    faint = torch.tensor([1 / 255]) * torch.tensor([1 - 2**-23, 1.0, 1 + 2**-22]) ** severity
    full = torch.tensor([0.999]) * torch.tensor([1 - 2**-23, 1.0, 1 + 2**-23]) ** severity
    return [inputs | _only(inputs, slice(i, i + 1)) | {"opacities": opacity[None]}
            for opacities in (faint, full) for i, opacity in enumerate(opacities)]  # fmt: skip


@case("blending", forward=1e-3, gradient=math.nan)
def transmittance_at_the_stop(g: Generator, severity: float) -> list[Arguments]:
    """Blend four Gaussians of alpha 0.9, so that the transmittance ends within rounding error of the limit 1e-4.

    In float32 the fourth Gaussian may be skipped or not, which changes a pixel by at most 9e-4.
    """
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

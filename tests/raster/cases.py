"""Scenes that a rasterizer can get wrong, by name: the arguments of `rasterize`, for any backend and float type."""

import zlib
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from gsbench.raster import rasterize

Arguments = dict[str, Any]


def gaussians(g: torch.Generator, N: int, size: float = 0.15, D: int = 3, spread: float = 1.0) -> Arguments:
    """N Gaussians in a cube around the origin, of about `size`, by full 3x3 factors."""
    return {
        "means": spread * (2 * _rand(g, N, 3) - 1),
        "factors": size * torch.randn(N, 3, 3, generator=g, dtype=torch.float64),
        "opacities": 0.05 + 0.9 * _rand(g, N),
        "colors": _rand(g, N, D),
    }


def camera(width: int, height: int, eye: tuple[float, float, float] = (0.5, -0.4, -4.0)) -> Arguments:
    """One camera at `eye` that looks at the origin, with a picture about as wide as [-1, 1]^3 seems from there."""
    focal = 2.0 * min(width, height)
    views = {"viewmats": look_at(eye)[None], "Ks": intrinsics(focal, focal, width / 2, height / 2)[None]}
    return views | {"width": width, "height": height}


def look_at(eye: tuple[float, float, float]) -> Tensor:
    """World to camera, [4, 4], OpenCV axes, from `eye` to the origin."""
    position = torch.tensor(eye, dtype=torch.float64)
    z = -position / position.norm()
    x = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.1], dtype=torch.float64), z)
    x = x / x.norm()
    R = torch.stack([x, torch.linalg.cross(z, x), z])
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = R, -R @ position
    return viewmat


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> Tensor:
    """[3, 3], pixels."""
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)


def _rand(g: torch.Generator, *shape: int) -> Tensor:
    return torch.rand(*shape, generator=g, dtype=torch.float64)


def _repeated(rows: list[Any], N: int) -> Tensor:
    """N rows that are these in turn."""
    values = torch.tensor(rows, dtype=torch.float64)
    return values.repeat(N // len(rows), *[1] * (values.dim() - 1))


def _flattened(g: torch.Generator, N: int, axes: list[list[float]], width: int = 33, height: int = 17) -> Arguments:
    """N Gaussians of these axes in turn, turned at random."""
    scene = gaussians(g, N) | camera(width, height)
    rotations = torch.linalg.qr(torch.randn(N, 3, 3, generator=g, dtype=torch.float64))[0]
    return scene | {"factors": rotations * _repeated(axes, N)[:, None]}


def _near_plane(g: torch.Generator) -> Arguments:
    """Means behind the camera, on it, within `near` of it and just beyond, with extents that cross all of that."""
    scene = gaussians(g, 40, size=0.4) | camera(24, 16, eye=(0.0, 0.0, -1e-3))
    z = torch.linspace(-1, 1, 40, dtype=torch.float64)[:, None]
    return scene | {"means": torch.cat([0.3 * scene["means"][:, :2], z], -1), "near": 0.2}


def _off_screen(g: torch.Generator) -> Arguments:
    """Around the border on all sides: outside but reaching in, and farther than the Jacobian's clamp."""
    scene = gaussians(g, 60, size=0.6) | camera(24, 16)
    angle = 6.2832 * _rand(g, 60)
    ring = torch.stack([angle.cos(), angle.sin(), 0 * angle], -1) * (0.8 + 2.5 * _rand(g, 60, 1))
    return scene | {"means": ring}


def _equal_depths(g: torch.Generator) -> Arguments:
    """All at the same depth to the last bit: the lower index is in front."""
    scene = gaussians(g, 30, size=0.4) | camera(16, 16)
    viewmat = torch.eye(4)
    viewmat[2, 3] = 4.0
    return scene | {"means": scene["means"] * torch.tensor([1.0, 1.0, 0.0]), "viewmats": viewmat[None]}


def _three_cameras(g: torch.Generator) -> Arguments:
    """Different places and focal lengths, one colour set a camera, one background for all."""
    scene = gaussians(g, 30) | camera(20, 14)
    eyes = ((0.5, -0.4, -4.0), (3.0, 1.0, -2.0), (-2.0, 0.5, 3.0))
    return scene | {
        "viewmats": torch.stack([look_at(eye) for eye in eyes]),
        "Ks": torch.stack([intrinsics(f, f, 10, 7) for f in (20.0, 28.0, 40.0)]),
        "colors": _rand(g, 3, 30, 3),
        "background": torch.tensor([1.0, 0.5, 0.0]),
    }


def _of_their_own(g: torch.Generator) -> Arguments:
    """Three cameras each of which sees other Gaussians."""
    sets = [gaussians(g, 30) for _ in range(3)]
    return _three_cameras(g) | {key: torch.stack([x[key] for x in sets]) for key in sets[0]}


def _five_channels(g: torch.Generator) -> Arguments:
    """Colours need not be in [0, 1]."""
    scene = gaussians(g, 20, D=5) | camera(16, 12)
    return scene | {"colors": 4 * scene["colors"] - 2, "background": torch.arange(5) - 2.0}


def _of_many_sizes(g: torch.Generator, scene: Arguments) -> Arguments:
    """Sizes from far below a pixel, where the filter dims, to large."""
    return scene | {"antialias": True, "factors": scene["factors"] * 10 ** (1 - 2.5 * _rand(g, 60, 1, 1))}


def _with_exponents(scene: Arguments, exponents: Tensor) -> Arguments:
    return scene | {"beta_exponents": exponents}


def _huge_exponents(g: torch.Generator) -> Arguments:
    """Exponents of 10^2 to 10^6 on Gaussians so large that a few pixels are seen of them: as good as Gaussians."""
    exponents = 10 ** (2 + 4 * _rand(g, 30))
    scene = _with_exponents(gaussians(g, 30) | camera(24, 16), exponents)
    return scene | {"factors": scene["factors"] * exponents[:, None, None].sqrt()}


CASES: dict[str, Callable[[torch.Generator], Arguments]] = {
    "random": lambda g: gaussians(g, 60) | camera(33, 17),
    # Axes 1e4 : 1 : 1 and 1e4 : 1e4 : 1, many times as long as the picture is wide.
    "needles": lambda g: _flattened(g, 24, [[2.0, 2e-4, 2e-4], [2.0, 2.0, 2e-4]]),
    # Half a pixel wide, hundreds long: dx^2, dx dy and dy^2 cancel to a thousandth or less of themselves.
    "needles_across_a_large_picture": lambda g: _flattened(g, 16, [[2.0, 2e-4, 2e-4]], 400, 300),
    # Singular factors: a disc, a line, a point.
    "flat": lambda g: _flattened(g, 24, [[0.3, 0.3, 0], [0.3, 0, 0], [0, 0, 0]]),
    "larger_than_picture": lambda g: gaussians(g, 12, size=8.0) | camera(20, 12),
    "near_plane": _near_plane,
    "far_plane": lambda g: gaussians(g, 20) | camera(16, 16) | {"far": 4.1},
    "off_screen": _off_screen,
    "nothing_in_view": lambda g: (
        gaussians(g, 8) | camera(16, 8) | {"means": 50 + _rand(g, 8, 3), "background": torch.tensor([0.2, 0.4, 0.6])}
    ),
    # Opacities of zero and of just below 1/255, which are never drawn, among some just above.
    "transparent": lambda g: (
        gaussians(g, 30, size=0.3) | camera(16, 16) | {"opacities": _repeated([0.0, 0.99 / 255, 1.2 / 255], 30)}
    ),
    # A thousand behind each other: the first few are all that is seen.
    "opaque_stack": lambda g: (
        gaussians(g, 1000, size=0.5, spread=0.3) | camera(9, 9) | {"opacities": 0.6 + 0.4 * _rand(g, 1000)}
    ),
    # Opacity 1 exactly: alpha stops at 0.999.
    "saturated": lambda g: gaussians(g, 10, size=20.0) | camera(16, 16) | {"opacities": torch.ones(10)},
    "equal_depths": _equal_depths,
    "one_pixel": lambda g: gaussians(g, 20, size=0.5) | camera(1, 1),
    "tall": lambda g: gaussians(g, 40) | camera(17, 33),  # no multiple of any tile
    "no_gaussian": lambda g: gaussians(g, 0) | camera(9, 5) | {"background": torch.tensor([0.1, 0.2, 0.3])},
    "one_gaussian": lambda g: (
        gaussians(g, 1, size=0.5)
        | camera(19, 10)
        | {"means": torch.tensor([[0.1, 0.05, 0.0]]), "opacities": torch.tensor([0.8])}
    ),
    "three_cameras": _three_cameras,
    "three_cameras_of_shared_colors": lambda g: _three_cameras(g) | {"colors": _rand(g, 30, 3)},
    "three_cameras_of_their_own_gaussians": _of_their_own,
    "oblong_pixels": lambda g: gaussians(g, 40) | camera(24, 16) | {"Ks": intrinsics(25.0, 50.0, 12, 8)[None]},
    "principal_point_off_center": lambda g: (
        gaussians(g, 40) | camera(24, 16) | {"Ks": intrinsics(30.0, 30.0, 5.3, 12.8)[None]}
    ),
    "principal_point_outside": lambda g: (
        gaussians(g, 40, size=0.3) | camera(24, 16) | {"Ks": intrinsics(30.0, 30.0, -9.0, 21.0)[None]}
    ),
    "one_channel": lambda g: gaussians(g, 20, D=1) | camera(16, 12) | {"background": torch.tensor([0.7])},
    "five_channels": _five_channels,
    "antialiased": lambda g: _of_many_sizes(g, gaussians(g, 60) | camera(24, 16)),
    "wide_filter": lambda g: gaussians(g, 30) | camera(16, 16) | {"eps2d": 2.0},
    # Beta profiles, from flat discs with a rim to small peaks; then exponents so small that alpha drops to zero there.
    "beta": lambda g: _with_exponents(gaussians(g, 60, size=0.5) | camera(33, 17), 0.2 * 30 ** _rand(g, 60)),
    "beta_at_the_rim": lambda g: _with_exponents(
        gaussians(g, 30, size=0.5) | camera(24, 16), 0.01 + 0.3 * _rand(g, 30)
    ),
    # Opacities just below and just above 1/255: culled ones, and ones that end close to their means.
    "beta_faint": lambda g: (
        _with_exponents(gaussians(g, 30, size=2.0) | camera(16, 16), 0.3 * 30 ** _rand(g, 30))
        | {"opacities": _repeated([0.99 / 255, 1.1 / 255, 2 / 255], 30)}
    ),
    "beta_of_huge_exponents": _huge_exponents,
    "beta_antialiased": lambda g: _of_many_sizes(
        g, _with_exponents(gaussians(g, 60, size=0.4) | camera(24, 16), 0.2 + 4 * _rand(g, 60))
    ),
    "beta_of_three_cameras": lambda g: _with_exponents(_three_cameras(g), 0.2 + 4 * _rand(g, 30)),
    "beta_of_three_cameras_of_their_own_gaussians": lambda g: _with_exponents(
        _of_their_own(g), 0.2 + 4 * _rand(g, 3, 30)
    ),
    "beta_of_five_channels": lambda g: _with_exponents(_five_channels(g), 0.2 + 4 * _rand(g, 20)),
    # Opacity 1: alpha stops at 0.999 near the means, and there is no gradient there.
    "beta_saturated": lambda g: (
        _with_exponents(gaussians(g, 10, size=2.0) | camera(16, 16), 0.1 + _rand(g, 10)) | {"opacities": torch.ones(10)}
    ),
}


def case(name: str, dtype: torch.dtype = torch.float64, device: str = "cpu") -> Arguments:
    """Keyword arguments of `rasterize`; the same numbers, rounded, in every dtype."""
    arguments = CASES[name](torch.Generator().manual_seed(zlib.crc32(name.encode())))
    return {k: v.to(device, dtype) if isinstance(v, Tensor) else v for k, v in arguments.items()}


def assert_beta_vector(backend: str, dtype: torch.dtype, tolerance: float) -> None:
    """Compare alpha, the bounding box and the gradients of a Beta profile at one pixel with numbers known by hand."""
    with torch.device("cuda" if backend == "cuda" else "cpu"):
        A, B, C, shape = (torch.tensor(x, dtype=dtype, requires_grad=True) for x in (0.02, 0.005, 0.03, 2.5))
        covariance = torch.linalg.inv(torch.stack([A, B, B, C]).view(2, 2))  # pixels^2
        factor = torch.nn.functional.pad(torch.linalg.cholesky(covariance), (0, 1, 0, 1))
        mean, opacity = torch.tensor([[0.0, 0, 1]], dtype=dtype, requires_grad=True), torch.tensor([0.7], dtype=dtype)
        gaussian = (mean, factor[None], opacity, torch.ones(1, 1, dtype=dtype))
        view = (torch.eye(4, dtype=dtype)[None], intrinsics(1, 1, 5.5, 2.5)[None].to(dtype), 8, 8)
        drawn = rasterize(*gaussian, *view, eps2d=0.0, backend=backend, beta_exponents=shape[None])
    alpha, means2d = drawn.alpha[0, 4, 2, 0], drawn.info.means2d  # the mean minus the centre of this pixel is (3, -2)
    slopes = torch.autograd.grad(alpha, (A, B, means2d, shape))
    got = [alpha, slopes[0], slopes[1], slopes[2][0, 0, 0], slopes[3], (drawn.info.half_sizes[0, 0, 0] - 0.01) ** 2]
    want = [0.352478, -10.4352, 13.9136, -0.115947, -0.096733, 0.874297 * covariance[0, 0].item()]
    for x, known in zip(got, want, strict=True):
        assert abs(x.item() / known - 1) < tolerance, (x, known)

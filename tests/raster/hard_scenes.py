"""Random scenes that are hard for float32, as arguments of `rasterize` for one camera."""

from typing import Any

import torch
from numerics import pictures
from numerics.cases import CASES, of_area
from torch import Generator, Tensor

PICTURES = [case.name for case in of_area("projection") + of_area("blending") if case.name != "faint_crowd"]
MOST = 300  # Gaussians in a scene
FLAT, FAR, HUGE, OPAQUE, COPLANAR, FAINT, NEAR = range(1, 8)  # kinds of Gaussians; 0: ordinary


def scene(seed: int) -> dict[str, Any]:
    """Every fourth scene is a case of the audit, of any severity; the others mix hard Gaussians with ordinary ones."""
    g = torch.Generator().manual_seed(seed)
    if seed % 4 == 0:
        severity = _number(g) if _pick(g, 2) else 1.0
        cases = CASES[PICTURES[_pick(g, len(PICTURES))]](severity, seed)
        return dict(cases[_pick(g, len(cases))])
    N = 1 + _pick(g, MOST)
    arguments = pictures.crowd(g, N, 0.05 * 10 ** (1.5 * _number(g)))
    kinds = torch.randint(8, (N,), generator=g) if _pick(g, 2) else torch.full((N,), _pick(g, 8))
    _harden(arguments, kinds, g)
    if _pick(g, 2):
        arguments["beta_exponents"] = 10 ** (3 * (2 * _rand(g, N) - 1) * _rand(g, N))
    if _pick(g, 2):
        arguments["viewmats"] = _turned(g)[None]
    if _pick(g, 2):
        D = (1, 3, 4)[_pick(g, 3)]
        arguments["colors"] = torch.randn(N, D, generator=g) * 10 ** (2 * _rand(g, N, 1))
        arguments["background"] = torch.randn(D, generator=g)
    return arguments | {"antialias": _pick(g, 3) == 0, "eps2d": (0.3, 0.3, 1e-3, 0.0)[_pick(g, 4)]}


def _harden(arguments: dict[str, Any], kinds: Tensor, g: Generator) -> None:
    """Change the Gaussians of each kind in place."""
    means, factors, opacities, N = arguments["means"], arguments["factors"], arguments["opacities"], len(kinds)
    axes = torch.linalg.qr(torch.randn(N, 3, 3, generator=g))[0]
    thin = 2 * axes * 10 ** (-4 * _rand(g, N, 1, 3) * _rand(g, N, 1, 1))
    away = 10 ** (3 * _rand(g, N, 1))
    nearly = 1 + 1e-7 * torch.randint(-3, 4, (N,), generator=g)  # within a few units in the last place
    factors[kinds == FLAT] = thin[kinds == FLAT]
    means[kinds == FAR] *= away[kinds == FAR]
    factors[kinds == FAR] *= away[kinds == FAR, None]
    factors[kinds == HUGE] *= 10 ** (4 * _rand(g, N, 1, 1))[kinds == HUGE]
    opacities[kinds == OPAQUE] = 1 - 1e-3 * _rand(g, N)[kinds == OPAQUE] ** 3
    means[kinds == COPLANAR, 2] = 4.0 * torch.where(_rand(g, N) < 0.5, 1.0, nearly)[kinds == COPLANAR]
    opacities[kinds == FAINT] = (1 / 255 * (1 + 1e-6 * torch.randn(N, generator=g)))[kinds == FAINT]
    if _pick(g, 2):
        arguments["near"] = float(means[_pick(g, N), 2].clamp(min=0.01))
        means[kinds == NEAR, 2] = arguments["near"] * nearly[kinds == NEAR]


def _turned(g: Generator) -> Tensor:
    """Return a camera that is turned and moved a little, [4, 4]."""
    axes, upper = torch.linalg.qr(torch.eye(3) + 0.2 * torch.randn(3, 3, generator=g))
    viewmat = torch.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = axes * torch.sign(torch.diagonal(upper)), 0.3 * torch.randn(3, generator=g)
    return viewmat


def _rand(g: Generator, *shape: int) -> Tensor:
    return torch.rand(*shape, generator=g)


def _number(g: Generator) -> float:
    return float(_rand(g, 1))


def _pick(g: Generator, count: int) -> int:
    return int(torch.randint(count, (), generator=g))

"""gsplat's way to the pictures that are compared; its kernels may be compiled on first use."""

import sys
from typing import Any

from torch import Tensor

from benchmarks.compare import Place, in_a_line
from benchmarks.scene import camera, gaussians


def why_not(place: Place) -> str | None:
    """None where gsplat draws; its kernels may be compiled here, on first use."""
    try:
        means, factors, opacities, colors, viewmats, Ks = place.put((*gaussians(10), *camera(16)))
        quats, scales = means.new_ones(10, 4), factors.norm(dim=1)
        gsplat_image(means, quats, scales, opacities, colors, viewmats=viewmats, Ks=Ks, size=16)
    except Exception as error:  # not installed, not built for this torch, no compiler, ..
        return in_a_line(error)
    return None


def gsplat_image(
    means: Tensor,
    quats: Any,
    scales: Any,
    opacities: Tensor,
    colors: Tensor,
    *,
    viewmats: Tensor,
    Ks: Tensor,
    size: int,
    covars: Tensor | None = None,
) -> Tensor:
    """The same picture by gsplat, not packed: the faster way for one camera that sees most Gaussians."""
    import gsplat

    image, _, _ = gsplat.rasterization(
        means, quats, scales, opacities, colors, viewmats, Ks, size, size, covars=covars, packed=False
    )
    return image


def version() -> str:
    return str(getattr(sys.modules["gsplat"], "__version__", "?"))

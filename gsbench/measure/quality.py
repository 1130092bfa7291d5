"""Measure image quality: PSNR, SSIM, LPIPS, and their means over the views of a split.

Images are float tensors [H, W, 3] and are clamped to [0, 1]. If a pixel is NaN, the result is NaN. If published code
uses several definitions of a metric, the docstring of our function says which one is computed. A mean of PSNRs is of
capped ones, so that a view that is rendered exactly leaves it finite (gsbench.measure.exact_views).
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import TypeVar

import torch
from skimage.metrics import structural_similarity
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.tensors import check_tensor
from gsbench.measure import perceptual
from gsbench.measure.exact_views import capped
from gsbench.measure.perceptual import BACKBONES, BackboneMissing
from gsbench.measure.record import ViewScore
from gsbench.process.memory import require

T = TypeVar("T")

SSIM_LEAST_SIDE = 11  # pixels: the width of a Gaussian window of sigma 1.5, cut at 3.5 sigma


def evenly(items: Sequence[T], count: int) -> list[T]:
    """Return at most `count` evenly spaced items, beginning with the first, to select a fixed subset of test views."""
    count = min(count, len(items))
    return [items[i * len(items) // count] for i in range(count)]


def psnr(a: Tensor, b: Tensor) -> float:  # [H, W, 3], each
    """Compute the peak signal-to-noise ratio of two images:

        PSNR = 10 log10(1 / MSE),   MSE = mean over H x W x 3 of (a - b)^2

    MSE is one mean over all channels; `psnr_channel_mean` instead averages the PSNR of each channel.

    Args:
        a: an image [H, W, 3] of floats, clamped to [0, 1].
        b: another image of the same size, on the same device.

    Returns:
        PSNR in dB; infinite for equal images.

    Raises:
        InputError: `a` and `b` are not images of the same size.

    Example:
        >>> import torch
        >>> from gsbench import psnr
        >>> black = torch.zeros(16, 16, 3)
        >>> round(psnr(black, black + 0.1), 2)
        20.0
        >>> psnr(black, black)
        inf
    """
    return _decibels(_squared_error(a, b).mean())


def capped_psnr(a: Tensor, b: Tensor) -> float:  # [H, W, 3], each
    """Compute the `psnr` with which a view counts in a mean, dB: finite for equal images (exact_views.MOST_PSNR)."""
    return capped(psnr(a, b))


def psnr_channel_mean(a: Tensor, b: Tensor) -> float:  # [H, W, 3], each
    """Compute the mean over RGB of the PSNR of each channel in dB, as some published code does.

    This is at least `psnr`, by Jensen's inequality, below the cap of each channel (gsbench.measure.exact_views).
    """
    return fmean(capped(_decibels(error)) for error in _squared_error(a, b).mean((0, 1)))


def ssim(a: Tensor, b: Tensor) -> float:  # [H, W, 3], each, H and W >= 11
    """Compute the structural similarity of two images (Wang et al. 2004) with scikit-image in float64:

        SSIM = mean of (2 m_a m_b + C1) (2 s_ab + C2) / ((m_a^2 + m_b^2 + C1) (s_a^2 + s_b^2 + C2))

    The mean is over pixels and channels. The means m, variances s^2 and the covariance s_ab are those in a Gaussian
    window of sigma 1.5 (11 pixels), with C1 = 0.01^2 and C2 = 0.03^2. `data_range` is 1, not scikit-image's default for
    floats, 2.

    Args:
        a: an image [H, W, 3] of floats, clamped to [0, 1], of at least 11 pixels a side.
        b: another image of the same size, on the same device.

    Returns:
        SSIM in [-1, 1]; 1 for equal images.

    Raises:
        InputError: `a` and `b` are not images of the same size, or they are too small.

    Example:
        >>> import torch
        >>> from gsbench import ssim
        >>> image = torch.linspace(0, 1, 32 * 32 * 3).reshape(32, 32, 3)
        >>> ssim(image, image)
        1.0
        >>> ssim(image, 1 - image) < 0
        True
    """
    a, b = _images(a, b, SSIM_LEAST_SIDE, "ssim")
    similarity = structural_similarity(
        a.cpu().numpy(),
        b.cpu().numpy(),
        channel_axis=-1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
    )
    return float(similarity)


@torch.no_grad()
def lpips(a: Tensor, b: Tensor, backbone: str = "alex", weights: Path | None = None) -> float:  # [H, W, 3], each
    """Compute LPIPS 0.1, the distance between the features of two images in a pretrained network (Zhang et al. 2018).

    The weights of AlexNet or VGG16 are not part of any package; `python -m gsbench.fetch lpips-alex` downloads them.

    Args:
        a: an image [H, W, 3] of floats, clamped to [0, 1], of at least 31 pixels a side for `alex` and 16 for `vgg`.
        b: another image of the same size, on the same device, which also runs the network.
        backbone: `alex` or `vgg`.
        weights: a file with the weights of the network; None for torchvision's file in $TORCH_HOME/hub/checkpoints.

    Raises:
        gsbench.measure.perceptual.BackboneMissing: `weights` is None, and torchvision's file does not exist.
        InputError: `a` and `b` are not images of the same size, they are too small, the backbone is unknown, or the
            file `weights` does not exist or has the wrong SHA-256.

    Example:
        This is the output without the weights; with the weights the result is 0.0.

        >>> import torch
        >>> from gsbench import lpips
        >>> image = torch.zeros(64, 64, 3)
        >>> lpips(image, image)
        Traceback (most recent call last):
        ...
        gsbench.measure.perceptual.BackboneMissing: needs weights: `python -m gsbench.fetch lpips-alex`
    """
    network = perceptual.load(backbone, weights, str(a.device))
    a, b = (2 * x.float() - 1 for x in _images(a, b, BACKBONES[backbone].least_side, "lpips"))
    return float(network(a.permute(2, 0, 1)[None], b.permute(2, 0, 1)[None]))


def quantise(image: Tensor) -> Tensor:  # [..., 3]
    """Round an image to the values in [0, 1] that an 8-bit PNG can store."""
    check_tensor(image, "quantise: the image")
    # The clamped, the multiplied and the rounded image are in memory at the same time.
    require(3 * image.element_size() * image.numel(), f"quantise: images {list(image.shape)}", "use smaller ones")
    return (image.clamp(0, 1) * 255).round() / 255


@dataclass(frozen=True)
class Quality:
    """The image metrics of a split: the means over its views, and the values of each view."""

    metrics: dict[str, float | None]  # means over the views
    missing: dict[str, str]  # why a metric is None
    per_view: list[ViewScore]


def evaluate(
    images: Iterable[tuple[str, Tensor, Tensor]],  # name, render [H, W, 3], truth [H, W, 3]
    *,
    background: tuple[float, float, float],
    quantised: bool = False,
    weights: dict[str, Path] | None = None,
) -> Quality:
    """Compute all metrics of all views of a split, and their means.

    PSNR of a view is capped (gsbench.measure.exact_views). A metric is None, and the reason is returned too, if the
    weights of its LPIPS network are missing, an image is too small for it, or it is not a number in a view.

    Args:
        images: name, render and ground truth of each view, at least one.
        background: the background colour of the ground truth; the metric `psnr_background_only` is the PSNR of an image
            that has only this colour.
        quantised: whether renders are rounded to 8 bits first.
        weights: the files with the weights of LPIPS' networks, by backbone (`gsbench.measure.perceptual.load`).

    Raises:
        InputError: sizes differ, or a weights file is missing or has the wrong SHA-256.
    """
    measures: dict[str, Callable[[Tensor, Tensor], float]] = {
        "psnr": capped_psnr,
        "psnr_channel_mean": psnr_channel_mean,
        "ssim": ssim,
        "psnr_background_only": lambda _, truth: capped_psnr(
            torch.tensor(background).to(truth).expand_as(truth), truth
        ),
    }
    least_side = {"ssim": SSIM_LEAST_SIDE}
    for backbone, network in BACKBONES.items():
        measures[f"lpips_{backbone}"] = partial(lpips, backbone=backbone, weights=(weights or {}).get(backbone))
        least_side[f"lpips_{backbone}"] = network.least_side
    scores: dict[str, list[float]] = {metric: [] for metric in measures}
    missing: dict[str, str] = {}
    per_view = []
    for name, render, truth in images:
        _check_images(render, truth, 1, f"evaluate: {name}")
        side = min(truth.shape[:2])
        shown = quantise(render) if quantised else render
        of_view: dict[str, float] = {}
        for metric, measure in measures.items():
            if side < least_side.get(metric, 1):
                missing[metric] = f"needs {least_side[metric]} pixels a side, {name} has {side}"
                continue
            try:
                of_view[metric] = measure(shown, truth)
            except BackboneMissing as reason:
                missing[metric] = str(reason)
        for metric, value in of_view.items():
            scores[metric].append(value)
            if math.isnan(value):
                missing.setdefault(metric, f"not a number in {name}")
        del of_view["psnr_background_only"]  # a property of the split and not of the render
        per_view.append(ViewScore(name, **of_view))
    metrics = {metric: None if metric in missing else fmean(values) for metric, values in scores.items()}
    return Quality(metrics, missing, per_view)


def _images(a: Tensor, b: Tensor, least_side: int, what: str) -> tuple[Tensor, Tensor]:
    """Convert two images to float64 and clamp them to [0, 1]; a metric needs memory for about eight such images.

    Raises:
        InputError: the arguments are not images of the same size.
    """
    _check_images(a, b, least_side, what)
    require(8 * 8 * a.numel(), f"{what}: two images {list(a.shape)}", "use smaller ones")
    return a.detach().double().clamp(0, 1), b.detach().double().clamp(0, 1)


def _check_images(a: Tensor, b: Tensor, least_side: int, what: str) -> None:
    """Raise InputError unless `a` and `b` are images of the same size, with at least `least_side` pixels a side."""
    for image in (a, b):
        check_tensor(image, f"{what}: an image")
        if image.ndim != 3 or image.shape[2] != 3:
            raise InputError(f"{what}: expected images [H, W, 3], got {list(image.shape)}")
    if a.shape != b.shape or a.device != b.device:
        raise InputError(
            f"{what}: expected two images of one size on one device, "
            f"got {list(a.shape)} on {a.device} and {list(b.shape)} on {b.device}"
        )
    if min(a.shape[:2]) < least_side:
        raise InputError(f"{what}: expected at least {least_side} pixels a side, got {list(a.shape)}")


def _squared_error(a: Tensor, b: Tensor) -> Tensor:  # [H, W, 3]
    a, b = _images(a, b, 1, "psnr")
    return (a - b).square()


def _decibels(mean_squared_error: Tensor) -> float:
    """Convert a mean squared error of images in [0, 1] to PSNR in dB."""
    return float(-10 * mean_squared_error.log10())

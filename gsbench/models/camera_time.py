"""Define `CameraTime`, the camera centre and the time for which a model returns 3D Gaussians, and draw mean times."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.tensors import check_number, check_tensor
from gsbench.scenes.scene import Camera, Points

TIME_MARGIN = 1e-6  # least distance from 0 and 1 of a time that is stored as its logit


class CameraTime(NamedTuple):
    """The camera centre and the time for which a model returns 3D Gaussians with colours.

    `CameraTime.of` takes a camera, and `CameraTime.at` a position; both check their arguments.

    Args:
        center: position of the camera, world units, a tensor [3].
        time: in [0, 1], a tensor []; None if the scene has no time.

    Example:
        >>> import torch
        >>> from gsbench import CameraTime
        >>> CameraTime.at(torch.tensor([0.0, -4.0, 0.0]), 0.25)
        CameraTime(center=tensor([ 0., -4.,  0.]), time=tensor(0.2500))
        >>> CameraTime.at(torch.zeros(2), 0.25)
        Traceback (most recent call last):
        ...
        gsbench.errors.InputError: query: center: expected shape [3], got [2]
    """

    center: Tensor  # [3]
    time: Tensor | None = None  # []

    @classmethod
    def of(cls, camera: Camera, time: float | Tensor | None) -> CameraTime:
        """Take the centre of a camera and a time in [0, 1]; raises InputError if the time is not a finite number."""
        return cls.at(camera.center, time)

    @classmethod
    def at(cls, center: Tensor, time: float | Tensor | None) -> CameraTime:
        """Take a position [3] and a time in [0, 1]; a tensor [] is kept, so that a CUDA graph can read it.

        Raises:
            InputError: `center` is no floating-point tensor [3], or `time` no finite number or tensor [] beside it.
        """
        check_tensor(center, "query: center")
        if center.shape != (3,):
            raise InputError(f"query: center: expected shape [3], got {list(center.shape)}")
        if isinstance(time, Tensor):
            check_tensor(time, "query: time", (center.dtype,))
            if time.dim() or time.device != center.device:
                raise InputError(
                    f"query: time: expected a number on {center.device}, got {list(time.shape)} on {time.device}"
                )
        elif time is not None:
            check_number(time, "query: time")
            time = center.new_full((), float(time))  # an int beyond 64 bits is a number too
        return cls(center, time)


def together(queries: Sequence[CameraTime]) -> CameraTime:
    """Return the queries of V views as one, with centres [V, 3] and times [V], for kernels that take several views."""
    times = [query.time for query in queries if query.time is not None]
    return CameraTime(torch.stack([query.center for query in queries]), torch.stack(times) if times else None)


def unit(vectors: Tensor) -> Tensor:
    """Normalise vectors [N, 3]. A vector shorter than 1e-10 becomes zero, with a gradient of zero."""
    square = vectors.square().sum(-1, keepdim=True)
    defined = square > 1e-20
    return torch.where(defined, vectors * torch.where(defined, square, 1.0).rsqrt(), 0.0)


def initial_times(points: Points, generator: torch.Generator, margin: float = 0.1) -> Tensor:
    """Return the first mean times of Gaussians, [N, 1]: those of the points, else uniform in [-margin, 1 + margin]."""
    if points.times is not None:
        return points.times[:, None]
    return torch.rand(len(points.means), 1, generator=generator) * (1 + 2 * margin) - margin


def times_inside(times: Tensor) -> Tensor:
    """Clip times to [TIME_MARGIN, 1 - TIME_MARGIN], where their logits are finite."""
    return times.clamp(TIME_MARGIN, 1 - TIME_MARGIN)

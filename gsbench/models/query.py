"""Define the query at which a model is sliced: a camera's centre and a time."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.tensors import check_number, check_tensor
from gsbench.scenes.scene import Camera


class Query(NamedTuple):
    """The place and the time at which slicing, colours and AGR are evaluated.

    `Query.of` takes a camera and `Query.at` a place; both check their arguments.

    Args:
        center: the camera's position [3], world units.
        time: the time in [0, 1], a tensor []; None if the scene has no time.

    Example:
        >>> import torch
        >>> from gsbench import Query
        >>> Query.at(torch.tensor([0.0, -4.0, 0.0]), 0.25)
        Query(center=tensor([ 0., -4.,  0.]), time=tensor(0.2500))
        >>> Query.at(torch.zeros(2), 0.25)
        Traceback (most recent call last):
        ...
        gsbench.errors.InputError: query: center: expected shape [3], got [2]
    """

    center: Tensor  # [3] where the camera is, world units
    time: Tensor | None = None  # [] in [0, 1], clips; None: the scene has no time

    @classmethod
    def of(cls, camera: Camera, time: float | Tensor | None) -> Query:
        """Make the query of a camera at a time; raises InputError as `at` does."""
        return cls.at(camera.center, time)

    @classmethod
    def at(cls, center: Tensor, time: float | Tensor | None) -> Query:
        """Make the query of a place at a time. If the time is a tensor, it stays one, so that a CUDA graph can read it.

        Args:
            center: the place [3], world units.
            time: in [0, 1], clips; None: the scene has no time.

        Raises:
            InputError: the place is not a tensor [3], or the time is not a finite number.
        """
        check_tensor(center, "query: center")
        if center.shape != (3,):
            raise InputError(f"query: center: expected shape [3], got {list(center.shape)}")
        if isinstance(time, Tensor):
            check_tensor(time, "query: time", (center.dtype,))
            if time.dim() or time.device != center.device:
                raise InputError(f"query: time: expected a number on {center.device}, got {list(time.shape)} on "
                                 f"{time.device}")  # fmt: skip
        elif time is not None:
            check_number(time, "query: time")
            time = center.new_full((), time)
        return cls(center, time)


def unit(vectors: Tensor) -> Tensor:
    """Normalise vectors [N, 3]; a vector too short to have a direction becomes zero, and so does its gradient."""
    square = vectors.square().sum(-1, keepdim=True)
    defined = square > 1e-20
    return torch.where(defined, vectors * torch.where(defined, square, 1.0).rsqrt(), 0.0)

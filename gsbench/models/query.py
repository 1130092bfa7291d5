"""What a model is asked for: Gaussians as they are seen from a place at a time."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsbench.scenes.scene import Camera


class Query(NamedTuple):
    """One question to a model, passed on through slicing, colours and AGR."""

    center: Tensor  # [3] where the camera is, world units
    time: Tensor | None = None  # [] in [0, 1], clips; None: the scene has no time

    @classmethod
    def of(cls, camera: Camera, time: float | Tensor | None) -> Query:
        """What a camera sees at a time."""
        return cls.at(camera.center, time)

    @classmethod
    def at(cls, center: Tensor, time: float | Tensor | None) -> Query:
        """From a place [3] at a time. A time on the device is read there, so that a recording can be replayed."""
        return cls(center, center.new_full((), time) if isinstance(time, float | int) else time)


def unit(vectors: Tensor) -> Tensor:
    """Vectors [N, 3] at length 1; a vector too short to have a direction becomes zero, and so does its gradient."""
    square = vectors.square().sum(-1, keepdim=True)
    defined = square > 1e-20
    return torch.where(defined, vectors * torch.where(defined, square, 1.0).rsqrt(), 0.0)

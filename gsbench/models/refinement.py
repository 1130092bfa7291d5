"""Change the parameters of Gaussians over time by AGR, the adaptive Gaussian refinement of 7DGS (section 4.3).

A deeper network can take its place, to compare networks over Gaussians of any number of dimensions.
"""

import functools
import math
from abc import ABC, abstractmethod

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gsbench.kernels.headers import HIDDEN
from gsbench.kernels.refine import refine
from gsbench.kernels.tape import collect_gradients, stack
from gsbench.models.networks import HiddenLayers, Linear, encode
from gsbench.models.portable_math import cos, sin

OCTAVES = 10  # K of the time encoding in the 7DGS paper


def encode_time(time: Tensor, octaves: int = OCTAVES) -> Tensor:
    """Return the positional encoding of a time [], (sin 2^k pi t, cos 2^k pi t) for k = 0 .. octaves-1, [2 octaves].

    That of several times [V] is [V, 2 octaves].
    """
    angles = time[..., None] * _frequencies(octaves, time.device, time.dtype)
    return torch.stack([sin(angles), cos(angles)], -1).flatten(-2)


@functools.cache
def _frequencies(octaves: int, device: torch.device, dtype: torch.dtype) -> Tensor:
    """Return the frequencies 2^k pi of the time encoding, [octaves]; they are cached to save GPU operations."""
    return math.pi * 2.0 ** torch.arange(octaves, device=device, dtype=dtype)


class Changes(nn.Module, ABC):
    """The base class of networks that add to raw parameters of Gaussians, as AGR does."""

    @abstractmethod
    def added(self, values: list[Tensor], time: Tensor) -> list[Tensor]:
        """Return what the network adds at a time to each of the raw parameters [N, c]."""

    def forward(
        self,
        values: list[Tensor],  # raw parameters [N, c]: first the means, which are the input, then the covariance's
        time: Tensor,  # [] in [0, 1], or [V] those of several views
        *,
        by_kernel: bool = False,  # whether a subclass that has a kernel (float32) may use it
        rows: int | None = None,  # only the first `rows` Gaussians change; None: all
        intervals: Tensor | None = None,  # with `rows`, [rows, 2]: first and last time of the change; None: always
    ) -> list[Tensor]:
        """Return the raw parameters plus the outputs of the networks at a time, or at several times [V, N, c]."""
        if time.dim():
            of_views = [self.forward(values, at, rows=rows, intervals=intervals) for at in time.unbind()]
            return stack(list(zip(*of_views, strict=True)))
        before = values if rows is None else [x[:rows] for x in values]
        moved = [x + added for x, added in zip(before, self.added(before, time), strict=True)]
        if rows is None:
            return moved
        if intervals is not None:
            awake = ((intervals[:, 0] <= time) & (time <= intervals[:, 1]))[:, None]
            moved = [torch.where(awake, x, y) for x, y in zip(moved, before, strict=True)]
        return [torch.cat([x, value[rows:]]) for x, value in zip(moved, values, strict=True)]


class Refinement(Changes):
    """The networks of AGR, the adaptive Gaussian refinement (7DGS, eq. 14 and 15).

    Each network has one hidden layer of 64 units. Its input is the means of a Gaussian and an encoding of the time, its
    output is added to raw parameters. Each mean (position, time, direction) has its own network. One more network
    changes all parameters of the covariance. Output layers start at zero, so AGR changes nothing at first.
    """

    units: Tensor  # [sum of outputs]

    def __init__(
        self,
        outputs: list[int],  # of each network: one for each mean, and the last for the covariance
        generator: torch.Generator,  # the source of the random weights of the first layers
        octaves: int = OCTAVES,  # frequencies of the time encoding; many of them overfit a scene of few frames
        units: Tensor | None = None,  # [sum of outputs] the sizes of inputs and outputs in this scene; None: ones
    ) -> None:
        super().__init__()
        self.features = sum(outputs[:-1])
        self.octaves = octaves
        self.register_buffer("units", torch.ones(sum(outputs)) if units is None else units)
        width = self.features + 2 * octaves
        self.widths = outputs
        # The first layers of all networks have the same input, so they are one matrix with 64 rows for each network.
        # The second layers are one matrix with a row for each output.
        self.weight_in = nn.Parameter(torch.empty(HIDDEN * len(outputs), width))
        self.bias_in = nn.Parameter(torch.empty(HIDDEN * len(outputs)))
        bound = 1 / math.sqrt(width)  # torch.nn.Linear's own initialisation, drawn from the run's seed
        nn.init.uniform_(self.weight_in, -bound, bound, generator=generator)
        nn.init.uniform_(self.bias_in, -bound, bound, generator=generator)
        self.weight_out = nn.Parameter(torch.zeros(sum(outputs), HIDDEN))
        self.bias_out = nn.Parameter(torch.zeros(sum(outputs)))

    def forward(
        self,
        values: list[Tensor],
        time: Tensor,
        *,
        by_kernel: bool = False,
        rows: int | None = None,
        intervals: Tensor | None = None,
    ) -> list[Tensor]:
        """Return the raw parameters plus the outputs; the kernel of AGR stores no hidden layer."""
        if not by_kernel:
            return super().forward(values, time, rows=rows, intervals=intervals)
        return refine(
            values,
            self.weight_in,
            self.bias_in,
            self.weight_out,
            self.bias_out,
            self.units,
            encode_time(time, self.octaves),
            rows=rows,
            intervals=intervals,
            time=None if intervals is None else time,
        )

    def added(self, values: list[Tensor], time: Tensor) -> list[Tensor]:
        """Return units (W_out relu(W_in (means / units, encoded time) + b_in) + b_out), split as the parameters are.

        The units scale columns and rows of the layers, which are fewer than the parameters of all Gaussians.
        """
        weight_in, bias_in = self.weight_in[:, : self.features] / self.units[: self.features], self.at_time(time)
        weights_out = (self.weight_out * self.units[:, None]).split(self.widths)
        biases_out = (self.bias_out * self.units).split(self.widths)
        features = torch.cat(values[: len(self.widths) - 1], -1)
        hidden = torch.relu(F.linear(features, weight_in, bias_in)).split(HIDDEN, -1)
        layers = zip(hidden, weights_out, biases_out, strict=True)
        outputs = torch.cat([F.linear(h, w, b) for h, w, b in layers], -1)
        return list(outputs.split([x.shape[-1] for x in values], -1))

    def at_time(self, time: Tensor) -> Tensor:
        """Return the contribution of the encoded time to the hidden layer, a vector that all Gaussians share."""
        return F.linear(encode_time(time, self.octaves), self.weight_in[:, self.features :], self.bias_in)


class DeepRefinement(Changes):
    """One network for all parameters in the place of AGR's, with any number of hidden layers and ReLU after each.

    It has what distinguishes the field of Deformable-3DGS from AGR: depth, width, and means that are encoded,
    [x, sin x, cos x, .. cos 2^(octaves-1) x], with the input once more in the middle, and without a gradient to the
    means that it reads. Its output layer starts at zero, as AGR's.
    """

    units: Tensor  # [sum of outputs]

    def __init__(
        self,
        outputs: list[int],  # of each mean, and the last for the covariance
        generator: torch.Generator,
        *,
        width: int,  # of the hidden layers
        depth: int,  # the number of hidden layers
        octaves: int,  # of the encoding of times
        mean_octaves: int,  # of the encoding of means; 0: they are read as they are
        units: Tensor,  # [sum of outputs] the sizes of inputs and outputs in this scene
    ) -> None:
        super().__init__()
        self.inputs, self.octaves, self.mean_octaves = len(outputs) - 1, octaves, mean_octaves
        self.register_buffer("units", units)
        inputs = sum(outputs[:-1]) * (1 + 2 * mean_octaves) + 2 * octaves
        self.hidden = HiddenLayers(inputs, width, depth, generator)
        self.head = Linear(width, sum(outputs), generator)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def added(self, values: list[Tensor], time: Tensor) -> list[Tensor]:
        """Return units network(means / units, encoded, and encoded time), split as the parameters are."""
        means = torch.cat(values[: self.inputs], -1).detach()
        means = means / self.units[: means.shape[-1]]
        gamma = encode_time(time, self.octaves)
        inputs = torch.cat([encode(means, self.mean_octaves), gamma.expand(len(means), -1)], -1)
        (outputs,) = collect_gradients(self.head(self.hidden(inputs)))
        return list((outputs * self.units).split([x.shape[-1] for x in values], -1))

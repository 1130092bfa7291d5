"""Move the raw parameters of Gaussians with time by AGR, the adaptive Gaussian refinement (7DGS, section 4.3)."""

import functools
import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gsbench.kernels.headers import HIDDEN
from gsbench.kernels.refine import refine

OCTAVES = 10  # K of the time encoding in the 7DGS paper


def encode_time(time: Tensor, octaves: int = OCTAVES) -> Tensor:
    """Return gamma(t) = (sin 2^0 pi t, cos 2^0 pi t, .., sin 2^(K-1) pi t, cos 2^(K-1) pi t), [] -> [2 K]."""
    angles = time * _frequencies(octaves, time.device, time.dtype)
    return torch.stack([angles.sin(), angles.cos()], -1).flatten()


@functools.cache
def _frequencies(octaves: int, device: torch.device, dtype: torch.dtype) -> Tensor:
    """Return the frequencies 2^k pi of K octaves, [K]; they are cached, because each operation on a GPU takes time."""
    return math.pi * 2.0 ** torch.arange(octaves, device=device, dtype=dtype)


class Refinement(nn.Module):
    """Perceptrons f x 64 x c that read f = (means, gamma(t)): one for each mean, one for all other parameters.

    See 7DGS eq. 14 and 15. The output layers start at zero, so that switching AGR on changes nothing. f does not depend
    on the view.
    """

    units: Tensor  # [sum of outputs]

    def __init__(
        self, outputs: list[int], generator: torch.Generator, octaves: int = OCTAVES, units: Tensor | None = None
    ) -> None:
        """Make the networks with output layers of zero.

        Args:
            outputs: the width of each network; the last one moves all that is not a mean.
            generator: samples the first layers.
            octaves: K of gamma(t). With many octaves and few frames the networks memorise each frame.
            units: [sum of outputs], the unit of each number for the networks, so that the size of the scene does not
                matter; by default ones.
        """
        super().__init__()
        self.features = sum(outputs[:-1])
        self.octaves = octaves
        self.register_buffer("units", torch.ones(sum(outputs)) if units is None else units)
        width = self.features + 2 * octaves
        self.widths = outputs
        # The first layers of all networks read the same f: they are one matrix, 64 rows for each. So are the second
        # layers, a row for each number that is moved.
        self.weight_in = nn.Parameter(torch.empty(HIDDEN * len(outputs), width))
        self.bias_in = nn.Parameter(torch.empty(HIDDEN * len(outputs)))
        bound = 1 / math.sqrt(width)  # torch.nn.Linear's own initialisation, drawn from the run's seed
        nn.init.uniform_(self.weight_in, -bound, bound, generator=generator)
        nn.init.uniform_(self.bias_in, -bound, bound, generator=generator)
        self.weight_out = nn.Parameter(torch.zeros(sum(outputs), HIDDEN))
        self.bias_out = nn.Parameter(torch.zeros(sum(outputs)))

    def forward(
        self, values: list[Tensor], time: Tensor, *, by_kernel: bool = False, rows: int | None = None,
        intervals: Tensor | None = None,
    ) -> list[Tensor]:  # fmt: skip
        """Move raw parameters [N, c] to a time []; the parameters that are read come first.

        The kernel (float32) writes no hidden layer to memory. With `rows` only the first Gaussians are
        moved, with `intervals` [rows, 2] each of them only from a first to a last time.
        """
        if by_kernel:
            gamma = encode_time(time, self.octaves)
            return refine(values, self.weight_in, self.bias_in, self.weight_out, self.bias_out, self.units, gamma,
                          rows=rows, intervals=intervals, time=None if intervals is None else time)  # fmt: skip
        if rows is not None:
            resting = [x[:rows] for x in values]
            moved = self(resting, time)
            if intervals is not None:
                awake = ((intervals[:, 0] <= time) & (time <= intervals[:, 1]))[:, None]
                moved = [torch.where(awake, x, y) for x, y in zip(moved, resting, strict=True)]
            return [torch.cat([x, rest[rows:]]) for x, rest in zip(moved, values, strict=True)]
        # The units scale rows and columns of the layers instead of the parameters of every Gaussian.
        weight_in, bias_in = self.weight_in[:, : self.features] / self.units[: self.features], self.at_time(time)
        weights_out = (self.weight_out * self.units[:, None]).split(self.widths)
        biases_out = (self.bias_out * self.units).split(self.widths)
        features = torch.cat(values[: len(self.widths) - 1], -1)
        parts = torch.relu(F.linear(features, weight_in, bias_in)).split(HIDDEN, -1)
        layers = zip(parts, weights_out, biases_out, strict=True)
        residuals = torch.cat([F.linear(h, w, b) for h, w, b in layers], -1).split([x.shape[-1] for x in values], -1)
        return [x + residual for x, residual in zip(values, residuals, strict=True)]

    def at_time(self, time: Tensor) -> Tensor:
        """Compute what gamma(t) adds to the hidden units; all Gaussians share it, so it is one vector."""
        return F.linear(encode_time(time, self.octaves), self.weight_in[:, self.features :], self.bias_in)

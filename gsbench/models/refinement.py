"""AGR, the adaptive Gaussian refinement: small networks that move a Gaussian's raw parameters with time (7DGS, 4.3)."""

import functools
import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gsbench.kernels.refine import refine

OCTAVES = 10  # K of the time encoding
HIDDEN = 64


def encode_time(time: Tensor) -> Tensor:
    """gamma(t) = (sin 2^0 pi t, cos 2^0 pi t, .., sin 2^9 pi t, cos 2^9 pi t), [] -> [20]."""
    angles = time * _frequencies(time.device, time.dtype)
    return torch.stack([angles.sin(), angles.cos()], -1).flatten()


@functools.cache
def _frequencies(device: torch.device, dtype: torch.dtype) -> Tensor:
    """2^k pi, [10]: made once, as on a GPU every operation of a few numbers costs as much as one of thousands."""
    return math.pi * 2.0 ** torch.arange(OCTAVES, device=device, dtype=dtype)


class Refinement(nn.Module):
    """Perceptrons f x 64 x c that read the means and gamma(t) = f, one to move each mean and one to move the rest.

    7DGS eq. 14 and 15. The output layers start at zero, so that switching the refinement on changes nothing. f does not
    depend on the view.
    """

    def __init__(self, outputs: list[int], generator: torch.Generator) -> None:
        """Make one network for each entry of `outputs`, its width; the last is of what is no mean."""
        super().__init__()
        self.features = sum(outputs[:-1])
        width = self.features + 2 * OCTAVES
        # The first layers of all networks read the same f: they are one matrix, 64 rows for each.
        self.weight_in = nn.Parameter(torch.empty(HIDDEN * len(outputs), width))
        self.bias_in = nn.Parameter(torch.empty(HIDDEN * len(outputs)))
        bound = 1 / math.sqrt(width)  # torch.nn.Linear's own initialisation, drawn from the run's seed
        nn.init.uniform_(self.weight_in, -bound, bound, generator=generator)
        nn.init.uniform_(self.bias_in, -bound, bound, generator=generator)
        self.weights_out = nn.ParameterList([nn.Parameter(torch.zeros(width, HIDDEN)) for width in outputs])
        self.biases_out = nn.ParameterList([nn.Parameter(torch.zeros(width)) for width in outputs])

    def forward(self, values: list[Tensor], time: Tensor, *, native: bool = False) -> list[Tensor]:
        """Raw parameters [N, c] at one time [], moved: those that are read, then the others.

        With `native`, by the kernel (float32), which never writes a hidden layer to memory.
        """
        weight_in, bias_in = self.weight_in[:, : self.features], self.at_time(time)
        if native:
            return refine(values, weight_in, bias_in, list(self.weights_out), list(self.biases_out))
        features = torch.cat(values[: len(self.weights_out) - 1], -1)
        parts = torch.relu(F.linear(features, weight_in, bias_in)).split(HIDDEN, -1)
        layers = zip(parts, self.weights_out, self.biases_out, strict=True)
        residuals = torch.cat([F.linear(h, w, b) for h, w, b in layers], -1).split([x.shape[-1] for x in values], -1)
        return [x + residual for x, residual in zip(values, residuals, strict=True)]

    def at_time(self, time: Tensor) -> Tensor:
        """What gamma(t), the same for all Gaussians, adds to every hidden unit: one vector, not 20 more columns."""
        return F.linear(encode_time(time), self.weight_in[:, self.features :], self.bias_in)

"""AGR, the adaptive Gaussian refinement: small networks that move a Gaussian's raw parameters with time (7DGS, 4.3)."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gsbench.kernels.refine import refine

OCTAVES = 10  # K of the time encoding
HIDDEN = 64


def encode_time(time: Tensor) -> Tensor:
    """gamma(t) = (sin 2^0 pi t, cos 2^0 pi t, .., sin 2^9 pi t, cos 2^9 pi t), [] -> [20]."""
    angles = time * math.pi * 2.0 ** torch.arange(OCTAVES, device=time.device, dtype=time.dtype)
    return torch.stack([angles.sin(), angles.cos()], -1).flatten()


class Refinement(nn.Module):
    """One two-layer perceptron f x 64 x c for each group of raw parameters, f = means + gamma(t) (7DGS eq. 14, 15).

    The output layers start at zero, so that switching the refinement on changes nothing. f does not depend on the view.
    """

    def __init__(self, features: int, outputs: list[int], generator: torch.Generator) -> None:
        """Make one network for each entry of `outputs`, its width, on `features` numbers and the time encoding."""
        super().__init__()
        self.features = features
        width = features + 2 * OCTAVES
        # The first layers of all networks read the same f: they are one matrix, 64 rows for each.
        self.weight_in = nn.Parameter(torch.empty(HIDDEN * len(outputs), width))
        self.bias_in = nn.Parameter(torch.empty(HIDDEN * len(outputs)))
        bound = 1 / math.sqrt(width)  # torch.nn.Linear's own initialisation, drawn from the run's seed
        nn.init.uniform_(self.weight_in, -bound, bound, generator=generator)
        nn.init.uniform_(self.bias_in, -bound, bound, generator=generator)
        self.weights_out = nn.ParameterList([nn.Parameter(torch.zeros(width, HIDDEN)) for width in outputs])
        self.biases_out = nn.ParameterList([nn.Parameter(torch.zeros(width)) for width in outputs])

    def forward(self, features: Tensor, time: Tensor, *, native: bool = False) -> list[Tensor]:
        """Residuals, one [N, c] for each output, of N feature rows [N, features] at one time [].

        With `native`, by the CPU kernel (float32), which never writes a hidden layer to memory.
        """
        weight_in, bias_in = self.weight_in[:, : self.features], self.at_time(time)
        if native:
            return refine(features, weight_in, bias_in, list(self.weights_out), list(self.biases_out))
        parts = torch.relu(F.linear(features, weight_in, bias_in)).split(HIDDEN, -1)
        return [F.linear(h, w, b) for h, w, b in zip(parts, self.weights_out, self.biases_out, strict=True)]

    def at_time(self, time: Tensor) -> Tensor:
        """What gamma(t), the same for all Gaussians, adds to every hidden unit: one vector, not 20 more columns."""
        return F.linear(encode_time(time), self.weight_in[:, self.features :], self.bias_in)

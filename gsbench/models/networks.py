"""Define the layers of networks that change Gaussians over time or decode pixels, and the encoding of positions."""

import math

import torch
from torch import Tensor, nn

from gsbench.models.portable_math import cos, linear, sin


def encode(x: Tensor, octaves: int) -> Tensor:
    """Return [x, sin x, cos x, sin 2x, cos 2x, .. cos 2^(octaves-1) x], [N, C] -> [N, C (1 + 2 octaves)]."""
    angles = x[:, None] * 2.0 ** torch.arange(octaves, dtype=x.dtype, device=x.device)[:, None]  # [N, octaves, C]
    return torch.cat([x, torch.stack([sin(angles), cos(angles)], 2).flatten(1)], -1)


class Linear(nn.Module):
    """A layer W x + b, with ReLU or without, whose weights start as those of torch.nn.Linear, drawn from the seed."""

    bias: Tensor

    def __init__(
        self, inputs: int, outputs: int, generator: torch.Generator, *, relu: bool = False, bias: bool = True
    ) -> None:
        super().__init__()
        self.relu = relu
        bound = 1 / math.sqrt(inputs)
        self.weight = nn.Parameter(torch.empty(outputs, inputs).uniform_(-bound, bound, generator=generator))
        if bias:
            self.bias = nn.Parameter(torch.empty(outputs).uniform_(-bound, bound, generator=generator))
        else:
            self.register_buffer("bias", torch.zeros(outputs), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """Apply the layer to [N, inputs]."""
        return linear(x, self.weight, self.bias, relu=self.relu)


class HiddenLayers(nn.Module):
    """The hidden layers of Deformable-3DGS' network (section 3.2), with ReLU after each.

    Layer depth // 2 + 1, counted from 0, reads the input once more, beside the layer before it.
    """

    def __init__(self, inputs: int, width: int, depth: int, generator: torch.Generator) -> None:
        super().__init__()
        self.rereads = depth // 2 + 1
        widths = [inputs, *[width] * (depth - 1)]
        widths = [n + inputs if i == self.rereads else n for i, n in enumerate(widths)]
        self.layers = nn.ModuleList(Linear(n, width, generator, relu=True) for n in widths)

    def forward(self, x: Tensor) -> Tensor:
        """Apply the layers to [N, inputs]; returns [N, width]."""
        hidden = x
        for i, layer in enumerate(self.layers):
            hidden = layer(torch.cat([x, hidden], -1) if i == self.rereads else hidden)
        return hidden

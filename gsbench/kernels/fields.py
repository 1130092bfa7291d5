"""Compute what all Gaussians of a field share, its networks and planes, on the CPU: the same bits for any threads."""

from typing import Any

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.operation import Gradient, Input, Operation, Output

# y = W x + b for every row x, or max(0, y) with `relu`. Rows of which the loss has no gradient cost nothing in the
# backward pass.
linear = Operation(
    "linear",
    inputs={
        "x": Input("N C", Gradient.ON_REQUEST),
        "weight": Input("K C", Gradient.SUMMED),
        "bias": Input("K", Gradient.SUMMED),
    },
    outputs={"y": Output("N K")},
    numbers={"relu": bool},
    memory="layers of networks",
)

# The numbers of channels, of levels and of nodes along each axis of the planes, see `sample_planes`.
SPACE: dict[str, type] = dict.fromkeys(("C", "levels", "x", "y", "z"), int)
SIZE: dict[str, type] = SPACE | {"t": int}


def _sizes(_: dict[str, Tensor], numbers: dict[str, Any]) -> dict[str, int]:
    """Return the numbers of nodes in all planes of all levels, and of features."""
    channels, levels, x, y, z, t = (numbers.get(name, 2) for name in SIZE)  # t is missing in `sample_planes`
    if not (1 <= levels <= 8 and min(x, y, z, t) >= 2 and max(x, y, z, t) <= 4096):
        raise InputError(f"planes: expected 1 to 8 levels of 2 to 4096 nodes, got {levels} of {x, y, z, t}")
    return {  # x, y and z are 2^level times those of the first level
        "in_space": sum((x * y + x * z + y * z) << 2 * level for level in range(levels)),
        "in_time": sum((t * (x + y + z)) << level for level in range(levels)),
        "F": levels * channels,
    }


# Each level has planes (x, y), (x, z), (y, z) and (x, t), (y, t), (z, t). Its C features are the product of the samples
# of its planes, bilinear and constant beyond the border: at positions from `first` to `last`, and a time from -1 to 1.
# `of_space` and `of_time` have the nodes of all levels, in each those of three planes, and in each the rows of nodes
# along its first axis. x, y, z and t are the numbers of nodes in the first level; of x, y and z, each level has twice
# as many as the level before. The products of the samples in space do not change with the time.
sample_planes = Operation(
    "sample_planes",
    inputs={
        "positions": Input("N 3"),
        "first": Input("3", Gradient.REFUSED),
        "last": Input("3", Gradient.REFUSED),
        "of_space": Input("in_space C", Gradient.SUMMED),
    },
    outputs={"products": Output("N F")},
    numbers=SPACE,
    derive=_sizes,
    memory="features of planes",
)

# The network of a field at one time. It reads the features, which are `products` times the samples in planes with t. A
# layer of H units with ReLU is followed by heads of one more such layer and one without ReLU each. In the memory of y,
# head h has N rows of ends[h] - ends[h - 1] numbers, which follow those of the head before. Features and hidden layers
# are not stored; rows are left out as in `linear`.
field = Operation(
    "field",
    inputs={
        "products": Input("N F", Gradient.ADDED),
        "positions": Input("N 3", Gradient.ADDED),
        "first": Input("3", Gradient.REFUSED),
        "last": Input("3", Gradient.REFUSED),
        "time": Input("", Gradient.REFUSED),
        "of_time": Input("in_time C", Gradient.ADDED),
        "first_weight": Input("H F", Gradient.SUMMED),
        "first_bias": Input("H", Gradient.SUMMED),
        "hidden_weight": Input("heads H H", Gradient.SUMMED),
        "hidden_bias": Input("heads H", Gradient.SUMMED),
        "last_weight": Input("K H", Gradient.SUMMED),
        "last_bias": Input("K", Gradient.SUMMED),
        "ends": Input("heads", Gradient.REFUSED, (torch.int32,)),
    },
    outputs={"y": Output("N K")},
    numbers=SIZE,
    derive=_sizes,
    memory="outputs of networks",
)

# The sum over planes of the mean square of second differences along the rows, and for those with t of the mean distance
# from 1, with a weight for each.
plane_penalty = Operation(
    "plane_penalty",
    inputs={"of_space": Input("in_space C"), "of_time": Input("in_time C")},
    outputs={"penalty": Output("")},
    numbers=SIZE | {"space_smoothness": float, "time_smoothness": float, "time_sparsity": float},
    derive=_sizes,
)

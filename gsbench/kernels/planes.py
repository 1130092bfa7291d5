"""Sample the planes of features of a field on the CPU, with the same bits for any number of threads."""

from typing import Any

from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.operation import Gradient, Input, Operation, Output


def _sizes(tensors: dict[str, Tensor], numbers: dict[str, Any]) -> dict[str, int]:
    """Return the number of nodes in all planes of all levels."""
    levels, x, y, z, t = (numbers[name] for name in ("levels", "x", "y", "z", "t"))
    if not (1 <= levels <= 8 and min(x, y, z, t) >= 2 and max(x, y, z, t) <= 4096):
        raise InputError(f"sample_planes: expected 1 to 8 levels of 2 to 4096 nodes, got {levels} of {x, y, z, t}")
    of_level = (
        t * (x + y + z) << level if "time" in tensors else x * y + x * z + y * z << 2 * level for level in range(levels)
    )
    return {"M": sum(of_level)}


# Each level has three planes: (x, y), (x, z) and (y, z), or with a time (x, t), (y, t) and (z, t). Its features are the
# product of the three samples, bilinear and constant beyond the border, and of `factors`. `nodes` has all levels, in
# each the three planes, and in each the rows of nodes along its first axis. x, y, z and t are the numbers of nodes in
# the first level; of x, y and z, each level has twice as many as the level before.
sample_planes = Operation(
    "sample_planes",
    inputs={
        "coordinates": Input("N 3"),  # from -1 at the first to 1 at the last node
        "nodes": Input("M C", Gradient.SUMMED),
        "factors": Input("N levels C", left_out_with="time"),
        "time": Input("", Gradient.REFUSED, left_out_with="time"),  # a coordinate too
    },
    outputs={"features": Output("N levels C")},
    numbers={"levels": int, "x": int, "y": int, "z": int, "t": int},
    derive=_sizes,
    memory="features of planes",
)

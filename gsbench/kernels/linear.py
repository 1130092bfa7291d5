"""Compute a layer of a network on the CPU, with the same bits for any number of threads."""

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

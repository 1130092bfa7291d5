"""Slice balls: log radii to factors, logits to opacities."""

from gsbench.kernels.operation import Input, Operation, Output

slice_ball = Operation(
    "slice_ball",
    inputs={"radii": Input("N 1"), "opacities": Input("N")},  # logarithms, logits
    outputs={"factors": Output("N 3 3"), "opacities": Output("N")},
)

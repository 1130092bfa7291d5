"""Time the stages of a frame: AGR, conditioning, colours; projection, binning, blending."""

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from gsbench.kernels.tape import Differentiable, Tape
from gsbench.measure.speed import Laps

SLICE, RASTER = "slice", "raster"
STAGES = {SLICE: ("AGR", "conditioning", "colours"), RASTER: ("projection", "binning", "blending")}
# By the name of an operation, the stage that it is the last part of, and the one that has ended when it begins.
_ENDS = {"refine": "AGR", "show_colors": "colours", "project": "projection", "blend": "blending"}
_FOLLOWS = {"show_colors": "conditioning", "blend": "binning"}


class StageWatch(Tape):
    """Times the slice and the raster of a frame, each by its stages where kernels compute them.

    ``with StageWatch(device) as watch: ...; watch.end(SLICE); ...; watch.end(RASTER)``. It stands where a tape does, so
    each operation of the kernels tells when it begins and ends; it notes nothing, and there is no gradient. What torch
    computes alone is not divided: it is the slice, or the raster.
    """

    def __init__(self, device: str) -> None:
        """Begin."""
        super().__init__()
        self._laps = Laps(device)

    def record(self, operation: Differentiable, tensors: list[Tensor], numbers: Sequence[Any]) -> list[Tensor]:
        """Run an operation, and end the stages that end with it."""
        if operation.name in _FOLLOWS:
            self._laps.end(_FOLLOWS[operation.name])
        outputs, _ = operation.run(tensors, numbers)
        if operation.name in _ENDS:
            self._laps.end(_ENDS[operation.name])
        return outputs

    def end(self, part: str) -> None:
        """End the slice or the raster: what is left of it belongs to its last stage where that has run."""
        last = STAGES[part][-1]
        self._laps.end(last if self._laps.has(last) else part)

    @property
    def ms(self) -> dict[str, float]:
        """The milliseconds by stage."""
        return {name: 1000 * seconds for name, seconds in self._laps.seconds.items()}


def part_of(stage: str) -> str:
    """Return which part of a frame a stage is of, `slice` or `raster`."""
    return SLICE if stage == SLICE or stage in STAGES[SLICE] else RASTER

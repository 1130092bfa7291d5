"""Time the stages of a frame: AGR, conditioning, colours; projection, binning, blending."""

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from gsbench.kernels.tape import Differentiable, Tape
from gsbench.measure.speed import Laps

SLICE, RASTER = "slice", "raster"
STAGES = {SLICE: ("AGR", "conditioning", "colours"), RASTER: ("projection", "binning", "blending")}
# By the name of an operation: the stage that ends with it, and the stage that ends before it.
_ENDS = {"refine": "AGR", "show_colors": "colours", "project": "projection", "blend": "blending"}
_FOLLOWS = {"show_colors": "conditioning", "blend": "binning"}


class StageWatch(Tape):
    """Times the slice and the raster of a frame, each by its stages where kernels compute them.

    ``with StageWatch(device) as watch: ...; watch.end(SLICE); ...; watch.end(RASTER)``. It takes the place of a tape,
    so each kernel operation reports its begin and end; it records no operation, and there is no gradient. Work that
    torch computes alone is one stage: the slice, or the raster.
    """

    def __init__(self, device: str) -> None:
        """Start with no stage measured."""
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
        """End the slice or the raster; the rest of its time belongs to its last stage, if that stage has run."""
        last = STAGES[part][-1]
        self._laps.end(last if self._laps.has(last) else part)

    @property
    def ms(self) -> dict[str, float]:
        """Return the milliseconds by stage."""
        return {name: 1000 * seconds for name, seconds in self._laps.seconds.items()}


def part_of(stage: str) -> str:
    """Return the part of a frame that a stage belongs to, `slice` or `raster`."""
    return SLICE if stage == SLICE or stage in STAGES[SLICE] else RASTER

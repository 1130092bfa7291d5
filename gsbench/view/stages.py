"""Time the stages of slicing (AGR, conditioning, colours) and of rasterization (projection, binning, blending).

Slicing computes the conditional 3D Gaussians at a time and a viewpoint. AGR is their neural refinement.
"""

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from gsbench.kernels.tape import Differentiable, Tape
from gsbench.measure.speed import Laps

SLICE, RASTER = "slice", "raster"
STAGES = {SLICE: ("AGR", "conditioning", "colours"), RASTER: ("projection", "binning", "blending")}
# By the name of a kernel operation: the stage that ends after it, and the stage that ends before it.
_ENDS = {"refine": "AGR", "show_colors": "colours", "project": "projection", "blend": "blending"}
_FOLLOWS = {"show_colors": "conditioning", "blend": "binning"}


class StageWatch(Tape):
    """Times the two parts of a frame, slicing (computing its 3D Gaussians) and rasterization, and their stages.

    Usage: ``with StageWatch(device) as watch: ...; watch.end(SLICE); ...; watch.end(RASTER)``. The watch replaces the
    tape that records kernel calls for the backward pass. Thus it sees when each kernel begins and ends. It records no
    kernel calls, so there are no gradients. If torch computes or rasterizes the Gaussians, this is timed as a single
    stage.
    """

    def __init__(self, device: str) -> None:
        """Start a watch that has not measured any stage yet."""
        super().__init__()
        self._laps = Laps(device)

    def record(self, operation: Differentiable, tensors: list[Tensor], numbers: Sequence[Any]) -> list[Tensor]:
        """Run a kernel; if a stage of the frame ends just before or just after this kernel, store the stage's time."""
        if operation.name in _FOLLOWS:
            self._laps.end(_FOLLOWS[operation.name])
        outputs, _ = operation.run(tensors, numbers)
        if operation.name in _ENDS:
            self._laps.end(_ENDS[operation.name])
        return outputs

    def end(self, part: str) -> None:
        """End one of the two parts of a frame: computing its 3D Gaussians, or rasterizing them.

        The time since the last stage of this part ended is added to that stage. If no stage was measured, the whole
        part is one stage.
        """
        last = STAGES[part][-1]
        self._laps.end(last if self._laps.has(last) else part)

    @property
    def ms(self) -> dict[str, float]:
        """Return the milliseconds of each stage that was measured."""
        return {name: 1000 * seconds for name, seconds in self._laps.seconds.items()}


def part_of(stage: str) -> str:
    """Return the part of a frame to which a stage belongs: `slice` (compute 3D Gaussians) or `raster`."""
    return SLICE if stage == SLICE or stage in STAGES[SLICE] else RASTER

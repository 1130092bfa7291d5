"""Choose the resolution of a frame of the viewer: low while the camera moves, full when the camera rests."""

import math

MOVING_MS = 40.0  # time limit of a frame while the camera moves
ROUNDING_MS = 3000.0  # about what the bound on the error of float32 may take when the camera rests
LEAST_PIXELS = 96 * 96
MOST_PIXELS = 3840 * 2160  # of a frame at rest; a larger window shows it enlarged


class Resolution:
    """Chooses the resolution of one browser's frames from the milliseconds of the previous frame."""

    def __init__(self, limit_ms: float = MOVING_MS) -> None:
        """Assume for the first frame that 96 x 96 pixels take as long as a limited frame may take.

        Args:
            limit_ms: the time limit of a limited frame, milliseconds.
        """
        self._limit_ms = limit_ms
        self._ms_per_pixel = limit_ms / LEAST_PIXELS
        self._slice_ms = 0.0

    def took(self, pixels: int, slice_ms: float, raster_ms: float) -> None:
        """Store the milliseconds of the last frame; those for computing 3D Gaussians do not depend on resolution."""
        self._ms_per_pixel, self._slice_ms = raster_ms / max(1, pixels), slice_ms

    def size(self, width: int, height: int, limited: bool) -> tuple[int, int]:
        """Return the width and height in pixels at which to render a frame for a window of the given size.

        Args:
            width: the width of the window, pixels.
            height: its height.
            limited: whether the frame must be ready within the time limit; its resolution may be lower for that.
        """
        wanted = float(min(width * height, MOST_PIXELS))
        if limited:
            affordable = (self._limit_ms - self._slice_ms) / max(self._ms_per_pixel, 1e-9)
            wanted = min(wanted, max(LEAST_PIXELS, affordable))
        scale = math.sqrt(wanted / (width * height))
        return max(1, round(scale * width)), max(1, round(scale * height))

"""Choose the resolution of a frame of the viewer: low while the camera moves, full when it rests."""

import math

MOVING_MS = 40.0  # what a frame may take while the camera moves
LEAST_PIXELS = 96 * 96
MOST_PIXELS = 1280 * 960  # of a frame at rest; a larger window shows it enlarged


class Resolution:
    """The resolution of one client's frames, chosen by the milliseconds of the previous frame."""

    def __init__(self) -> None:
        """Assume at first that a frame of 96 x 96 takes MOVING_MS."""
        self._ms_per_pixel = MOVING_MS / LEAST_PIXELS
        self._slice_ms = 0.0

    def took(self, pixels: int, slice_ms: float, raster_ms: float) -> None:
        """Learn from a frame's milliseconds; slicing takes the same time for any number of pixels."""
        self._ms_per_pixel, self._slice_ms = raster_ms / max(1, pixels), slice_ms

    def size(self, width: int, height: int, moving: bool) -> tuple[int, int]:
        """Return the width and height in pixels of a frame for a window of that size."""
        wanted = float(min(width * height, MOST_PIXELS))
        if moving:
            affordable = (MOVING_MS - self._slice_ms) / max(self._ms_per_pixel, 1e-9)
            wanted = min(wanted, max(LEAST_PIXELS, affordable))
        scale = math.sqrt(wanted / (width * height))
        return max(1, round(scale * width)), max(1, round(scale * height))

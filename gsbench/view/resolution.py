"""Choose the resolution of a frame of the viewer: low while the camera moves, full when the camera rests."""

import math

MOVING_MS = 40.0  # time limit of a frame while the camera moves
LEAST_PIXELS = 96 * 96
MOST_PIXELS = 1280 * 960  # of a frame at rest; a larger window shows it enlarged


class Resolution:
    """Chooses the resolution of one browser's frames from the milliseconds of the previous frame."""

    def __init__(self) -> None:
        """Assume for the first frame that 96 x 96 pixels take as long as a frame may take while the camera moves."""
        self._ms_per_pixel = MOVING_MS / LEAST_PIXELS
        self._slice_ms = 0.0

    def took(self, pixels: int, slice_ms: float, raster_ms: float) -> None:
        """Store the milliseconds of the last frame; those for computing 3D Gaussians do not depend on resolution."""
        self._ms_per_pixel, self._slice_ms = raster_ms / max(1, pixels), slice_ms

    def size(self, width: int, height: int, moving: bool) -> tuple[int, int]:
        """Return the width and height in pixels at which to render a frame for a window of the given size."""
        wanted = float(min(width * height, MOST_PIXELS))
        if moving:
            affordable = (MOVING_MS - self._slice_ms) / max(self._ms_per_pixel, 1e-9)
            wanted = min(wanted, max(LEAST_PIXELS, affordable))
        scale = math.sqrt(wanted / (width * height))
        return max(1, round(scale * width)), max(1, round(scale * height))

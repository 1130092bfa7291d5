"""Let the targets use the small inputs of the rasterizer's tests."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1] / "raster"))

"""Scenes from files: `load(path)` finds the layout by what lies in the folder."""

import importlib
import math
from dataclasses import dataclass
from pathlib import Path

from gsbench.errors import InputError
from gsbench.scenes.scene import Camera, Points, Scene, View, scene_extent

__all__ = ["Camera", "Points", "Scene", "View", "load", "scene_extent"]


@dataclass(frozen=True)
class _Layout:
    """One kind of data set on disk: the file it is known by and what reads it."""

    marker: str
    expected: str  # the files of the layout and where such data is published, for the message when nothing is found
    reader: str  # module of this package with load(root, *, downscale, background); drawing a model needs none


_LAYOUTS = (
    _Layout(
        "transforms_train.json",
        "transforms_{train,val,test}.json beside the PNG images they name (D-NeRF: data.zip, linked in "
        "github.com/albertpumarola/D-NeRF; 7DGS-PBR: the Data link of gaozhongpai.github.io/7dgs)",
        "blender",
    ),
)


def load(
    path: str | Path,  # the scene's folder
    *,
    downscale: int = 1,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Scene:
    """Load the scene in the folder `path`; its layout is found by what lies there.

    Images are composited over `background` (RGB in [0, 1]) once and averaged over downscale x downscale blocks, which
    must tile them exactly. Everything is float32 on the CPU, in OpenCV axes.

    Raises:
        InputError: no known layout at `path`, or a fault in the data, named by file and field.
    """
    if isinstance(downscale, bool) or not isinstance(downscale, int) or downscale < 1:
        raise InputError(f"downscale: expected a whole number of at least 1, got {downscale!r}")
    if len(background) != 3 or not all(math.isfinite(value) and 0 <= value <= 1 for value in background):
        raise InputError(f"background: expected three numbers in [0, 1], got {background!r}")
    root = Path(path)
    for layout in _LAYOUTS:
        if (root / layout.marker).is_file():
            reader = importlib.import_module(f"gsbench.scenes.{layout.reader}")
            scene: Scene = reader.load(root, downscale=downscale, background=background)
            return scene
    found = "a folder without it" if root.is_dir() else "no such folder"
    layouts = "; or ".join(f"{layout.marker}, of a scene laid out as {layout.expected}" for layout in _LAYOUTS)
    raise InputError(f"{root}: {found}: looked for {layouts}")

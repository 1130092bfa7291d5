"""Load a scene (cameras, images, times) from a folder; `load(path)` recognises the layout of the data set."""

import importlib
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gsbench.errors import InputError, check_known, printable
from gsbench.scenes.scene import Camera, Points, Scene, View, scene_extent

RESIZES = ("pillow",)  # filters by which images can be reduced, besides the mean of blocks

__all__ = ["RESIZES", "Camera", "Points", "Scene", "View", "load", "scene_extent"]


@dataclass(frozen=True)
class _Layout:
    """Describe a layout of data sets: the file by which it is recognised, and the module that reads it."""

    marker: str
    expected: str  # the files of the layout and where such data is published, for the error message
    # module.function of this package: (root, name, rendition) -> Scene; imported late. The root is resolved.
    reader: str
    reads_too: tuple[str, ...] = ()  # files by which other layouts are recognised, and which this reader reads too
    options: tuple[str, ...] = ()  # of `load` that only some layouts have
    beside: str = "*"  # a pattern of names, one of which is there too; other data has poses_bounds.npy as well


_LAYOUTS = (
    _Layout(
        "transforms_train.json",
        "transforms_{train,val,test}.json beside the PNG images they name (D-NeRF: data.zip, linked in "
        "github.com/albertpumarola/D-NeRF; 7DGS-PBR: the Data link of gaozhongpai.github.io/7dgs)",
        "transforms.load_blender",
    ),
    _Layout(
        "cameras_parameters.txt",
        "cameras_parameters.txt beside images <Scene>_undist_<frame>_<camera>.png (Technicolor: by request to the "
        "authors of Sabater et al. 2017)",
        "technicolor.load",
        ("sparse",),
        ("frames", "repair"),
    ),
    _Layout(
        "train_meta.json",
        "train_meta.json and test_meta.json beside the images they name, in ims (Panoptic Sports: the Data link of "
        "github.com/JonathonLuiten/Dynamic3DGaussians)",
        "panoptic.load",
    ),
    _Layout(
        "dataset.json",
        "dataset.json and metadata.json beside the folders camera and rgb/2x (HyperNeRF's vrig scenes: the releases of "
        "github.com/google/hypernerf)",
        "nerfies.load",
        beside="camera",
    ),
    _Layout(
        "poses_bounds.npy",
        "poses_bounds.npy beside the films cam00.mp4, cam01.mp4, ... or folders of their frames (Neural 3D Video: the "
        "releases of github.com/facebookresearch/Neural_3D_Video)",
        "n3v.load",
        ("sparse",),
        ("frames", "leave_out"),
        "cam00*",
    ),
    _Layout(
        "sparse",
        "images (PNG or JPEG) beside a COLMAP model in sparse/0 (your own capture)",
        "colmap.load",
    ),
    _Layout("transforms.json", "nerfstudio's transforms.json beside the images it names", "transforms.load_nerfstudio"),
)


def load(
    path: str | Path,
    *,
    downscale: int = 1,
    resize: str | None = None,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    frames: Sequence[int] | None = None,
    repair: Sequence[str] | None = None,
    leave_out: Sequence[str] | None = None,
) -> Scene:
    """Load a scene from a folder in the layout of Blender, Technicolor, Panoptic, Nerfies, N3V, COLMAP or nerfstudio.

    What was decided where the files leave a choice, such as which number of the names is the time, is printed and is
    in `Scene.notes`.

    RGBA images are composited over the background, then reduced. Tensors are float32 on the CPU; cameras have OpenCV
    axes (x right, y down, z forward). The images of a large scene stay in 8 bits until they are used.

    Args:
        path: the folder of the scene.
        downscale: the integer factor by which images are reduced; sizes that it does not divide are rounded.
        resize: the filter by which they are reduced. None averages blocks of pixels; "pillow" truncates the composite
            to 8 bits and reduces it by Pillow's bicubic filter, as in the code of 3DGS.
        background: the background colour, RGB in [0, 1].
        frames: the first and the last frame, for a layout with numbered frames; None: all.
        repair: names of damaged images, each replaced by the frame before of its camera, for Technicolor.
        leave_out: names of training cameras that are not read, such as cam13, for N3V.

    Raises:
        InputError: the layout is unknown, or the data has an error; the message names the file and field.

    Example:
        `suzanne` is one of the three scenes that come with gsbench.

        >>> from gsbench import load_scene
        >>> from gsbench.scenes import sample
        >>> scene = load_scene(sample.folder() / "suzanne", downscale=2)
        >>> len(scene.train), len(scene.val), len(scene.test)
        (120, 15, 15)
        >>> view = scene.test[0]
        >>> view.image.shape, view.camera.width, scene.has_time
        (torch.Size([80, 80, 3]), 80, True)
    """
    if isinstance(downscale, bool) or not isinstance(downscale, int) or downscale < 1:
        raise InputError(f"downscale: expected a whole number of at least 1, got {downscale!r:.80}")
    if resize is not None:
        check_known("resize", f"{resize!s:.80}", RESIZES)
    are_numbers = isinstance(background, tuple | list) and all(isinstance(value, int | float) for value in background)
    if not are_numbers or len(background) != 3 or not all(0 <= value <= 1 for value in background):
        raise InputError(f"background: expected three numbers in [0, 1], got {background!r:.80}")
    root = _folder(path)
    present = [layout for layout in _LAYOUTS if os.path.lexists(root / layout.marker) and any(root.glob(layout.beside))]
    if not present:
        why = "a folder without a scene" if root.is_dir() else "no such folder"
        layouts = "; or ".join(f"{layout.marker}, of a scene laid out as {layout.expected}" for layout in _LAYOUTS)
        raise InputError(f"{root}: {why}: looked for {layouts}", docs="data.md#what-is-read")
    layout = present[0]  # the order of _LAYOUTS decides
    asked = {"frames": frames, "repair": repair, "leave_out": leave_out}
    options = {name: _option(name, value, layout) for name, value in asked.items() if value is not None}
    from gsbench.scenes.images import Rendition  # late, as the readers: it imports OpenCV

    module, function = layout.reader.split(".")
    reader = getattr(importlib.import_module(f"gsbench.scenes.{module}"), function)
    name = Path(os.path.abspath(root)).name  # if the folder is a link, the name of the link
    scene: Scene = reader(root.resolve(), name, Rendition(downscale, background, resize), **options)
    if others := ", ".join(other.marker for other in present[1:] if other.marker not in layout.reads_too):
        scene = replace(scene, notes=(f"{layout.marker} is read, and not {others}", *scene.notes))
    for note in scene.notes:
        print(f"{scene.name}: {printable(note)}", file=sys.stderr)
    return scene


_OPTIONS = {  # of an option that only some layouts have: what the others do instead, and what is expected
    "frames": ("lists its own frames and times", "the numbers of the first and the last frame, 0 <= first <= last"),
    "repair": ("has no frame before an image", "names such as Birthday_undist_00173_09"),
    "leave_out": ("has no names of cameras", "names such as cam13"),
}


def _option(name: str, value: Sequence[Any], layout: _Layout) -> tuple[Any, ...]:
    """Check and return the value of an option; raise InputError for a layout that does not have it."""
    instead, expected = _OPTIONS[name]
    if name not in layout.options:
        raise InputError(f"{name}: {layout.marker} {instead}, got {value!r:.80}: leave it out")
    kind = int if name == "frames" else str
    if not isinstance(value, tuple | list) or not all(type(entry) is kind for entry in value):
        raise InputError(f"{name}: expected {expected}, got {value!r:.80}")
    if name == "frames" and (len(value) != 2 or not 0 <= value[0] <= value[1]):
        raise InputError(f"{name}: expected {expected}, got {value!r:.80}")
    return tuple(value)


def _folder(path: object) -> Path:
    """Convert `path` to a Path; raise InputError if it is no path, cannot be printed in messages or not be accessed."""
    if not isinstance(path, str | Path) or not str(path).isprintable():
        raise InputError(f"path: expected the path of a scene's folder, got {path!r:.200}")
    try:
        Path(path).stat()
    except FileNotFoundError:
        pass  # the error of `load` says so, and lists the layouts
    except OSError as error:
        raise InputError(f"path: expected the path of a scene's folder, {str(path)!r:.200}: {error.strerror}") from None
    return Path(path)

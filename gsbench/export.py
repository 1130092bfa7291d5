"""Export a trained model: as PLY files of 3DGS, as a video, as images (``python -m gsbench.export RUN_FOLDER ...``)."""

import argparse
import sys
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import torch

from gsbench.errors import InputError, one_line
from gsbench.models.camera_time import CameraTime
from gsbench.models.registry import import_models
from gsbench.process.ending import end_with
from gsbench.process.memory import is_out_of_memory, require
from gsbench.reading import as_json
from gsbench.run.load import LoadedRun, load_run, scene_of
from gsbench.run.setup import check_device, evaluated_views
from gsbench.scenes import Camera, Scene, View
from gsbench.view import video
from gsbench.view.slice_ply import SlicePly, write_clip, write_ply
from gsbench.view.video import check_file, check_folder

PATHS = {"orbit": video.orbit, "spiral": video.spiral}
READERS = {  # for each option, the outputs that read it
    "time": ("ply", "video", "images"),
    "direction": ("ply", "plys"),
    **dict.fromkeys(("fps", "seconds"), ("plys", "video", "images")),
    **dict.fromkeys(("path", "width", "height", "supersample"), ("video", "images")),
}
OF_TEST_VIEWS = {"fps": ("plys", "video"), "seconds": ("plys",)}  # the same with --path test, which has as many frames
DEFAULTS = {"path": "orbit", "fps": 30.0, "seconds": 4.0, "supersample": 1}
MOST_FRAMES = 100_000
LEAST_FILES = 2  # of --plys: SuperSplat takes a single file for a model that stands still
MOST_STEP = 1e-4  # of the cameras' distance: a pixel is 1e-3 of it; larger roundings of means are reported
MOST_SIDE = 16_384  # pixels of a rendered image, before --supersample reduces it
VIDEO_SIDE = 720  # pixels of the shorter side of a video whose size is not named, at least
BYTES_OF_PIXEL = 32  # of a rendered image in float32 with its alpha, a copy of it, and 8 bits of it


class Export(NamedTuple):
    """The loaded run, its data set and the options of an export."""

    run: LoadedRun
    scene: Scene | None  # None if the export does not need the data set
    options: argparse.Namespace


def main(arguments: list[str] | None = None) -> int:
    """Write the PLY, the video or the images of the command line; return 0, or 2 after an error message."""
    try:
        export = prepare(parser().parse_args(joined(sys.argv[1:] if arguments is None else arguments)))
        options = export.options
        notes = []
        for name, write in WRITERS.items():
            if getattr(options, name):
                lines = write(export)
                notes += lines
                if not options.json:
                    print("\n".join(lines))
        if options.json:
            print(as_json({"written": {name: getattr(options, name) for name in WRITERS}, "notes": notes}))
    except (InputError, OSError, MemoryError, RuntimeError) as error:  # RuntimeError: torch has no memory
        if isinstance(error, RuntimeError) and not is_out_of_memory(error):
            raise
        why = "out of memory: " if is_out_of_memory(error) else ""
        print(f"gsbench.export: {why}{one_line(error)}", file=sys.stderr)
        return 2
    return 0


def joined(words: list[str]) -> list[str]:
    """Join a direction to its option, as argparse takes -1,0,0 for an option."""
    if "--direction" not in words[:-1]:
        return words
    at = words.index("--direction")
    return [*words[:at], f"--direction={words[at + 1]}", *words[at + 2 :]]


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line of the export."""
    parser = argparse.ArgumentParser(prog="python -m gsbench.export", description=__doc__)
    add = parser.add_argument
    add("run", type=Path, metavar="RUN_FOLDER", help="results/EXPERIMENT/SCENE/MODEL/seedK")
    add("--ply", type=Path, metavar="OUT.ply", help="write the 3D Gaussians of one slice")
    add("--plys", type=Path, metavar="FOLDER", help="write a slice for each frame, at times from 0 to 1")
    add("--video", type=Path, metavar="OUT.mp4", help=f"write a video along --path, {VIDEO_SIDE} pixels high or more")
    add("--images", type=Path, metavar="FOLDER", help="write the frames of that video as PNG")
    add("--time", type=float, help="of the slice, in [0, 1]; in a video time then stands still")
    place = parser.add_mutually_exclusive_group()
    place.add_argument("--camera", metavar="I", help="a training view's number, or a view's name; it stands still")
    place.add_argument("--direction", metavar="X,Y,Z", help="of sight, for --ply and --plys: from afar")
    add("--path", choices=[*PATHS, "test"], help="of the camera (orbit); test: the views it was measured on")
    add("--fps", type=float, help="frames a second (30)")
    add("--seconds", type=float, help="length of an orbit, a spiral or --plys (4)")
    add("--width", type=int, metavar="PIXELS", help="of the frames (of images: the training's)")
    add("--height", type=int, metavar="PIXELS", help="of the frames (in proportion to --width)")
    add("--supersample", type=int, metavar="N", help="render N times as large, and average (1)")
    add("--data-root", metavar="FOLDER", help="of the data set, where it has moved")
    add("--model-module", metavar="MODULE", help="that registers the run's model")
    add("--device", default="cpu", help="cpu or cuda")
    add("--json", action="store_true", help="print what was written as JSON")
    return parser


def prepare(options: argparse.Namespace) -> Export:
    """Check the options of the export and load the run and its data set; raise InputError if this fails."""
    if not any(getattr(options, name) for name in WRITERS):
        raise InputError("expected --ply OUT.ply, --plys FOLDER, --video OUT.mp4 or --images FOLDER, got none of them")
    check_read(options)
    if options.time is not None and not 0 <= options.time <= 1:
        raise InputError(f"--time: expected a number in [0, 1], got {options.time}")
    if not 0 < options.fps <= 1000 or not 1 <= options.fps * options.seconds <= MOST_FRAMES:
        raise InputError(
            f"--fps, --seconds: expected 1 to {MOST_FRAMES} frames of at most 1000 a second, got "
            f"{options.fps} x {options.seconds}"
        )
    sides = [options.supersample * side for side in (1, options.width, options.height) if side is not None]
    if not all(0 < side <= MOST_SIDE for side in sides):
        raise InputError(
            f"--width, --height, --supersample: expected at least 1 and at most {MOST_SIDE} rendered "
            f"pixels a side, got {options.width}, {options.height}, {options.supersample}"
        )
    if options.video and any(side is not None and side % 2 for side in (options.width, options.height)):
        raise InputError(
            f"--width, --height: expected even numbers for --video, as VP9 encodes no others, got "
            f"{options.width}, {options.height}"
        )
    if options.ply:
        check_file("--ply", options.ply, ".ply")
    if options.video:
        check_file("--video", options.video, *video.SUFFIXES)
    if options.images:
        check_folder("--images", options.images)
    if options.plys:
        check_clip(options)
    check_device(options.device)
    import_models(options.model_module)
    run = load_run(options.run, options.device)
    if not run.scene.has_time and (options.plys or options.time is not None):
        option, instead = ("--plys", "use --ply") if options.plys else ("--time", "leave it out")
        raise InputError(f"{option}: expected a scene with times, {run.scene.name} has none: {instead}")
    if options.plys and "time" not in run.model.observes and not run.model.refines:
        name = run.config.model.name
        raise InputError(f"--plys: expected a model that changes with time, {name} does not: use --ply")
    return Export(run, scene_of(run, options.data_root) if needs_data(options) else None, options)


def needs_data(options: argparse.Namespace) -> bool:
    """Return whether the export needs cameras of the data set."""
    return options.camera is not None or (options.path == "test" and bool(options.video or options.images))


def check_read(options: argparse.Namespace) -> None:
    """Raise InputError if an option would do nothing for what is written; give others their defaults."""
    if options.path is not None and options.camera is not None:
        raise InputError("--path: expected no --camera beside it, which stands still: leave one of them out")
    for name, readers in (READERS | (OF_TEST_VIEWS if options.path == "test" else {})).items():
        if getattr(options, name) is not None and not any(getattr(options, reader) for reader in readers):
            beside = " beside --path test" if readers != READERS[name] else ""
            raise InputError(f"--{name}: expected --{' or --'.join(readers)}{beside}, which reads it: leave it out")
    if options.data_root is not None and not needs_data(options):
        raise InputError("--data-root: expected --camera or --path test, which need data: leave it out")
    for name, value in DEFAULTS.items():
        if getattr(options, name) is None:
            setattr(options, name, value)


def check_clip(options: argparse.Namespace) -> None:
    """Raise InputError if the options of --plys do not fit together, or if its folder has files."""
    folder = options.plys
    if options.time is not None:
        raise InputError("--plys: expected no --time, as there is a file for each time: leave it out, or use --ply")
    if frame_count(options) < LEAST_FILES:
        raise InputError(
            f"--plys: expected at least {LEAST_FILES} files, --fps {options.fps:g} and --seconds "
            f"{options.seconds:g} give {frame_count(options)}: raise them, or use --ply"
        )
    check_folder("--plys", folder)
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError(
            f"--plys: expected a new or an empty folder, {folder} has files, which a viewer would take "
            f"for frames: name another"
        )


def frame_count(options: argparse.Namespace) -> int:
    """Return the number of frames of a clip."""
    return round(options.fps * options.seconds)


def export_ply(export: Export) -> list[str]:
    """Write a PLY file for one camera and time; return its number of Gaussians, time and colours in words."""
    run, path = export.run, export.options.ply
    query, keep = slice_place(export, export.options.time)
    ply = write_ply(run, query, path, keep_harmonics=keep)
    when = "" if query.time is None else f" at time {float(query.time):g}"
    total = len(run.model)
    text = (
        f"{path}: {ply.gaussians} Gaussians{when}, colours {colours(export, keep)}; {total - ply.gaussians} of "
        f"{total} are left out, as their opacity there is below 1/255"
    )
    return [text, *differences(export, path, ply)]


def export_clip(export: Export) -> list[str]:
    """Write a PLY file for each time of a clip, as one camera sees it; return names, numbers and colours in words."""
    folder = export.options.plys
    places = [slice_place(export, time) for time in video.times(frame_count(export.options))]
    keep = places[0][1]  # whether the files keep SH colours, the same at all times
    plys = write_clip(export.run, [query for query, _ in places], folder, keep_harmonics=keep)
    counts = [ply.gaussians for ply in plys]
    text = (
        f"{folder}: {plys[0].path.name} to {plys[-1].path.name} at times 0 to 1, {min(counts)} to {max(counts)} "
        f"Gaussians each, colours {colours(export, keep)}"
    )
    return [text, *differences(export, folder, plys[0])]


def export_video(export: Export) -> list[str]:
    """Write a video; return the number, size and rate of its frames in words."""
    path, fps, shots = export.options.video, export.options.fps, shots_of(export, VIDEO_SIDE)
    with closing(video.frames(export.run, shots, export.options.supersample)) as images:  # closes the progress bar too
        video.write_video(images, path, fps)
    return [f"{path}: {frames_in_words(shots)}, {fps:g} a second"]


def export_images(export: Export) -> list[str]:
    """Write the frames of a video as images; return their number and size in words."""
    folder, shots = export.options.images, shots_of(export)
    with closing(video.frames(export.run, shots, export.options.supersample)) as images:
        video.write_images(images, folder)
    return [f"{folder}: {frames_in_words(shots)}"]


def frames_in_words(shots: list[video.Shot]) -> str:
    """Return the number of frames and the size of the first."""
    camera = shots[0][0]
    return f"{len(shots)} frames of {camera.width} x {camera.height} pixels"


# Options that name what is written, and the functions that write it and return what to print.
WRITERS = {"ply": export_ply, "plys": export_clip, "video": export_video, "images": export_images}


def colours(export: Export, keep_harmonics: bool) -> str:
    """Return in words which colours an exported slice has."""
    if keep_harmonics:
        return f"harmonics of degree {export.run.model.active.sh_degree}"
    camera, sight = export.options.camera, export.options.direction
    return "as seen from " + (f"direction {sight}" if camera is None else f"camera {camera}")


def differences(export: Export, path: Path, ply: SlicePly) -> list[str]:
    """Return in words how a PLY's Gaussians differ from the model's, as the format of 3DGS has no field for it."""
    notes, step = [], export.run.scene.placement.float_step
    if step > MOST_STEP:
        notes += [
            f"{path}: so far from the origin, single precision moves means by up to {step:.1%} of the cameras' "
            f"distance: subtract an offset from your poses if the picture is not sharp"
        ]
    if ply.from_profiles:
        notes += [
            f"{path}: their alpha profiles (1 - r^2)^b are now the Gaussians that look like them, as a PLY of "
            f"3DGS has no field for b; --images and --video keep the profiles"
        ]
    if export.run.config.raster.antialias:
        notes += [
            f"{path}: trained with raster.antialias=true, which a PLY of 3DGS has no field for: switch on "
            f"antialiasing (Mip-Splatting) in the viewer, or small Gaussians are too opaque"
        ]
    return notes


def slice_place(export: Export, time: float | None) -> tuple[CameraTime, bool]:
    """Return the camera centre and time of exported 3D Gaussians, and whether the PLY keeps SH colours.

    If the user names a camera or a direction, each Gaussian has only the colour that is seen from there. If `time` is
    None, it is that of the named view, or 0.
    """
    run, options = export.run, export.options
    if export.scene is not None and options.camera is not None:
        view = find_view(export.scene, options.camera)
        return CameraTime.of(view.camera.to(run.config.device), view.time if time is None else time), False
    if time is None and run.scene.has_time:
        time = 0.0
    keep = options.direction is None
    center = torch.zeros(3) if keep else video.far_along(run, direction(options.direction))
    return CameraTime.at(center.to(run.config.device), time), keep


def direction(text: str) -> torch.Tensor:
    """Parse a direction "X,Y,Z" to a unit vector [3]; raise InputError if the text is not a direction."""
    try:
        vector = torch.tensor([float(word) for word in text.split(",")], dtype=torch.float64)
    except ValueError:
        vector = torch.zeros(0)
    if vector.shape != (3,) or not 0 < vector.norm() < torch.inf:
        raise InputError(f"--direction: expected three numbers X,Y,Z that are not all zero, got '{text[:100]}'")
    return (vector / vector.norm()).float()


def shots_of(export: Export, least_side: int | None = None) -> list[video.Shot]:
    """Return the camera and the time of each frame of a video, in the size of --width and --height.

    If neither is given, frames have the size of the training's images; with `least_side` they are even and have at
    least so many pixels on the shorter side.

    Raises:
        TooLargeError: a frame needs more memory than there is.
    """
    options = export.options
    shots = [(sized(camera, options.width, options.height, least_side), time) for camera, time in path_of(export)]
    pixels = options.supersample**2 * max(camera.width * camera.height for camera, _ in shots)
    require(
        BYTES_OF_PIXEL * pixels, f"frames of {pixels:,} rendered pixels", "lower --width, --height or --supersample"
    )
    return shots


def sized(camera: Camera, width: int | None, height: int | None, least_side: int | None) -> Camera:
    """Return a camera of the given size in pixels; a side that is None follows in proportion, and is even.

    If both are None, the shorter side has at least `least_side` pixels, or else the camera stays as it is.
    """
    if width is None and height is None and least_side is None:
        return camera
    if width is not None:
        scale = width / camera.width
    elif height is not None:
        scale = height / camera.height
    else:
        assert least_side is not None
        scale = max(1.0, least_side / min(camera.width, camera.height))
    even = [2 * max(1, round(scale * side / 2)) for side in (camera.width, camera.height)]
    return video.resized(camera, width or even[0], height or even[1])


def path_of(export: Export) -> list[video.Shot]:
    """Return the camera and the time of each frame of a video; time runs from 0 to 1, or has the value of --time."""
    options = export.options
    count = frame_count(options)
    if export.scene is not None and options.camera is not None:
        cameras = [find_view(export.scene, options.camera).camera] * count
    elif export.scene is not None:
        views = evaluated_views(export.scene, export.run.config.scene.eval_split)
        return [(view.camera, view.time if options.time is None else options.time) for view in views]
    else:
        cameras = PATHS[options.path](export.run, count)
    if not export.run.scene.has_time:
        return [(camera, None) for camera in cameras]
    times = video.times(count) if options.time is None else [options.time] * count
    return list(zip(cameras, times, strict=True))


def find_view(scene: Scene, name: str) -> View:
    """Return the view whose name is `name`, such as test/r_003; if `name` is a number, the training view number `name`.

    Raises:
        InputError: no view has this name or number.
    """
    if name.isascii() and name.isdigit() and len(name) < 10 and int(name) < len(scene.train):
        return scene.train[int(name)]
    for view in (*scene.train, *scene.val, *scene.test):
        if view.name == name:
            return view
    raise InputError(
        f"--camera: expected a training view's number, 0 to {len(scene.train) - 1}, or a view's name such "
        f"as {scene.train[0].name}, got {name[:100]!a}"
    )


if __name__ == "__main__":
    end_with("gsbench.export", main)

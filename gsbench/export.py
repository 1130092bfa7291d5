"""Export a trained model: as PLY files of 3DGS, as a video, as images (``python -m gsbench.export RUN_FOLDER ...``)."""

import argparse
import sys
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import torch

from gsbench.as_json import as_json
from gsbench.errors import InputError, one_line
from gsbench.measure.atomic import write_atomically
from gsbench.models.query import Query
from gsbench.models.registry import import_models
from gsbench.process.ending import end_with
from gsbench.process.memory import is_out_of_memory, require
from gsbench.run.checks import check_device, evaluated_views
from gsbench.run.load import LoadedRun, load_run, scene_of
from gsbench.scenes import Camera, Scene, View
from gsbench.scenes.placement import gaussians_to_user
from gsbench.scenes.trained import ply_of
from gsbench.view import film, paths, sequence
from gsbench.view.gaussians import trained_of

PATHS = {"orbit": paths.orbit, "spiral": paths.spiral}
MOST_FRAMES = 100_000
MOST_STEP = 1e-4  # of the cameras' distance: a pixel is 1e-3 of it; larger roundings of means are told
MOST_SIDE = 16_384  # pixels of a rendered image, before --supersample reduces it
VIDEO_SIDE = 720  # pixels of the shorter side of a video whose size is not named, at least
BYTES_OF_PIXEL = 32  # of a rendered image in float32 with its alpha, a copy of it, and 8 bits of it


class ExportRequest(NamedTuple):
    """Hold the loaded run, its data set and the options of an export."""

    run: LoadedRun
    scene: Scene | None  # None if the export does not need the data set
    options: argparse.Namespace


def main(arguments: list[str] | None = None) -> int:
    """Write the PLY, the video or the images of the command line; return 0, or 2 after an error message."""
    try:
        asked = prepare(parser().parse_args(arguments))
        said = write_ply(asked, asked.options.ply) if asked.options.ply else []
        if asked.options.plys:
            said += write_sequence(asked, asked.options.plys)
        if said and not asked.options.json:
            print("\n".join(said))
        if asked.options.video:
            with closing(
                film.frames(asked.run, shots(asked, VIDEO_SIDE), asked.options.supersample)
            ) as images:  # closes the progress bar too
                film.write_video(images, asked.options.video, asked.options.fps)
        if asked.options.images:
            with closing(film.frames(asked.run, shots(asked), asked.options.supersample)) as images:
                film.write_images(images, asked.options.images)
        if asked.options.json:
            written = {name: getattr(asked.options, name) for name in ("ply", "plys", "video", "images")}
            print(as_json({"written": written, "notes": said}))
    except (InputError, OSError, MemoryError, RuntimeError) as error:  # RuntimeError: torch has no memory
        if isinstance(error, RuntimeError) and not is_out_of_memory(error):
            raise
        why = "out of memory: " if is_out_of_memory(error) else ""
        print(f"gsbench.export: {why}{one_line(error)}", file=sys.stderr)
        return 2
    return 0


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line of the export."""
    made = argparse.ArgumentParser(prog="python -m gsbench.export", description=__doc__)
    made.add_argument("run", type=Path, metavar="RUN_FOLDER", help="results/EXPERIMENT/SCENE/MODEL/seedK")
    made.add_argument("--ply", type=Path, metavar="OUT.ply", help="write the 3D Gaussians of one slice")
    made.add_argument("--plys", type=Path, metavar="FOLDER", help="write a slice for each frame of a clip over time")
    made.add_argument(
        "--video", type=Path, metavar="OUT.mp4", help=f"write a video along --path, {VIDEO_SIDE} pixels high or more"
    )
    made.add_argument("--images", type=Path, metavar="FOLDER", help="write the frames of that video as PNG")
    made.add_argument("--time", type=float, help="of the slice, in [0, 1]; in a video time then stands still")
    seen = made.add_mutually_exclusive_group()
    seen.add_argument("--camera", metavar="I", help="a training view's number, or a view's name; it stands still")
    seen.add_argument("--direction", metavar="X,Y,Z", help="of sight, for --ply and --plys: from afar")
    made.add_argument(
        "--path", choices=[*PATHS, "test"], default="orbit", help="of the camera; test: the views it was measured on"
    )
    made.add_argument("--fps", type=float, default=30, help="frames a second (30)")
    made.add_argument("--seconds", type=float, default=4, help="length of an orbit, a spiral or --plys (4)")
    made.add_argument("--width", type=int, metavar="PIXELS", help="of the frames (of images: the training's)")
    made.add_argument("--height", type=int, metavar="PIXELS", help="of the frames (in proportion to --width)")
    made.add_argument(
        "--supersample", type=int, default=1, metavar="N", help="render N times as large, and average (1)"
    )
    made.add_argument("--data-root", metavar="FOLDER", help="of the data set, where it has moved")
    made.add_argument(
        "--model-module",
        metavar="MODULE",
        help="that registers the run's model",
    )
    made.add_argument("--device", default="cpu", help="cpu or cuda")
    made.add_argument("--json", action="store_true", help="print what was written as JSON")
    return made


def prepare(options: argparse.Namespace) -> ExportRequest:
    """Check the options of the export and load the run and its data set; raise InputError if this fails."""
    if not (options.ply or options.plys or options.video or options.images):
        raise InputError("expected --ply OUT.ply, --plys FOLDER, --video OUT.mp4 or --images FOLDER, got none of them")
    if options.time is not None and not 0 <= options.time <= 1:
        raise InputError(f"--time: expected a number in [0, 1], got {options.time}")
    if not 0 < options.fps <= 1000 or not 1 <= options.fps * options.seconds <= MOST_FRAMES:
        raise InputError(f"--fps, --seconds: expected 1 to {MOST_FRAMES} frames of at most 1000 a second, got "
                         f"{options.fps} x {options.seconds}")  # fmt: skip
    sides = [options.supersample * side for side in (1, options.width, options.height) if side is not None]
    if not all(0 < side <= MOST_SIDE for side in (options.supersample, *sides)):
        raise InputError(f"--width, --height, --supersample: expected at least 1 and at most {MOST_SIDE} rendered "
                         f"pixels a side, got {options.width}, {options.height}, {options.supersample}")  # fmt: skip
    if options.video and any(side is not None and side % 2 for side in (options.width, options.height)):
        raise InputError(f"--width, --height: expected even numbers for --video, as VP9 encodes no others, got "
                         f"{options.width}, {options.height}")  # fmt: skip
    if options.ply:
        film.check_file("--ply", options.ply, ".ply")
    if options.video:
        film.check_file("--video", options.video, *film.SUFFIXES)
    if options.images:
        film.check_parent(options.images)
    if options.plys:
        check_sequence(options)
    check_device(options.device)
    import_models(options.model_module)
    run = load_run(options.run, options.device)
    if options.time is not None and not run.scene.has_time:
        raise InputError(f"--time: expected a scene with times, {run.scene.name} has none: leave it out")
    if options.plys:
        sequence.check_time(run)
    filming = options.video or options.images
    needed = options.camera is not None or (filming and options.path == "test")
    return ExportRequest(run, scene_of(run, options.data_root) if needed else None, options)


def check_sequence(options: argparse.Namespace) -> None:
    """Raise InputError if the options of --plys do not fit together, or if its folder has files."""
    if options.time is not None:
        raise InputError("--plys: expected no --time, as there is a file for each time: leave it out, or use --ply")
    if frame_count(options) < sequence.LEAST_FILES:
        raise InputError(f"--plys: expected at least {sequence.LEAST_FILES} files, --fps {options.fps:g} and --seconds "
                         f"{options.seconds:g} give {frame_count(options)}: raise them, or use --ply")  # fmt: skip
    sequence.check_folder(options.plys)


def frame_count(options: argparse.Namespace) -> int:
    """Return the number of frames of a clip."""
    return round(options.fps * options.seconds)


def write_ply(asked: ExportRequest, path: Path) -> list[str]:
    """Write a model's 3D Gaussians for one camera and time as a PLY file; return their number, time and colours."""
    run, options = asked.run, asked.options
    query, keep = slice_place(asked, options.time)
    trained = gaussians_to_user(trained_of(run.model, query, keep_harmonics=keep), run.scene.placement)
    write_atomically(path, ply_of(trained))
    culled = len(run.model) - len(trained)
    when = "" if query.time is None else f" at time {float(query.time):g}"
    said = [f"{path}: {len(trained)} Gaussians{when}, colours {colours(asked, keep)}; {culled} of {len(run.model)} are "
            f"left out, as their opacity there is below 1/255"]  # fmt: skip
    return said + differences(asked, path, trained.from_profiles)


def write_sequence(asked: ExportRequest, folder: Path) -> list[str]:
    """Write a PLY file for each time of a clip, as one camera sees it; return their names, numbers and colours."""
    places = [slice_place(asked, time) for time in paths.times(frame_count(asked.options))]
    keep = places[0][1]
    written = sequence.write_plys(asked.run, [query for query, _ in places], folder, keep_harmonics=keep)
    said = [f"{folder}: {written.paths[0].name} to {written.paths[-1].name} at times 0 to 1, {min(written.counts)} to "
            f"{max(written.counts)} Gaussians each, colours {colours(asked, keep)}"]  # fmt: skip
    return said + differences(asked, folder, written.from_profiles)


def colours(asked: ExportRequest, keep: bool) -> str:
    """Say which colours an exported slice has; `keep`: spherical harmonics."""
    if keep:
        return f"harmonics of degree {asked.run.model.active.sh_degree}"
    camera, sight = asked.options.camera, asked.options.direction
    return "as seen from " + (f"direction {sight}" if camera is None else f"camera {camera}")


def differences(asked: ExportRequest, path: Path, from_profiles: bool) -> list[str]:
    """Say in what the Gaussians of a PLY differ from the model's, as the format of 3DGS has no field for it."""
    said = []
    step = asked.run.scene.placement.float_step
    if step > MOST_STEP:
        said += [f"{path}: so far from the origin, single precision moves means by up to {step:.1%} of the cameras' "
                 f"distance: subtract an offset from your poses if the picture is not sharp"]  # fmt: skip
    if from_profiles:
        said += [f"{path}: their alpha profiles (1 - r^2)^b are now the Gaussians that look like them, as a PLY of "
                 f"3DGS has no field for b; --images and --video keep the profiles"]  # fmt: skip
    if asked.run.config.raster.antialias:
        said += [f"{path}: trained with raster.antialias=true, which a PLY of 3DGS cannot say: switch on antialiasing "
                 f"(Mip-Splatting) in the viewer, or small Gaussians are too opaque"]  # fmt: skip
    return said


def slice_place(asked: ExportRequest, time: float | None) -> tuple[Query, bool]:
    """Return the camera centre and time of exported 3D Gaussians, and whether the PLY keeps SH colours.

    If the user names a camera or a direction, each Gaussian has only the colour that is seen from there. If `time` is
    None, it is that of the named view, or 0.
    """
    run, options = asked.run, asked.options
    if asked.scene is not None and options.camera is not None:
        view = find_view(asked.scene, options.camera)
        return Query.of(view.camera.to(run.config.device), view.time if time is None else time), False
    if time is None and run.scene.has_time:
        time = 0.0
    keep = options.direction is None
    center = torch.zeros(3) if keep else paths.far_along(run, direction(options.direction))
    return Query.at(center.to(run.config.device), time), keep


def direction(text: str) -> torch.Tensor:
    """Parse a direction "X,Y,Z" to a unit vector [3]; raise InputError if the text is not a direction."""
    try:
        found = torch.tensor([float(word) for word in text.split(",")], dtype=torch.float64)
    except ValueError:
        found = torch.zeros(0)
    if found.shape != (3,) or not 0 < found.norm() < torch.inf:
        raise InputError(f"--direction: expected three numbers X,Y,Z that are not all zero, got '{text[:100]}'")
    return (found / found.norm()).float()


def shots(asked: ExportRequest, least: int | None = None) -> list[paths.Shot]:
    """Return the camera and the time of each frame of a video, in the size of --width and --height.

    If neither is named, frames have the size of the training's images; with `least` they are even and have at least so
    many pixels on the shorter side.

    Raises:
        TooLargeError: a frame needs more memory than there is.
    """
    width, height = asked.options.width, asked.options.height
    if width is height is None and least is not None:
        sized = [(enlarged(camera, least), time) for camera, time in path_of(asked)]
    else:
        sized = [(of_size(camera, width, height), time) for camera, time in path_of(asked)]
    pixels = asked.options.supersample**2 * max(camera.width * camera.height for camera, _ in sized)
    require(BYTES_OF_PIXEL * pixels, f"frames of {pixels:,} rendered pixels",
            "lower --width, --height or --supersample")  # fmt: skip
    return sized


def enlarged(camera: Camera, least: int) -> Camera:
    """Return a camera with even sides, the shorter one of at least `least` pixels."""
    scale = max(1.0, least / min(camera.width, camera.height))
    return paths.resized(camera, *(2 * max(1, round(scale * side / 2)) for side in (camera.width, camera.height)))


def of_size(camera: Camera, width: int | None, height: int | None) -> Camera:
    """Return a camera with an image of the given size; a side that is None follows from the other one, and is even."""
    if width is not None:
        return paths.resized(camera, width, height or 2 * max(1, round(camera.height * width / camera.width / 2)))
    if height is not None:
        return paths.resized(camera, 2 * max(1, round(camera.width * height / camera.height / 2)), height)
    return camera


def path_of(asked: ExportRequest) -> list[paths.Shot]:
    """Return the camera and the time of each frame of a video; time runs from 0 to 1, or has the value of --time."""
    options = asked.options
    count = frame_count(options)
    if asked.scene is not None and options.camera is not None:
        cameras = [find_view(asked.scene, options.camera).camera] * count
    elif asked.scene is not None:
        views = evaluated_views(asked.scene, asked.run.config.scene.eval_split)
        return [(view.camera, view.time if options.time is None else options.time) for view in views]
    else:
        cameras = PATHS[options.path](asked.run, count)
    if not asked.run.scene.has_time:
        return [(camera, None) for camera in cameras]
    times = paths.times(count) if options.time is None else [options.time] * count
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
    raise InputError(f"--camera: expected a training view's number, 0 to {len(scene.train) - 1}, or a view's name such "
                     f"as {scene.train[0].name}, got {name[:100]!a}")  # fmt: skip


if __name__ == "__main__":
    end_with("gsbench.export", main)

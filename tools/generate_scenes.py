"""Render the embedded scenes with Blender: ``make scenes``, or ``python tools/generate_scenes.py SCENE FOLDER``.

The result is a folder in the D-NeRF layout, which `gsbench.scenes.load` reads, and a file scene.json that says how it
was made and what is true of it. Needs `bpy`. Imports nothing of gsbench, as Blender needs an older numpy.
"""

import argparse
import contextlib
import itertools
import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Pose = NDArray[np.float64]  # [4, 4] camera to world, OpenGL axes
ANGLE_X = 0.6911  # horizontal field of view in radians, as in NeRF-synthetic
DISTANCE = 4.6
SPLITS = ("train", "val", "test")
CEILING_VIEWS = 3  # views rendered with a second seed, to measure the noise


@dataclass(frozen=True)
class Shot:
    """A view to render."""

    split: str
    pose: Pose
    time: float  # in [0, 1]


@dataclass(frozen=True)
class Recipe:
    """How a scene is made."""

    shots: Callable[[], list[Shot]]
    build: Callable[[Any], Callable[[float], None]]  # gets bpy, builds the objects, returns what moves them to a time
    samples: int  # rays a pixel
    effects: dict[str, bool]  # the truth about the scene, for tests of the effect detection; gsbench does not read it


def look_at(azimuth: float, elevation: float, distance: float = DISTANCE) -> Pose:
    """Return the pose of a camera on a sphere around the origin that looks at the origin; angles are in radians."""
    back = np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, distance * back], 1)
    return pose


def orbit(train: int = 120, held_out: int = 15) -> list[Shot]:
    """Return views of one moving camera that sees each time once.

    The views fill the half sphere and the time evenly (a Kronecker sequence with the generalised golden ratio of three
    dimensions). In order of time, every tenth view is a test view, and the one five later is a validation view, so that
    both lie between training views in time and in angle.
    """
    total = train + 2 * held_out
    ratio = 1.2207440846  # the root of x^4 = x + 1
    places = np.arange(total)[:, None] / ratio ** np.arange(1, 4) % 1  # [N, 3]
    places = places[np.argsort(places[:, 2])]
    every = total // held_out
    kinds = {every // 4: "val", 3 * every // 4: "test"}
    return [
        Shot(
            kinds.get(i % every, "train"),
            look_at(2 * math.pi * across, math.asin(0.08 + 0.72 * up)),
            i / (total - 1),
        )
        for i, (across, up, _) in enumerate(places)
    ]


def rig(cameras: int = 12, times: int = 11) -> list[Shot]:
    """Return the views of fixed cameras that see every time; test views are of two more cameras between them.

    Test and validation views are halfway between two times of the training views; validation views are of the training
    cameras.
    """
    height = (math.radians(15), math.radians(40))
    places = [look_at(2 * math.pi * i / cameras, height[i % 2]) for i in range(cameras)]
    between = [look_at(2 * math.pi * (i + 0.5) / cameras, math.radians(28)) for i in (2, 8)]
    moments = [i / (times - 1) for i in range(times)]
    halfway = [(a + b) / 2 for a, b in itertools.pairwise(moments)]
    shots = [Shot("train", pose, moment) for moment in moments for pose in places]
    shots += [Shot("val", places[5 * i % cameras], moment) for i, moment in enumerate(halfway)]
    return shots + [Shot("test", pose, moment) for moment in halfway for pose in between]


def glass(bpy: Any) -> Callable[[float], None]:
    """Build a head of coloured glass that nods and stretches like jelly over a checkered disc."""
    _disc(bpy, (0.85, 0.8, 0.7), (0.15, 0.25, 0.45))
    bpy.ops.mesh.primitive_monkey_add(size=1.9)
    head = _object(bpy, _material(bpy, (0.55, 0.85, 0.6), roughness=0.08, transmission=0.85))
    head.modifiers.new("round", "SUBSURF").render_levels = 2
    twist = head.modifiers.new("twist", "SIMPLE_DEFORM")
    twist.deform_method, twist.deform_axis = "TWIST", "Z"

    def move(moment: float) -> None:
        wave = math.sin(2 * math.pi * moment)
        twist.angle = 0.7 * wave
        head.scale = (1 - 0.12 * wave, 1 - 0.12 * wave, 1 + 0.22 * wave)
        head.rotation_euler = (0.25 * math.sin(4 * math.pi * moment), 0, 0.5 * wave)
        head.location = (0, 0, 0.1 + 0.12 * wave)

    return move


def matte(bpy: Any) -> Callable[[float], None]:
    """Build matte solids that orbit, tumble and hop over a checkered disc; nothing depends on the view."""
    _disc(bpy, (0.8, 0.8, 0.8), (0.35, 0.3, 0.3))
    colours = ((0.9, 0.25, 0.15), (0.2, 0.5, 0.9), (0.95, 0.75, 0.15), (0.3, 0.75, 0.35))
    adds = ("cube_add", "uv_sphere_add", "torus_add", "cone_add")
    solids = []
    for add, colour in zip(adds, colours, strict=True):
        getattr(bpy.ops.mesh, f"primitive_{add}")()
        solids.append(_object(bpy, _material(bpy, colour, checks=add == "cube_add")))

    def move(moment: float) -> None:
        for i, solid in enumerate(solids):
            turn = 2 * math.pi * (0.25 * moment + i / len(solids))
            hop = abs(math.sin(2 * math.pi * (0.75 * moment + 0.3 * i)))
            solid.scale = (0.34, 0.34, 0.34 * (0.8 + 0.3 * hop))
            solid.location = (0.85 * math.cos(turn), 0.85 * math.sin(turn), -0.3 + 0.6 * hop)
            solid.rotation_euler = (1.2 * math.sin(turn), 0, 2 * turn)

    return move


def pendulum(bpy: Any) -> Callable[[float], None]:
    """Build a swinging rod with a glossy ball, which sweeps over coloured blocks on a checkered disc."""
    _disc(bpy, (0.75, 0.8, 0.85), (0.3, 0.35, 0.4))
    for i in range(6):
        turn = 2 * math.pi * i / 6
        bpy.ops.mesh.primitive_cube_add()
        block = _object(bpy, _material(bpy, (0.2 + 0.13 * i, 0.7 - 0.1 * i, 0.3 + 0.1 * (i % 3))))
        block.scale = (0.16, 0.16, 0.1 + 0.06 * i)
        block.location = (1.0 * math.cos(turn), 1.0 * math.sin(turn), -0.75 + 0.06 * i)
    bpy.ops.object.empty_add(location=(0, 0, 1.25))
    hinge = bpy.context.object
    bpy.ops.mesh.primitive_cylinder_add(radius=0.05, depth=1.3)
    rod = _object(bpy, _material(bpy, (0.9, 0.9, 0.9)))
    bpy.ops.mesh.primitive_uv_sphere_add(radius=0.32)
    ball = _object(bpy, _material(bpy, (0.9, 0.45, 0.2), roughness=0.12, metallic=1.0))
    for part, depth in ((rod, -0.65), (ball, -1.4)):
        part.parent, part.location = hinge, (0, 0, depth)

    def move(moment: float) -> None:
        swing = 2 * math.pi * moment
        hinge.rotation_euler = (0.6 * math.cos(swing), 0.45 * math.sin(swing), 0)

    return move


def _disc(bpy: Any, *colours: tuple[float, float, float]) -> None:
    """Add the ground, a checkered disc."""
    bpy.ops.mesh.primitive_cylinder_add(vertices=96, radius=1.5, depth=0.08, location=(0, 0, -0.9))
    _object(bpy, _material(bpy, colours[0], checks=True, other=colours[1]), smooth=False)


def _object(bpy: Any, material: Any, *, smooth: bool = True) -> Any:
    """Return the object that was added last, with a material."""
    added = bpy.context.object
    added.data.materials.append(material)
    if smooth and len(added.data.polygons) > 6:
        bpy.ops.object.shade_smooth()
    return added


def _material(
    bpy: Any,
    colour: tuple[float, float, float],
    *,
    roughness: float = 1.0,
    metallic: float = 0.0,
    transmission: float = 0.0,
    checks: bool = False,
    other: tuple[float, float, float] = (0.95, 0.95, 0.9),
) -> Any:
    """Return a material; with roughness 1 it has no highlight and looks the same from everywhere."""
    material = bpy.data.materials.new("material")
    material.use_nodes = True
    surface = material.node_tree.nodes["Principled BSDF"]
    values = {
        "Base Color": (*colour, 1.0),
        "Roughness": roughness,
        "Metallic": metallic,
        "IOR": 1.35,
        "Transmission Weight": transmission,
        "Specular IOR Level": 0.0 if roughness == 1 else 0.5,
    }
    for name, value in values.items():
        surface.inputs[name].default_value = value
    if checks:
        pattern = material.node_tree.nodes.new("ShaderNodeTexChecker")
        pattern.inputs["Color1"].default_value, pattern.inputs["Color2"].default_value = (*colour, 1.0), (*other, 1.0)
        pattern.inputs["Scale"].default_value = 6.0
        material.node_tree.links.new(pattern.outputs["Color"], surface.inputs["Base Color"])
    return material


RECIPES = {
    "suzanne": Recipe(orbit, glass, 96, {"motion": True, "view_dependent": True}),
    "moving-matte": Recipe(orbit, matte, 32, {"motion": True, "view_dependent": False}),
    "pendulum": Recipe(rig, pendulum, 48, {"motion": True, "view_dependent": True}),
}


def generate(name: str, folder: Path, *, size: int = 160, samples: int | None = None, limit: int | None = None) -> None:
    """Render a scene into a new folder.

    Args:
        name: one of RECIPES.
        folder: the folder of the scene, which must not exist.
        size: width and height of the images in pixels.
        samples: rays a pixel; None for the scene's own number.
        limit: the most views of a split; None for all.

    Raises:
        FileExistsError: the folder exists.
        ImportError: Blender is not installed.
    """
    import bpy
    import mathutils  # comes with bpy

    if folder.exists():
        raise FileExistsError(f"{folder}: expected no such folder, the scene is written there")
    recipe = RECIPES[name]
    samples = recipe.samples if samples is None else samples
    scene, camera = _studio(bpy, size, samples)
    move = recipe.build(bpy)

    def render(shot: Shot, path: Path, seed: int = 0) -> None:
        camera.matrix_world = mathutils.Matrix(shot.pose.tolist())
        move(shot.time)
        scene.cycles.seed = seed
        scene.render.filepath = str(path)
        with _silent():
            bpy.ops.render.render(write_still=True)
        _pack(path)

    shots = {split: [s for s in recipe.shots() if s.split == split][:limit] for split in SPLITS}
    started = time.perf_counter()
    for split, of in shots.items():
        for i, shot in enumerate(of):
            render(shot, folder / split / f"r_{i:03}.png")
        _write(folder / f"transforms_{split}.json", {"camera_angle_x": ANGLE_X, "frames": _frames(split, of)})
    seconds = (time.perf_counter() - started) / sum(map(len, shots.values()))
    ceiling = []
    with tempfile.TemporaryDirectory() as other:
        for i, shot in enumerate(shots["test"][:CEILING_VIEWS]):
            again = Path(other) / f"{i}.png"
            render(shot, again, seed=1)
            ceiling.append(_psnr(bpy, again, folder / "test" / f"r_{i:03}.png"))
    about = {
        "name": name,
        "effects": recipe.effects,
        "renderer": f"bpy {bpy.app.version_string} Cycles CPU",
        "resolution": [size, size],
        "samples": samples,
        "denoiser": "OIDN",
        "seed": 0,
        "background": "transparent",
        "counts": {split: len(of) for split, of in shots.items()},
        "seconds_per_image": round(seconds, 2),
        "noise_ceiling_db": [round(psnr, 2) for psnr in ceiling],
    }
    _write(folder / "scene.json", about)


def _studio(bpy: Any, size: int, samples: int) -> tuple[Any, Any]:
    """Empty the scene, and set up Cycles on the CPU, one lamp, a grey sky and a camera; return scene and camera."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = samples
    scene.cycles.use_denoising, scene.cycles.denoiser = True, "OPENIMAGEDENOISE"
    scene.render.film_transparent = True
    scene.render.resolution_x = scene.render.resolution_y = size
    scene.render.image_settings.file_format, scene.render.image_settings.color_mode = "PNG", "RGBA"
    scene.view_settings.view_transform = "Standard"
    scene.world = bpy.data.worlds.new("sky")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.6, 0.65, 0.7, 1.0)
    lamp = bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "SUN"))
    lamp.data.energy, lamp.data.angle, lamp.rotation_euler = 2.0, 0.2, (0.6, 0.3, 0.0)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.angle_x = ANGLE_X
    for added in (lamp, camera):
        scene.collection.objects.link(added)
    scene.camera = camera
    return scene, camera


def _frames(split: str, shots: list[Shot]) -> list[dict[str, Any]]:
    """Return the entries of transforms_<split>.json."""
    return [
        {"file_path": f"./{split}/r_{i:03}", "time": shot.time, "transform_matrix": shot.pose.tolist()}
        for i, shot in enumerate(shots)
    ]


def _write(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1) + "\n")


def _pack(path: Path) -> None:
    """Write a PNG anew in three quarters of its size: pixels that nobody sees become black, compression is slower."""
    from PIL import Image

    with Image.open(path) as image:
        pixels = np.array(image)  # [H, W, 4]
    pixels[pixels[..., 3] == 0] = 0
    Image.fromarray(pixels).save(path, optimize=True)


def _psnr(bpy: Any, *paths: Path) -> float:
    """Return the PSNR in dB of two images over black."""
    pixels = []
    for path in paths:
        image = bpy.data.images.load(str(path))
        rgba = np.array(image.pixels[:]).reshape(-1, 4)  # straight alpha, sRGB
        pixels.append(rgba[:, :3] * rgba[:, 3:])
    return -10 * math.log10(float(np.square(pixels[0] - pixels[1]).mean()))


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Keep what Blender prints for each image from the terminal; it writes past sys.stdout."""
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)


def main(arguments: list[str] | None = None) -> int:
    """Render one scene; return 2 if it cannot be rendered, otherwise 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", choices=sorted(RECIPES))
    parser.add_argument("folder", type=Path, help="a new folder")
    parser.add_argument("--size", type=int, default=160, help="width and height in pixels (%(default)s)")
    parser.add_argument("--samples", type=int, help="rays a pixel; the scene's own number by default")
    parser.add_argument("--limit", type=int, help="the most views of a split, for a look")
    options = parser.parse_args(arguments)
    try:
        generate(options.scene, options.folder, size=options.size, samples=options.samples, limit=options.limit)
    except ImportError as error:
        print(f"generate: expected Blender, which `make scenes` installs: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"generate: {error}", file=sys.stderr)
        return 2
    print(f"Written: {options.folder}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

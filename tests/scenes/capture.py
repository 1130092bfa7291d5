"""Write small COLMAP captures: images, and a model of their cameras as .bin or .txt."""

import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from scenes.tiny_scene import write_image
from scipy.spatial.transform import Rotation

from gsbench.scenes import Scene
from gsbench.scenes.scene import UP, up_of

MODELS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "OPENCV_FISHEYE": 5}
COLOR = (140, 128, 102)  # RGB of the points


@dataclass
class Capture:
    """A model of one camera and the images it took."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]
    names: list[str]
    viewmats: np.ndarray  # [N, 4, 4]
    points: np.ndarray = field(
        default_factory=lambda: np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    )  # [P, 3]

    def poses(self) -> list[list[float]]:
        """Quaternion (w first) and translation of each image."""
        quaternions = Rotation.from_matrix(self.viewmats[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
        return np.concatenate([quaternions, self.viewmats[:, :3, 3]], 1).tolist()

    def write(self, root: Path, kind: str, where: str = "sparse/0") -> Path:
        """Write a folder of the folder `root`; kind: bin or txt. Return `root`."""
        folder = root / where
        folder.mkdir(parents=True, exist_ok=True)
        for part, data in (self.binary() if kind == "bin" else self.text()).items():
            (folder / f"{part}.{kind}").write_bytes(data)
        return root

    def binary(self) -> dict[str, bytes]:
        """The three files; each image has a keypoint, each point a track of two."""
        camera = struct.pack("<QIiQQ", 1, 7, MODELS[self.model], self.width, self.height)
        camera += struct.pack(f"<{len(self.parameters)}d", *self.parameters)
        images = struct.pack("<Q", len(self.names))
        for i, (name, pose) in enumerate(zip(self.names, self.poses(), strict=True), 1):
            images += struct.pack("<I7dI", i, *pose, 7) + name.encode() + b"\0" + struct.pack("<Q2dq", 1, 3.0, 4.0, -1)
        points = struct.pack("<Q", len(self.points))
        for i, xyz in enumerate(self.points, 1):
            points += struct.pack("<Q3d3BdQ4I", i, *xyz, *COLOR, 0.5, 2, 1, 0, 2, 0)
        return {"cameras": camera, "images": images, "points3D": points}

    def text(self) -> dict[str, bytes]:
        """The same; every second image has no keypoint, so that its second line is empty."""
        camera = f"# comment\n7 {self.model} {self.width} {self.height} {' '.join(map(repr, self.parameters))}\n"
        images = "# comment\n"
        for i, (name, pose) in enumerate(zip(self.names, self.poses(), strict=True), 1):
            images += f"{i} {' '.join(map(repr, pose))} 7 {name}\n{'3.0 4.0 -1' if i % 2 else ''}\n"
        red, green, blue = COLOR
        points = "".join(
            f"{i} {x} {y} {z} {red} {green} {blue} 0.5 1 0 2 0\n" for i, (x, y, z) in enumerate(self.points, 1)
        )
        return {"cameras": camera.encode(), "images": images.encode(), "points3D": points.encode()}


def circle(count: int) -> np.ndarray:  # [count, 4, 4]
    """Cameras around the origin that look at it from a distance of 4."""
    viewmats = np.tile(np.eye(4), (count, 1, 1))
    viewmats[:, :3, :3] = Rotation.from_rotvec(np.linspace(0, 5, count)[:, None] * [0, 1, 0]).as_matrix()
    viewmats[:, 2, 3] = 4
    return viewmats


WIDTH, HEIGHT, COUNT = 16, 12, 9  # of the small capture
NAMES = [f"frame_{i:03d}.png" for i in range(COUNT)]


def small_model(
    root: Path, names: list[str] = NAMES, viewmats: np.ndarray | None = None, where: str = "sparse/0"
) -> Path:
    """Write the model of the small capture, as text, with these images and cameras; return `root`."""
    viewmats = circle(COUNT)[: len(names)] if viewmats is None else viewmats
    return Capture("PINHOLE", WIDTH, HEIGHT, (20.0, 21.0, 3.25, 9.5), names, viewmats).write(root, "txt", where)


def small_capture(root: Path) -> Path:
    """Write nine images, each of one grey, and their model; return `root`."""
    for i, name in enumerate(NAMES):
        write_image(root / "images" / name, np.full((HEIGHT, WIDTH, 3), 20 * i, np.uint8))
    return small_model(root)


def has_estimated_up(scene: Scene) -> bool:
    """Whether the upward direction is that of the training cameras, and not the z axis."""
    up = up_of(torch.stack([view.camera.viewmat for view in scene.train]))
    return scene.up == up != UP

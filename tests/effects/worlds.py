"""Scenes made in memory, of a few coloured Gaussians and cameras around them, for tests of what a scene calls for."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from gsbench.backends import AUTO
from gsbench.models.base import Gaussians3D
from gsbench.models.render import rasterize_slice
from gsbench.scenes.scene import Camera, Scene, View, scene_extent

SIZE = 40
World = Callable[[float], Gaussians3D]


def camera(azimuth: float, height: float, size: int = SIZE) -> Camera:
    """A camera at distance 4 that looks at the origin."""
    level = math.sqrt(max(0.0, 1 - height * height))
    center = 4 * torch.tensor([level * math.cos(azimuth), level * math.sin(azimuth), height])
    forward = -center / center.norm()
    right = torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0]))
    right = right / right.norm()
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ center
    K = torch.tensor([[1.2 * size, 0, size / 2], [0, 1.2 * size, size / 2], [0, 0, 1]])
    return Camera(viewmat, K, size, size)


def blobs(count: int = 60, seed: int = 0) -> Gaussians3D:
    """Opaque coloured balls in the unit cube."""
    random = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 3, generator=random) * 2 - 1
    factors = torch.eye(3).repeat(count, 1, 1) * (0.08 + 0.1 * torch.rand(count, 1, 1, generator=random))
    return Gaussians3D(means, factors, torch.full((count,), 0.95), torch.rand(count, 3, generator=random))


def filmed(world: World, views: int = 48, seed: int = 1, *, orbit: bool = False, times: Tensor | None = None) -> Scene:
    """Film a world, one view a moment: from random places, or on one slow turn around it (`orbit`).

    Args:
        world: its Gaussians at a time.
        views: of the training.
        seed: of the places.
        orbit: the camera moves along with time.
        times: [views] that the views say they are of; those at which they were filmed by default.
    """
    random = torch.Generator().manual_seed(seed)
    film = []
    for i in range(views):
        moment = i / (views - 1)
        draws = torch.rand(2, generator=random)
        place = (2 * math.pi * moment, 0.3) if orbit else (2 * math.pi * float(draws[0]), 1.6 * float(draws[1]) - 0.8)
        seen = camera(*place)
        image = rasterize_slice(world(moment), seen, torch.zeros(3), AUTO).image[0]
        film.append(View(f"train/{i}", seen, moment if times is None else float(times[i]), image))
    extent = scene_extent(torch.stack([view.camera.viewmat for view in film]))
    return Scene("world", film, [], [], (0.0, 0.0, 0.0), extent, None, "made in memory")


def still(_: float) -> Gaussians3D:
    """Nothing changes."""
    return blobs()


def moving(moment: float) -> Gaussians3D:
    """Half of the balls move."""
    world = blobs()
    means = world.means.clone()
    means[::2, 0] += 0.6 * math.sin(2 * math.pi * moment)
    return world._replace(means=means)


def small_mover(moment: float) -> Gaussians3D:
    """One ball moves, in about 2 % of the image."""
    world = blobs()
    means = world.means.clone()
    means[0] = torch.tensor([1.2 * moment - 0.6, 0.0, 1.15])
    return world._replace(means=means)


def brightening(moment: float) -> Gaussians3D:
    """Nothing moves; half of the balls shine up and fade, slowly."""
    world = blobs()
    colors = world.colors.clone()
    colors[::2] *= 0.4 + 0.6 * math.sin(math.pi * moment)
    return world._replace(colors=colors)

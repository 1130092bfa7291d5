"""Scenes and models made in memory, of a few coloured Gaussians and cameras around them."""

import copy
import functools
import math
from collections.abc import Callable

import torch
from torch import Tensor

from gsbench.gates.gate import apply, choose
from gsbench.gates.sensitivity import Sensitivity, probe
from gsbench.kernels.backends import AUTO
from gsbench.models import CameraTime, GaussianModel, build
from gsbench.models.cameras import look_at
from gsbench.models.gaussian_batch import Gaussians3D
from gsbench.models.render import rasterize_slice
from gsbench.scenes.scene import Camera, Points, Scene, View, scene_extent
from gsbench.schedule import ActiveComponents

SIZE = 40
World = Callable[[float], Gaussians3D]


def camera(azimuth: float, height: float, size: int = SIZE) -> Camera:
    """A camera at distance 4 that looks at the origin, whose image is a fifth higher than wide."""
    tall = size + size // 5
    level = math.sqrt(max(0.0, 1 - height * height))
    center = 4 * torch.tensor([level * math.cos(azimuth), level * math.sin(azimuth), height])
    viewmat = look_at(center, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    K = torch.tensor([[1.2 * size, 0, size / 2], [0, 1.2 * size, tall / 2], [0, 0, 1]])
    return Camera(viewmat, K, size, tall)


def blobs(count: int = 60, seed: int = 0) -> Gaussians3D:
    """Opaque coloured balls in the unit cube."""
    random = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 3, generator=random) * 2 - 1
    factors = torch.eye(3).repeat(count, 1, 1) * (0.08 + 0.1 * torch.rand(count, 1, 1, generator=random))
    return Gaussians3D(means, factors, torch.full((count,), 0.95), torch.rand(count, 3, generator=random))


def scene_of(name: str, views: list[View]) -> Scene:
    """A scene of views on black, in no order of time, as in the files of many data sets."""
    order = torch.randperm(len(views), generator=torch.Generator().manual_seed(7)).tolist()
    extent = scene_extent(torch.stack([view.camera.viewmat for view in views]))
    return Scene(name, [views[i] for i in order], [], [], (0.0, 0.0, 0.0), extent, None, "made in memory")


def draw(world: World, at: Camera, moment: float) -> Tensor:
    return rasterize_slice(world(moment), at, torch.zeros(3), AUTO).image[0]


def filmed(world: World, views: int = 48, seed: int = 1, *, orbit: bool = False, times: Tensor | None = None) -> Scene:
    """Film a world, one view a moment, from random positions.

    Args:
        world: its Gaussians at a time.
        views: of the training.
        seed: of the positions.
        orbit: the camera makes one slow turn around the world instead.
        times: [views] that the views say they are of; those at which they were filmed by default.
    """
    random = torch.Generator().manual_seed(seed)
    film = []
    for i in range(views):
        moment = i / (views - 1)
        draws = torch.rand(2, generator=random)
        turn = (2 * math.pi * moment, 0.3) if orbit else (2 * math.pi * float(draws[0]), 1.6 * float(draws[1]) - 0.8)
        image = draw(world, camera(*turn), moment)
        film.append(View(f"train/{i}", camera(*turn), moment if times is None else float(times[i]), image))
    return scene_of("world", film)


def rigged(
    world: World,
    places: int = 6,
    views: int = 8,
    *,
    exposure: Callable[[Tensor, float], Tensor] | None = None,
    shake: float = 0.0,
    together: bool = False,
) -> Scene:
    """Film a world from positions that do not change, several times from each.

    Args:
        world: its Gaussians at a time.
        places: number of positions.
        views: of each position.
        exposure: what becomes of an image at a time, before it is stored in 8 bits.
        shake: radians by which the cameras turn around the scene between views.
        together: all cameras fire at the same moments, and not one after the other.
    """
    random = torch.Generator().manual_seed(1)
    film = []
    stands = [(2 * math.pi * k / places, 1.2 * float(torch.rand(1, generator=random)) - 0.6) for k in range(places)]
    for i in range(places * views):
        moment = (i // places) / (views - 1) if together else i / (places * views - 1)
        turned = shake * (2 * torch.rand(2, generator=random) - 1)
        azimuth, height = stands[i % places]
        at = camera(azimuth + float(turned[0]), height + float(turned[1]))
        image = draw(world, at, moment)
        image = image if exposure is None else exposure(image, moment)
        film.append(View(f"train/{i}", at, moment, (image.clamp(0, 1) * 255).round().to(torch.uint8)))
    return scene_of("rig", film)


def still(_: float) -> Gaussians3D:
    return blobs()


def moving(moment: float) -> Gaussians3D:
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


def appearing(moment: float) -> Gaussians3D:
    """One ball, in about 1 % of the image, is there for an eighth of the time."""
    world = blobs()
    opacities = world.opacities.clone()
    opacities[0] = 0.95 if 0.4 < moment < 0.525 else 0.0
    means = world.means.clone()
    means[0] = torch.tensor([0.0, 0.0, 1.15])
    return world._replace(means=means, opacities=opacities)


def brightening(moment: float) -> Gaussians3D:
    """Nothing moves; half of the balls shine up and fade, slowly."""
    world = blobs()
    colors = world.colors.clone()
    colors[::2] *= 0.4 + 0.6 * math.sin(math.pi * moment)
    return world._replace(colors=colors)


N, MODEL_SIZE, VIEWS = 60, 24, 30
BLACK = torch.zeros(3)
OPTIONS = {
    "7dgs": {"lambda_t": 0.5, "lambda_d": 0.3, "agr": True},
    "7dgs_nodir": {"lambda_t": 0.5, "agr": True},
    "6dgs": {"lambda_d": 0.3},
    "4dgs": {},
    "3dgs": {},
}


def trained_a_little(name: str, seed: int) -> GaussianModel:
    """A model whose Gaussians move, gleam and are refined."""
    random = torch.Generator().manual_seed(seed)
    model = build(name, **OPTIONS[name])
    model.initialise(Points(torch.rand(N, 3, generator=random) * 2 - 1, torch.rand(N, 3, generator=random)), 4, random)
    model.set_active(ActiveComponents(3, model.agr, False))
    with torch.no_grad():
        for key, parameter in model.splats.items():
            size = {"means": 0.02, "motion": 0.15, "opacities": 1.5, "shN": 0.08}.get(key, 0.2)
            parameter += size * torch.randn(parameter.shape, generator=random)
        if model.refinement is not None:
            weight = model.refinement.weight_out
            weight += 0.02 * torch.randn(weight.shape, generator=random)
    return model.requires_grad_(False)


def views_of(model: GaussianModel, seed: int) -> list[View]:
    """Views of what the model might have been fitted to: its own images and noise."""
    random = torch.Generator().manual_seed(seed)
    film = []
    for i in range(VIEWS):
        draws = torch.rand(3, generator=random).tolist()
        at, time = camera(6.28 * draws[0], 1.6 * draws[1] - 0.8, MODEL_SIZE), draws[2]
        image = rasterize_slice(model.slice(CameraTime.of(at, time)), at, BLACK, model.backend).image[0]
        film.append(View(str(i), at, time, image + 0.02 * torch.randn(image.shape, generator=random)))
    return film


@functools.cache
def probed(name: str) -> tuple[GaussianModel, Sensitivity]:
    """A model and what its simplifications would cost; no test may change them."""
    model = trained_a_little(name, 0)
    return model, probe(model, views_of(model, 1)[:10], BLACK)


@functools.cache
def gated(name: str, share: float) -> tuple[GaussianModel, GaussianModel]:
    """A model before and after a gate; no test may change them."""
    model, sensitivity = probed(name)
    after = copy.deepcopy(model)
    apply(after, sensitivity.simplifications, choose(sensitivity, after, share))
    return model, after

"""The exact image and its bound: no float32 image is farther from it than the bound says, and few are much nearer."""

import copy
from collections.abc import Iterable
from typing import Any

import hard_scenes
import pytest
import torch
from numerics import brute, pictures
from numerics.cases import CASES
from torch import Tensor

from benchmarks.scene import camera, model
from gsbench import kernels
from gsbench.errors import InputError
from gsbench.models import CameraTime
from gsbench.raster import rasterize
from gsbench.raster.exact import ORDERED, SKIPPED, STOPPED, ExactImage, Gaussians, exact_image

NAMES = ("means", "factors", "opacities", "colors", "beta_exponents")
NOISES = (0.0, 6e-8, 1e-3)  # of Gaussians in float32: none, a rounding, and what no model has
LOOSEST = 100  # largest ratio of the bound to the error in the median pixel

pytestmark = pytest.mark.skipif(not kernels.available(), reason="the kernels are not built")


def images(arguments: dict[str, Any], noise: float = 0.0, seed: int = 0) -> tuple[Tensor, ExactImage, Tensor]:
    """The image in float32, the exact one, and that of the reference in float64. With noise, float32 has other
    Gaussians than float64, as after slicing: numbers differ by this part of them."""
    rest = {name: value for name, value in arguments.items() if name not in NAMES}
    viewmats, Ks, width, height = (rest.pop(name) for name in ("viewmats", "Ks", "width", "height"))
    single = tuple(arguments.get(name) for name in NAMES)
    g = torch.Generator().manual_seed(seed)
    exact = [
        None if x is None else x.double() * (1 + noise * (2 * torch.rand(x.shape, generator=g).double() - 1))
        for x in single
    ]
    exact[2] = exact[2].clamp(0, 1)
    cameras = viewmats, Ks, width, height
    image = rasterize(*single[:4], *cameras, beta_exponents=single[4], backend="cpu", **rest).image[0]
    bounded = exact_image(tuple(exact), single, viewmats[0], Ks[0], width, height, **rest)
    if rest.get("background") is not None:
        rest["background"] = rest["background"].double()
    cameras = viewmats.double(), Ks.double(), width, height
    true = rasterize(*exact[:4], *cameras, beta_exponents=exact[4], backend="reference", **rest).image[0]
    return image, bounded, true


def check(seeds: Iterable[int]) -> None:
    ratios = []
    for seed in seeds:
        image, bounded, true = images(hard_scenes.scene(seed), NOISES[seed % len(NOISES)], seed)
        error = (image.double() - bounded.image).abs().amax(-1)
        assert (error <= bounded.bound).all(), seed
        assert (bounded.image - true).abs().max() <= 1e-12 * max(1.0, float(true.abs().max())), seed
        decided = (error > 0) & ~bounded.undecided
        ratios.append((bounded.bound / error)[decided])
    assert torch.cat(ratios).median() <= LOOSEST


@pytest.mark.parametrize("instruction_set", kernels.native().instruction_sets() if kernels.available() else [])
def test_no_error_is_above_its_bound(instruction_set):
    """Catches an error that the analysis leaves out, in any instruction set, and a bound that says nothing."""
    best = kernels.native().instruction_sets()[-1]
    kernels.use_instruction_set(instruction_set)
    try:
        check(range(100))
    finally:
        kernels.use_instruction_set(best)


def test_every_instruction_set_and_number_of_threads_has_the_same_bits():
    """Catches a fused product, an exponential of a library, and a sum whose order depends on threads."""
    sets, threads = kernels.native().instruction_sets(), torch.get_num_threads()
    true: dict[int, Tensor] = {}
    bounds: dict[tuple[int, bool], Tensor] = {}
    try:
        for name, count in [*((name, 1) for name in sets), (sets[-1], 3)]:
            kernels.use_instruction_set(name)
            torch.set_num_threads(count)
            for seed in range(20):
                bounded = images(hard_scenes.scene(seed), NOISES[seed % len(NOISES)], seed)[1]
                assert torch.equal(bounded.image, true.setdefault(seed, bounded.image)), (name, count, seed)
                # Without fused multiply-add, float32 projects to other numbers.
                assert torch.equal(bounded.bound, bounds.setdefault((seed, name == "v2"), bounded.bound)), (name, count)
    finally:
        kernels.use_instruction_set(sets[-1])
        torch.set_num_threads(threads)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_no_error_of_2000_scenes_is_above_its_bound():
    """The same, 2,000 times."""
    check(range(100, 2_100))


@pytest.mark.parametrize("name", ["3dgs", "4dgs", "6dgs", "7dgs", "7dgs_agr", "ubs", "dbs", "freetime"])
def test_errors_of_slicing_are_in_the_bound(name):
    """Catches a slice, a colour or a shape whose rounding is not carried to the pixels."""
    gaussians = model(name.removesuffix("_agr"), 2_000, agr=name.endswith("_agr"), sigma=0.05)
    viewmat, K = (x[0] for x in camera(32))
    with torch.no_grad():
        query = CameraTime.at(-viewmat[:3, 3], 0.4)
        single = gaussians.slice(query)
        exact = copy.deepcopy(gaussians).double().slice(CameraTime.at(query.center.double(), 0.4))
        image = rasterize(*single[:4], viewmat[None], K[None], 32, 32, beta_exponents=single.beta_exponents).image[0]
        bounded = exact_image(exact, single, viewmat, K, 32, 32)
    error = (image.double() - bounded.image).abs().amax(-1)
    assert (error <= bounded.bound).all()
    assert 0 < bounded.bound[bounded.culprit >= 0].median() < 1e-5
    wrong = single._replace(colors=single.colors + 1e-3)
    assert exact_image(exact, wrong, viewmat, K, 32, 32).bound.max() > 3e-4


def test_the_exact_image_is_that_of_brute_force():
    """Catches a box, a tile or a stop that leaves out a pixel of the exact image."""
    for name in ("ordinary_crowd", "beta_crowd", "opaque_stack", "equal_depths"):
        (arguments,) = CASES[name]()
        doubles = {k: x.double() if isinstance(x, Tensor) else x for k, x in arguments.items()}
        true = brute.render(**doubles).image[0]
        assert (images(arguments)[1].image - true).abs().max() <= 1e-12, name


HARD_AND_EASY = (  # the severity and the number of a case in which rounding decides, and of one in which it does not
    (SKIPPED, "alpha_at_its_limits", (1.0, 2), (1.0, 3)),
    (STOPPED, "transmittance_at_the_stop", (1.0, 0), (0.4, 0)),
    (ORDERED, "equal_depths", (1.0, 0), (0.0, 0)),
)


@pytest.mark.parametrize(("branch", "name", "hard", "easy"), HARD_AND_EASY)
def test_a_branch_that_rounding_decides_is_named(branch, name, hard, easy):
    """Catches a pixel that may jump and is not counted, and one that is counted where nothing can jump."""
    cases = hard, easy
    for (severity, which), undecided in zip(cases, (True, False), strict=True):
        bounded = images(CASES[name](severity)[which])[1]
        assert bool((bounded.branches & branch).any()) == undecided
        assert float(bounded.bound.max()) > 1e-5 or not undecided


def test_the_culprit_is_the_gaussian_with_the_error():
    """Catches a culprit that is only the brightest, the nearest or the last Gaussian."""
    arguments = pictures.crowd(torch.Generator().manual_seed(0), 5, 1.0)
    arguments["opacities"] = torch.full((5,), 0.3)
    single: Gaussians = tuple(arguments.get(name) for name in NAMES)
    exact = tuple(None if x is None else x.double() for x in single)
    third = int(single[0][:, 2].argsort()[2])
    single[0][third, 0] += 1e-2
    bounded = exact_image(exact, single, arguments["viewmats"][0], arguments["Ks"][0], 16, 12)
    assert (bounded.culprit == third).double().mean() > 0.9


def test_without_gaussians_the_image_is_the_background():
    """Catches an error where a scene, or a tile, has no Gaussian."""
    for arguments in CASES["no_gaussians"]():
        image, bounded, _ = images(arguments)
        assert torch.equal(bounded.image.float(), image)
        assert (bounded.culprit == -1).all()
        assert bounded.median_bound == 0
        assert bounded.bound.max() < 1e-6


def test_other_gaussians_are_refused():
    """Catches float64 taken for float32, and two sets of Gaussians that differ in number."""
    arguments = pictures.crowd(torch.Generator().manual_seed(0), 4, 1.0)
    single = tuple(arguments.get(name) for name in NAMES)
    exact = tuple(None if x is None else x.double() for x in single)
    place = arguments["viewmats"][0], arguments["Ks"][0], 16, 12
    with pytest.raises(InputError, match=r"expected Gaussians of torch\.float64 on the CPU, got torch\.float32"):
        exact_image(single, single, *place)
    with pytest.raises(InputError, match="as many Gaussians in float32 as in float64"):
        exact_image(exact, tuple(None if x is None else x[:3] for x in single), *place)

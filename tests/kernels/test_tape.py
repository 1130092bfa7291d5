"""A tape's gradients against autograd's: the same bits, where operations are chained and where torch is in between."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from benchmarks.scene import camera, model
from gsbench.kernels.backends import AUTO, CPU, REFERENCE, Backend
from gsbench.kernels.colors import show_colors
from gsbench.kernels.loss import l1_ssim
from gsbench.kernels.slices import slice_static
from gsbench.kernels.tape import Tape, collect_gradients
from gsbench.measure.speed import StageClock
from gsbench.models import CameraTime, GaussianModel
from gsbench.models.effect_sets import EffectSets
from gsbench.models.gaussian_batch import tensors_of
from gsbench.models.render import rasterize_slice
from gsbench.scenes.scene import Camera, View
from gsbench.train.step import Step, fitting_threads
from gsbench.train.step_replay import Observed

BACKGROUND = torch.tensor([0.1, 0.5, 0.9])


def views(count: int, size: int = 40) -> list[View]:
    """The benchmark's camera at a few distances and times, before random images."""
    viewmats, Ks = camera(size)
    g, batch = torch.Generator().manual_seed(0), []
    for i in range(count):
        viewmat = viewmats[0].clone()
        viewmat[2, 3] += 0.3 * i
        K = Ks[0].clone()
        K[:2, :2] *= 1 + 0.1 * i
        image = torch.rand(size - 3, size, 3, generator=g)
        batch.append(View(str(i), Camera(viewmat, K, size, size - 3), 0.1 + 0.2 * i, image))
    return batch


def fitted(name: str, N: int = 300, *, agr: bool = False, classed: bool = False) -> GaussianModel:
    """A model all of whose parts learn, and whose Gaussians cover each other; or not all of them in every row."""
    fitting = model(name, N, agr=agr, sigma=0.2, backend=CPU)
    with torch.no_grad():
        for parameter in fitting.refinement.parameters() if fitting.refinement is not None else ():
            parameter.add_(0.02 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1)))
    fitting.set_active(replace(fitting.active, tunes_lambda=True))
    if classed:
        orders = torch.randint(0, 12, (N,), generator=torch.Generator().manual_seed(2), dtype=torch.int32)
        fitting.effect_sets = EffectSets(N // 3, N // 2 + 1, orders)
    return fitting


def gradients(of: GaussianModel) -> dict[str, Tensor]:
    taken = {name: p.grad for name, p in of.named_parameters() if p.grad is not None}
    of.zero_grad(set_to_none=True)
    return taken


def test_a_tape_records_its_thread_alone():
    """Catches calls of another thread on a tape, where autograd does not see them: a viewer beside a probe."""
    fitting, (view,) = fitted("4dgs", 20), views(1)
    with Tape(), ThreadPoolExecutor(1) as pool:
        beside = pool.submit(fitting.slice, CameraTime.of(view.camera, view.time)).result()
    beside.opacities.sum().backward()
    assert float(gradients(fitting)["splats.opacities"].abs().sum()) > 0


def test_a_tape_runs_backwards_for_several_vectors():
    """Catches a second vector whose product has the first one's in it, or is empty: the probe asks for two."""
    view = views(1)[0]
    gaussians = fitted("7dgs").slice(CameraTime.of(view.camera, view.time))
    at = [x.detach().requires_grad_() for x in tensors_of(gaussians)]
    with Tape() as tape:
        images = rasterize_slice(type(gaussians)(*at), view.camera, BACKGROUND, CPU).image
    vectors = [torch.randn(images.shape, generator=torch.Generator().manual_seed(i)) for i in range(2)]
    alone = rasterize_slice(type(gaussians)(*at), view.camera, BACKGROUND, CPU).image
    for vector in vectors:
        sums: dict[int, Tensor] = {}
        tape.backward(images, vector, at, sums)
        expected = torch.autograd.grad(alone, at, vector, retain_graph=True)
        assert all(torch.equal(sums[id(x)], gradient) for x, gradient in zip(at, expected, strict=True))


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize(
    ("name", "agr", "classed"),
    [
        ("3dgs", False, False),
        ("4dgs", False, False),
        ("6dgs", False, False),
        ("7dgs", False, False),
        ("7dgs", True, False),
        ("4dgs", True, False),
        ("7dgs", True, True),
        ("4dgs", True, True),
        ("3dgs", True, True),
    ],
)
def test_a_step_s_gradients_are_autograd_s(name, agr, classed):
    """Catches an operation left out of the chain, a gradient given twice, or to another tensor."""
    fitting, batch = fitted(name, agr=agr, classed=classed), views(3)
    expected: dict[str, Tensor] = {}
    for view in batch:
        gaussians = fitting.slice(CameraTime.of(view.camera, view.time))
        output = rasterize_slice(gaussians, view.camera, BACKGROUND, CPU)
        output.info.means2d.retain_grad()
        (l1_ssim(output.image[0], view.image, 0.2) / 3).backward()
        for key, gradient in gradients(fitting).items():
            expected[key] = gradient if key not in expected else expected[key] + gradient
    torch.set_num_threads(1)
    of_views = Step(fitting, BACKGROUND, 0.2, False, StageClock())(batch)
    actual = gradients(fitting)
    assert actual.keys() == expected.keys()
    for key, gradient in expected.items():
        assert torch.equal(actual[key], gradient), key
        assert gradient.any(), key
    assert torch.equal(of_views[-1].g_means2d, output.info.means2d.grad)


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize(
    ("name", "agr", "classed"),
    [("7dgs", True, False), ("4dgs", False, False), ("7dgs", True, True), ("4dgs", True, True)],
)
def test_a_training_step_s_gradients_are_the_reference_s(name, agr, classed, place, monkeypatch):
    """Catches what no kernel shows alone: a gradient that is lost, or taken twice, on its way from the loss through
    blending, projection, colours and slices to the parameters, or in the sum over views."""
    torch.set_num_threads(1)  # the shim runs in one
    if place.name == "cuda":
        monkeypatch.setattr("gsbench.train.step.TOGETHER_ON", (place.device,))

    def step(backend: Backend, device: str) -> dict[str, Tensor]:
        fitting = fitted(name, agr=agr, classed=classed).to(device)
        if classed:
            fitting.effect_sets = fitting.effect_sets._replace(orders=fitting.effect_sets.orders.to(device))
        fitting.backend = backend
        Step(fitting, BACKGROUND.to(device), 0.2, False, StageClock(device))([view.to(device) for view in views(2)])
        return gradients(fitting)

    got, want = step(AUTO, place.device), step(REFERENCE, "cpu")
    assert got.keys() == want.keys()
    for key, expected in want.items():
        assert expected.any(), key
        assert (got[key].cpu() - expected).norm() <= 1e-3 * expected.norm(), key


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize(
    ("name", "agr", "read_twice", "shared"),
    [
        ("3dgs", False, ["means"], ["scales", "quats", "opacities"]),
        ("4dgs", False, ["times"], []),
        ("7dgs", True, [], []),
        ("ubs", False, [], []),
    ],
)
def test_views_together_have_the_bits_of_views_one_by_one(name, agr, read_twice, shared, place, monkeypatch):
    """Catches a view that reads another's slice, camera or target, and gradients that are lost or added twice. On a
    CPU, gradients are added from the last view to the first. On a GPU, a thread adds those of its Gaussian from the
    first view to the last. What two operations of a view read has no sum for each view; on a GPU, neither have what all
    views share and sums over Gaussians."""
    torch.set_num_threads(1)
    monkeypatch.setattr("gsbench.train.step.TOGETHER_ON", (place.device,))
    fitting, batch = fitted(name, agr=agr).to(place.device), [view.to(place.device) for view in views(4)]
    fitting.backend = AUTO
    step = Step(fitting, BACKGROUND.to(place.device), 0.2, False, StageClock(place.device))
    (together,) = step(batch)
    of_together = gradients(fitting)
    sums: dict[int, Tensor] = {}
    single = {}
    on_gpu = place.name == "cuda"
    for i in range(4) if on_gpu else (3, 2, 1, 0):
        seed = torch.full((1,), 0.25, device=place.device)
        single[i] = step._of_part([i], Observed.of(batch[i : i + 1]), step.parameters, sums, seed, step.stages)
    assert together.views == [0, 1, 2, 3]
    for key in ("loss", "drawn", "g_means2d"):
        got, want = getattr(together, key), torch.cat([getattr(single[i], key) for i in range(4)])
        assert torch.equal(got, want) or place.device == "cuda", key
    for key, parameter in fitting.named_parameters():
        got, want = of_together[key], sums[id(parameter)]
        assert want.any()
        torch.testing.assert_close(got, want, rtol=1e-4, atol=1e-5 * float(want.abs().max()))
        rounded = key.removeprefix("splats.") in read_twice + shared * on_gpu
        rounded |= on_gpu and not key.startswith("splats.")
        assert torch.equal(got, want) or place.device == "cuda" or rounded, key


def test_views_that_cannot_be_rendered_together_are_parts_of_their_own(monkeypatch):
    """Catches two sizes in one launch, results in another order, and a map or a loss that sees one view of several."""
    monkeypatch.setattr("gsbench.train.step.TOGETHER_ON", ("cpu",))
    fitting, (a, b, c), (small,) = fitted("4dgs"), views(3), views(1, 30)
    step = Step(fitting, BACKGROUND, 0.2, False, StageClock())
    near = replace(b, camera=replace(b.camera, near=0.5))
    in_bytes = replace(c, pixels=(255 * c.image).to(torch.uint8))
    batch = [a, small, b, near, c, in_bytes]
    results = step(batch)
    assert [part.views for part in results] == [[0, 2, 4], [1], [3], [5]]
    for part in results:
        for i, drawn, loss in zip(part.views, part.drawn, part.loss, strict=True):
            (alone,) = step(batch[i : i + 1])
            assert torch.equal(drawn, alone.drawn[0])
            torch.testing.assert_close(6 * loss, alone.loss[0])
    single = [[i] for i in range(6)]
    assert [part.views for part in step(batch, maps=[lambda image, _: image])] == single
    assert [part.views for part in step(batch, terms=[(0.0, lambda *_: torch.zeros(()))])] == single
    monkeypatch.setattr(type(fitting), "decodes", True)
    assert [part.views for part in step(batch)] == single


@pytest.mark.usefixtures("threads", "instruction_set")
@pytest.mark.parametrize(("name", "N", "classed"), [("4dgs", 300, False), ("7dgs", 300, False), ("7dgs", 2500, True)])
def test_the_same_bits_for_any_number_of_threads(name, N, classed):
    """Catches views whose gradients are added in the order that threads come by."""
    fitting, batch = fitted(name, N, agr=True, classed=classed), views(5)
    results = []
    for count in (1, 2, 3, 8):
        torch.set_num_threads(count)
        of_views = Step(fitting, BACKGROUND, 0.2, False, StageClock())(batch)
        results.append([*gradients(fitting).values(), *(x for view in of_views for x in (view.loss, view.g_means2d))])
        assert torch.get_num_threads() == count
    assert all(torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other, strict=True))


@pytest.mark.usefixtures("threads")
def test_small_scenes_are_trained_on_one_thread():
    """Catches a number of threads that is not put back, also where a step fails, and large scenes held to one."""
    torch.set_num_threads(3)
    with fitting_threads(10_000, 80 * 80):
        assert torch.get_num_threads() == 3
    with fitting_threads(100, 400 * 400):
        assert torch.get_num_threads() == 3
    with fitting_threads(1_000, 80 * 80):
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 3

    def fail() -> None:
        with fitting_threads(1_000, 80 * 80):
            raise ValueError

    with pytest.raises(ValueError):  # noqa: PT011
        fail()
    assert torch.get_num_threads() == 3


def test_what_torch_does_in_between_is_differentiated_too():
    """Catches a gradient lost where a tensor of autograd's graph enters an operation, or an operation's enters one."""
    g = torch.Generator().manual_seed(3)
    scales, quats = torch.randn(20, 3, generator=g).requires_grad_(), torch.randn(20, 4, generator=g).requires_grad_()
    opacities, means = torch.randn(20, generator=g).requires_grad_(), torch.randn(20, 3, generator=g).requires_grad_()
    sh0, shN = torch.randn(20, 1, 3, generator=g).requires_grad_(), torch.randn(20, 15, 3, generator=g).requires_grad_()
    leaves = [scales, quats, opacities, means, sh0, shN]

    def loss() -> Tensor:
        factors, faded = slice_static(2 * scales, quats, opacities)  # torch before an operation
        moved = means + (factors @ factors.mT).sum(-1) * faded[:, None]  # and after it
        colors = show_colors(sh0, shN, moved, faded, center=torch.zeros(3), degree=3)[0]
        # coefficients that are read twice
        again = show_colors(sh0, shN, 3 * moved + 1, faded, center=torch.zeros(3), degree=3)[0]
        return (colors * again.square()).sum() + means.square().sum()

    expected = torch.autograd.grad(loss(), leaves)
    with Tape() as tape:
        value = loss()
    sums = {id(sh0): torch.ones_like(sh0)}  # another view's
    tape.backward(value, torch.ones(()), leaves, sums)
    sums[id(sh0)] -= 1
    for x, gradient in zip(leaves, expected, strict=True):
        torch.testing.assert_close(sums[id(x)], gradient, rtol=1e-5, atol=1e-5)


def test_a_network_is_differentiated_once():
    """Catches a pass through a network for each input of a kernel or each of its outputs, a gradient that such a pass
    would have and one pass lacks, and a tensor that is cut off from its network where no tape runs."""
    g = torch.Generator().manual_seed(6)
    raw = torch.randn(20, 7, generator=g).requires_grad_()
    sh0, shN = torch.randn(20, 1, 3, generator=g), torch.randn(20, 15, 3, generator=g)
    passes = []

    def loss() -> Tensor:
        hidden = raw.sin()
        hidden.register_hook(passes.append)
        scales, quats, _ = collect_gradients(*(2 * hidden).split([3, 4], -1), sh0)
        factors, faded = slice_static(scales, quats, scales[:, 0].exp())
        colors = show_colors(sh0, shN, scales, faded, center=torch.zeros(3), degree=3)[0]
        return (factors.sum(-1) * colors).sum() + faded.sum()

    (expected,) = torch.autograd.grad(loss(), [raw])
    passes.clear()
    sums: dict[int, Tensor] = {}
    with Tape() as tape:
        value = loss()
    tape.backward(value, torch.ones(()), [raw], sums)
    torch.testing.assert_close(sums[id(raw)], expected)
    assert len(passes) == 1


def test_two_views_may_share_a_gradient():
    """Catches two sums that are one tensor, as torch gives both terms of a sum: another view's would be added twice."""
    g = torch.Generator().manual_seed(5)
    a, b = torch.randn(20, 3, generator=g).requires_grad_(), torch.randn(20, 3, generator=g).requires_grad_()
    quats = torch.randn(20, 4, generator=g)

    def loss(weight: float) -> Tensor:
        return weight * slice_static(a + b, quats, torch.zeros(20))[0].square().sum()

    expected = torch.autograd.grad(loss(1.0) + loss(3.0), [a, b])
    sums: dict[int, Tensor] = {}
    for weight in (1.0, 3.0):
        with Tape() as tape:
            value = loss(weight)
        tape.backward(value, torch.ones(()), [a, b], sums)
    for x, gradient in zip((a, b), expected, strict=True):
        torch.testing.assert_close(sums[id(x)], gradient, rtol=1e-5, atol=1e-5)


def test_what_is_added_does_not_depend_on_what_is_there():
    """Catches coefficients that two operations read, each of which adds its own part to other views' gradient. Which
    views share a sum depends on the number of threads, and its rounding would too."""
    g = torch.Generator().manual_seed(4)
    sh0, shN = torch.randn(50, 1, 3, generator=g).requires_grad_(), torch.randn(50, 15, 3, generator=g).requires_grad_()
    means, faded, other = torch.randn(50, 3, generator=g), torch.ones(50), torch.randn(50, 1, 3, generator=g)

    def gradient(sums: dict[int, Tensor]) -> Tensor:
        with Tape() as tape:
            shown = [
                show_colors(sh0, shN, place, faded, center=torch.zeros(3), degree=3)[0]
                for place in (means, 3 * means + 1)
            ]
            value = (shown[0] * shown[1].square()).sum()
        tape.backward(value, torch.ones(()), [sh0, shN], sums)
        return sums[id(sh0)]

    alone = gradient({})
    assert torch.equal(gradient({id(sh0): other.clone()}), other + alone)


def test_nothing_is_noted_where_nothing_is_wanted():
    """Catches a tape that keeps every tensor of a rendering."""
    with Tape() as tape, torch.no_grad():
        slice_static(torch.zeros(2, 3, requires_grad=True), torch.ones(2, 4), torch.zeros(2))
    assert not tape._calls
    with Tape() as tape:
        slice_static(torch.zeros(2, 3), torch.ones(2, 4), torch.zeros(2))
    assert not tape._calls

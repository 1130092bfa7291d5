"""Learning rates, and Adam's moments when Gaussians come and go."""

import copy
import math

import pytest
import torch

from gsbench import kernels
from gsbench.config import DensifyConfig, LearningRate, ModelConfig, TrainConfig
from gsbench.errors import InputError
from gsbench.kernels.adam import adam, adam_all
from gsbench.kernels.headers import MAX_ADAM
from gsbench.models import GaussianModel, build
from gsbench.scenes.points import random_points
from gsbench.train.density.gradient import GradientDensification
from gsbench.train.optim import Optimizer, adam_reference, rate_at
from gsbench.train.rows import Rows

RATES = {name: LearningRate(1e-2) for name in ("means", "scales", "quats", "opacities", "sh0", "shN")}


def fitted(
    count: int = 20, rates: dict[str, LearningRate] = RATES, kind: str = "adam"
) -> tuple[GaussianModel, Optimizer]:
    model = build("3dgs")
    random = torch.Generator().manual_seed(0)
    model.initialise(random_points(count, 1.0, random), extent=2.0, generator=random)
    return model, Optimizer(model, ModelConfig("3dgs", lr=rates), TrainConfig(iterations=100), 2.0, kind)


def descend(model: GaussianModel, optimizer: Optimizer, step: int, drawn: torch.Tensor | None = None) -> None:
    loss = sum(((p + 1) * (i + 1)).square().sum() for i, p in enumerate(model.splats.values()))
    assert isinstance(loss, torch.Tensor)
    loss.backward()
    optimizer.step(step, torch.ones(len(model), dtype=torch.bool) if drawn is None else drawn)


def test_rate_is_log_linear() -> None:
    """Catches a linear or stepwise decay: half way, the rate is the geometric mean (3DGS' xyz rate)."""
    rate = LearningRate(1.6e-4, 1.6e-6, per_extent=True)
    train = TrainConfig(iterations=100)
    assert rate_at(rate, 0, train, 5) == pytest.approx(8e-4)
    assert rate_at(rate, 50, train, 5) == pytest.approx(8e-5)
    assert rate_at(rate, 100, train, 5) == pytest.approx(8e-6)
    assert rate_at(LearningRate(0.05), 70, train, 5) == 0.05
    assert rate_at(LearningRate(0.05, per_extent=True), 70, train, 5) == 0.25  # constant, but in units of the scene
    assert math.isclose(rate_at(LearningRate(0.0), 70, train, 5), 0.0)


def test_rates_of_short_runs() -> None:
    """Catches rates of 30,000 steps in a run of 300, and rates that change where the recipe is as long as the run."""
    rate = LearningRate(1e-3, 1e-5, per_run=True)
    assert rate_at(rate, 0, TrainConfig(iterations=300), 5) == pytest.approx(1e-2)
    assert rate_at(rate, 300, TrainConfig(iterations=300), 5) == pytest.approx(1e-4)
    assert rate_at(rate, 0, TrainConfig(), 5) == pytest.approx(1e-3)
    assert rate_at(LearningRate(1e-3), 0, TrainConfig(iterations=300), 5) == 1e-3
    assert rate_at(LearningRate(1e-3, per_run=True), 0, TrainConfig(iterations=300), 5) == pytest.approx(1e-2)


def test_all_rates_fall_to_a_tenth_in_a_cooldown() -> None:
    """Catches a cooldown that begins at a step of this run, forgets constant rates or ends elsewhere."""
    train = TrainConfig(iterations=100, recipe_iterations=1000, cooldown_from=800)
    for rate in (LearningRate(0.05), LearningRate(1.6e-4, 1.6e-6)):
        plain = [rate_at(rate, step, TrainConfig(iterations=100, recipe_iterations=1000), 5) for step in range(101)]
        cooled = [rate_at(rate, step, train, 5) for step in range(101)]
        assert cooled[:81] == plain[:81]
        assert cooled[90] / plain[90] == pytest.approx(0.55)
        assert cooled[100] / plain[100] == pytest.approx(0.1)


def test_a_copied_gaussian_does_not_inherit_momentum() -> None:
    """Catches moments left at the wrong rows: kept rows keep theirs, in the new order, fresh ones start at zero."""
    model, optimizer = fitted()
    for step in range(3):
        descend(model, optimizer, step)
    before = copy.deepcopy({n: optimizer.moments[p]["exp_avg"] for n, p in model.splats.items()})
    rows = torch.tensor([5, 3, 3, 19])
    model.select(rows)
    optimizer.reindex(rows, fresh=torch.tensor([False, False, True, False]))
    for name, parameter in model.splats.items():
        moments = optimizer.moments[parameter]["exp_avg"]
        assert moments.shape == parameter.shape
        torch.testing.assert_close(moments[[0, 1, 3]], before[name][[5, 3, 19]], rtol=0, atol=0)
        assert not moments[2].any()
    descend(model, optimizer, 3)  # and Adam still steps


def test_rates_and_parameters_must_match() -> None:
    """Catches a parameter that silently never learns, and a misspelt rate that silently does nothing."""
    with pytest.raises(InputError, match="'quats' has none"):
        fitted(rates={n: r for n, r in RATES.items() if n != "quats"})
    with pytest.raises(InputError, match=r"no 'sacles'.*Did you mean 'scales'"):
        fitted(rates={**RATES, "sacles": LearningRate(1.0)})


def drawn_with(gradients: torch.Tensor, drawn: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
    """Which are drawn [1, N] and gradients of 2D means [1, N, 2] of one view."""
    drawn = torch.ones(len(gradients)) if drawn is None else drawn
    return drawn[None].bool(), gradients[None]


def test_density_control_clones_small_splits_large_prunes_faint() -> None:
    """Catches a wrong criterion or count of any of the three, and a gradient in pixels instead of half pictures.

    Also a clone or a child that goes on with its parent's momentum.
    """
    model, optimizer = fitted(6)
    descend(model, optimizer, 0)
    control = GradientDensification(Rows(model, optimizer), DensifyConfig(grad_threshold=1.0), 0.01, views=3)
    with torch.no_grad():
        model.splats["scales"].fill_(math.log(0.001))  # small: below 0.01 x extent 2
        model.splats["scales"][3:5] = math.log(0.1)  # large
        model.splats["opacities"].fill_(0.0)
        model.splats["opacities"][5] = -6.0  # sigmoid is 0.0025
        model.splats["means"].copy_(torch.arange(6.0)[:, None].expand(6, 3))
    gradients = torch.zeros(6, 2)
    gradients[[0, 3]] = torch.tensor([0.03, 0.0])  # x 100 / 2 pixels x 1 view = 1.5 > 1
    gradients[1] = torch.tensor([0.0, 0.03])  # x 50 / 2 = 0.75 < 1
    control.accumulate(*drawn_with(gradients), width=100, height=50, views=1)
    control.densify(torch.Generator().manual_seed(1), has_reset=False, most=100)
    means = model.splats["means"].detach()[:, 0]
    assert len(model) == 7  # 1, 2, 4 kept; 0 cloned to two; 3 split in two; 5 pruned
    assert means[:5].tolist() == [0, 1, 2, 4, 0]
    assert (model.splats["scales"][5:] < math.log(0.1) - math.log(1.59)).all()
    for parameter in model.splats.values():
        for moment in ("exp_avg", "exp_avg_sq"):
            has_moved = optimizer.moments[parameter][moment].reshape(7, -1).any(1)
            assert has_moved.tolist() == [True] * 4 + [False] * 3
    assert control.gradient.shape == (7,)
    assert not control.gradient.any()
    descend(model, optimizer, 1)


def test_no_more_gaussians_than_the_cap_and_the_largest_gradients_first() -> None:
    """Catches a threshold of 0 that makes 3.3 million Gaussians in 21 steps, and a cap that depends on the rows' order
    in a sort that is not stable, or takes the first rows whatever their gradients."""
    model, optimizer = fitted(6)
    config = DensifyConfig(grad_threshold=0.0)
    control = GradientDensification(Rows(model, optimizer), config, 0.01, views=3)
    with torch.no_grad():
        model.splats["scales"].fill_(math.log(0.001))
        model.splats["opacities"].fill_(0.0)
        model.splats["means"].copy_(torch.arange(6.0)[:, None].expand(6, 3))
    gradients = torch.zeros(6, 2)
    gradients[:, 0] = torch.tensor([0.0, 0.2, 0.1, 0.3, 0.2, 0.2])
    control.accumulate(*drawn_with(gradients), width=10, height=10, views=1)
    assert control.densify(torch.Generator(), has_reset=False, most=9) == 2
    assert model.splats["means"].detach()[:, 0].tolist() == [0, 1, 2, 3, 4, 5, 1, 3, 4]
    control.accumulate(*drawn_with(torch.ones(9, 2)), width=10, height=10, views=1)
    assert control.densify(torch.Generator(), has_reset=False, most=9) == 9
    control.accumulate(*drawn_with(torch.ones(9, 2)), width=10, height=10, views=1)
    # A file to start from may have more Gaussians than allowed.
    assert control.densify(torch.Generator(), has_reset=False, most=5) == 9
    assert len(model) == 9


def test_what_no_view_of_an_epoch_drew_is_pruned() -> None:
    """Catches dead weight that stays, Gaussians dropped before every view has looked, and miscounted rows."""
    model, optimizer = fitted(4)
    with torch.no_grad():
        model.splats["means"].copy_(torch.arange(4.0)[:, None].expand(4, 3))
    control = GradientDensification(Rows(model, optimizer), DensifyConfig(grad_threshold=1.0), 0.01, views=3)
    now_and_then, never = torch.tensor([True, False, True, True]), torch.tensor([True, False, False, True])

    def look(drawn: torch.Tensor, times: int) -> list[float]:
        for _ in range(times):
            control.accumulate(*drawn_with(torch.zeros(4, 2)[: len(model)], drawn), 10, 10, views=1)
        control.densify(torch.Generator(), has_reset=False, most=100)
        return model.splats["means"].detach()[:, 0].tolist()

    assert look(never, 4) == [0, 1, 2, 3]  # four views in a row may miss one of three
    assert look(now_and_then, 1) == [0, 2, 3]  # the fifth
    assert look(now_and_then[[0, 1, 3]], 4) == [0, 2, 3]
    assert look(now_and_then[[0, 1, 3]], 1) == [0, 3]


def test_counts_follow_the_rows_that_a_gate_kept() -> None:
    """Catches counts of views that stay where they were while the Gaussians move, and gradients of other Gaussians."""
    model, optimizer = fitted(4)
    control = GradientDensification(Rows(model, optimizer), DensifyConfig(), 0.01, views=3)
    for drawn in ([1, 0, 0, 0], [1, 1, 0, 1], [1, 0, 0, 1]):
        control.accumulate(*drawn_with(torch.ones(4, 2), torch.tensor(drawn)), 10, 10, views=1)
    assert control.unseen.tolist() == [0, 1, 3, 0]
    rows = torch.tensor([3, 2, 1])
    control.rows.select(rows)
    assert control.unseen.tolist() == [0, 3, 1]
    assert control.gradient.tolist() == control.times_visible.tolist() == [0, 0, 0]


def test_large_gaussians_are_pruned_only_when_asked() -> None:
    """Catches pruning by size before the first opacity reset."""
    model, optimizer = fitted(4)
    with torch.no_grad():
        model.splats["scales"].fill_(math.log(0.1))
        model.splats["scales"][0] = math.log(0.3)  # above 0.1 x extent 2
    control = GradientDensification(Rows(model, optimizer), DensifyConfig(), 0.01, views=3)
    control.densify(torch.Generator(), has_reset=False, most=100)
    assert len(model) == 4
    control.densify(torch.Generator(), has_reset=True, most=100)
    assert len(model) == 3


def test_opacity_reset_forgets_momentum() -> None:
    """Catches momentum that undoes the reset in the next steps, and a reset to below what is pruned."""
    model, optimizer = fitted(4)
    descend(model, optimizer, 0)
    control = GradientDensification(Rows(model, optimizer), DensifyConfig(), 0.01, views=3)
    control.reset_opacities()
    assert torch.sigmoid(model.splats["opacities"]).max().item() == pytest.approx(0.02)
    assert not optimizer.moments[model.splats["opacities"]]["exp_avg"].any()


def test_sparse_adam_is_adam_where_all_is_drawn_and_rests_elsewhere() -> None:
    """Catches a wrong bias correction or rate, and rows without a view that coast on or lose their moments."""
    dense_model, dense = fitted()
    sparse_model, sparse = fitted(kind="sparse_adam")
    for step in range(3):
        descend(dense_model, dense, step)
        descend(sparse_model, sparse, step)
    for a, b in zip(dense_model.splats.values(), sparse_model.splats.values(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-6)
    before = copy.deepcopy(sparse_model.state_dict())
    moments = copy.deepcopy(sparse.state_dict())
    drawn = torch.arange(len(sparse_model)) % 3 == 0
    descend(sparse_model, sparse, 3, drawn)
    after = sparse_model.state_dict()
    for name, value in before.items():
        moved = (after[name] != value).reshape(len(value), -1).any(1)
        torch.testing.assert_close(moved, drawn, msg=lambda text, name=name: f"{name}: {text}")
    for old, new in zip(moments.values(), sparse.state_dict().values(), strict=True):
        torch.testing.assert_close(new["exp_avg"][~drawn], old["exp_avg"][~drawn], rtol=0, atol=0)


@pytest.mark.parametrize("kind", ["adam", "sparse_adam"])
def test_a_bad_step_that_is_found_later_changes_nothing(kind: str) -> None:
    """Catches an update, or a count of it, where the finite check of a GPU has said that a gradient was not finite."""
    model, optimizer = fitted(kind=kind)
    descend(model, optimizer, 0)
    before, moments = copy.deepcopy(model.state_dict()), copy.deepcopy(optimizer.state_dict())
    optimizer.skip = torch.ones(())
    descend(model, optimizer, 1)
    for name, value in model.state_dict().items():
        torch.testing.assert_close(value, before[name], rtol=0, atol=0, msg=lambda text, name=name: f"{name}: {text}")
    for index, state in optimizer.state_dict().items():
        for name, value in state.items():
            torch.testing.assert_close(value, moments[index][name], rtol=0, atol=0)


@pytest.mark.skipif(not kernels.available(), reason="the native kernels are not built here")
@pytest.mark.parametrize("shape", [(0, 3), (1,), (700, 1, 3), (1000, 28)])
def test_kernel_and_torch_make_the_same_update(shape: tuple[int, ...]) -> None:
    """Catches a run of rows that ends wrong, a row updated twice, and bits that depend on the number of threads."""
    random = torch.Generator().manual_seed(0)
    g, p, m = (torch.randn(shape, generator=random) for _ in range(3))
    v, drawn = torch.rand(shape, generator=random), torch.rand(shape[0], generator=random) < 0.7
    rule = drawn, 0.01, [0.9, 0.999], 1e-15, torch.tensor(5.0)
    expected = p.clone(), m.clone(), v.clone()
    adam_reference(expected[0], g, expected[1], expected[2], *rule)
    out = []
    threads = torch.get_num_threads()
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            out.append((p.clone(), m.clone(), v.clone()))
            adam(out[-1][0], g, out[-1][1], out[-1][2], *rule)
    finally:
        torch.set_num_threads(threads)
    for one, two, reference in zip(*out, expected, strict=True):
        torch.testing.assert_close(one, reference, rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(one, two, rtol=0, atol=0)


@pytest.mark.skipif(not kernels.available(), reason="the native kernels are not built here")
def test_all_parameters_in_one_call_are_updated_as_torch_does() -> None:
    """Catches a parameter that is left out or updated twice, another's rate or step, and a 33rd that is forgotten."""
    random = torch.Generator().manual_seed(0)
    shapes = [(), (0, 3), (1,), (700, 1, 3), (60_000, 2), *[(i + 1,) for i in range(MAX_ADAM)]]
    rates = [0.001 * (i + 1) for i in range(len(shapes))]
    start = [torch.randn(shape, generator=random) for shape in shapes]
    gradients = [[torch.randn(shape, generator=random) for shape in shapes] for _ in range(3)]
    expected = [x.clone().requires_grad_() for x in start]
    groups = [{"params": [x], "lr": rate} for x, rate in zip(expected, rates, strict=True)]
    reference = torch.optim.Adam(groups, eps=1e-15)
    for given in gradients:
        for x, g in zip(expected, given, strict=True):
            x.grad = g.clone()
        reference.step()
    out = []
    threads = torch.get_num_threads()
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            x, m, v = ([y.clone() for y in start], *([torch.zeros_like(y) for y in start] for _ in range(2)))
            for step, given in enumerate(gradients):
                steps = [torch.tensor(step + 1.0)] * len(x)
                adam_all(x, given, m, v, steps, rates, [0.9, 0.999], 1e-15)
            out.append(x)
    finally:
        torch.set_num_threads(threads)
    for one, two, other in zip(*out, expected, strict=True):
        torch.testing.assert_close(one, other.detach(), rtol=1e-5, atol=1e-6)
        assert torch.equal(one, two)


def test_all_parameters_must_fit() -> None:
    """Catches a gradient of another size or type, and a parameter with gaps, whose address reaches the kernel."""
    x = [torch.zeros(4, 2)]
    rest = [torch.ones(())], [0.1], [0.9, 0.999], 1e-15
    with pytest.raises(InputError, match=r"expected gradient as contiguous float32 of shape \[4, 2\] on the CPU, got"):
        adam_all(x, [torch.zeros(4, 3)], x, x, *rest)
    with pytest.raises(InputError, match="expected mean as contiguous float32"):
        adam_all(x, x, [torch.zeros(4, 2, dtype=torch.float64)], x, *rest)
    with pytest.raises(InputError, match="expected parameter as contiguous float32"):
        adam_all([torch.zeros(2, 4).T], x, x, x, *rest)


def test_adam_refuses_what_does_not_fit() -> None:
    """Catches a mask or an array of another size or type that reaches the kernel."""
    x = torch.zeros(4, 2)
    rule = 0.01, [0.9, 0.999], 1e-15, torch.tensor(1.0)
    with pytest.raises(InputError, match=r"expected drawn of shape \[4\]"):
        adam(x.clone(), x, x.clone(), x.clone(), torch.ones(3, dtype=torch.bool), *rule)
    with pytest.raises(InputError, match=r"expected gradient of shape \[4, 2\], got \[4, 3\]"):
        adam(x.clone(), torch.zeros(4, 3), x.clone(), x.clone(), torch.ones(4, dtype=torch.bool), *rule)

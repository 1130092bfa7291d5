"""Learning rates, and Adam's moments when Gaussians come and go."""

import copy

import pytest
import torch

from gsbench.config import LearningRate, ModelConfig, TrainConfig
from gsbench.errors import InputError
from gsbench.models import GaussianModel, build
from gsbench.scenes.points import random_points
from gsbench.train.optim import Optimizer, rate_at

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
    loss.backward()
    optimizer.begin(step)
    optimizer.update(torch.ones(len(model), dtype=torch.bool) if drawn is None else drawn)
    optimizer.end()


PER_EXTENT, PER_RUN = LearningRate(1.6e-4, 1.6e-6, per_extent=True), LearningRate(1e-3, 1e-5, per_run=True)


@pytest.mark.parametrize(
    ("rate", "step", "iterations", "expected"),
    [
        (PER_EXTENT, 0, 100, 8e-4),
        (PER_EXTENT, 50, 100, 8e-5),  # half way, the geometric mean
        (PER_EXTENT, 100, 100, 8e-6),
        (LearningRate(0.05), 70, 100, 0.05),
        (LearningRate(0.05, per_extent=True), 70, 100, 0.25),  # constant, but in units of the scene
        (LearningRate(0.0), 70, 100, 0.0),
        (PER_RUN, 0, 300, 1e-2),  # times 10, the root of 30,000 / 300
        (PER_RUN, 300, 300, 1e-4),
        (PER_RUN, 0, 30_000, 1e-3),
        (LearningRate(1e-3, per_run=True), 0, 300, 1e-2),
        (LearningRate(1e-3), 0, 300, 1e-3),
        (LearningRate(1e-2, 1e-4, until=15_000), 50, 200, 1e-3),  # of 30,000: half way, and then at its end
        (LearningRate(1e-2, 1e-4, until=15_000), 100, 200, 1e-4),
        (LearningRate(1e-2, 1e-4, until=15_000), 170, 200, 1e-4),
    ],
)
def test_a_rate_falls_log_linearly(rate, step, iterations, expected):
    """Catches a linear decay, and a factor of the scene or the run's length
    that is left out or applied where it was not asked for."""
    assert rate_at(rate, step, TrainConfig(iterations=iterations), 5) == pytest.approx(expected)


def test_all_rates_fall_to_a_tenth_in_a_cooldown():
    """Catches a cooldown that begins at a step of this run, forgets constant rates or ends elsewhere."""
    train = TrainConfig(iterations=100, recipe_iterations=1000, cooldown_from=800)
    for rate in (LearningRate(0.05), LearningRate(1.6e-4, 1.6e-6)):
        plain = [rate_at(rate, step, TrainConfig(iterations=100, recipe_iterations=1000), 5) for step in range(101)]
        cooled = [rate_at(rate, step, train, 5) for step in range(101)]
        assert cooled[:81] == plain[:81]
        assert cooled[90] / plain[90] == pytest.approx(0.55)
        assert cooled[100] / plain[100] == pytest.approx(0.1)


def test_rates_and_parameters_must_match():
    """Catches a parameter that silently never learns, and a misspelt rate that silently does nothing."""
    with pytest.raises(InputError, match="'quats' has none"):
        fitted(rates={n: r for n, r in RATES.items() if n != "quats"})
    with pytest.raises(InputError, match=r"no 'sacles'.*Did you mean 'scales'"):
        fitted(rates={**RATES, "sacles": LearningRate(1.0)})


@pytest.mark.parametrize("kind", ["adam", "sparse_adam"])
def test_what_a_step_leaves_alone(kind):
    """Catches rows without a view that coast on or lose their moments, a wrong bias correction or rate of sparse Adam,
    and an update, or a count of it, where the finite check of a GPU has said that a gradient was not finite."""
    (plain, adam), (model, optimizer) = fitted(), fitted(kind=kind)
    for step in range(3):
        descend(plain, adam, step)
        descend(model, optimizer, step)
    for a, b in zip(plain.splats.values(), model.splats.values(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-6)
    drawn = torch.arange(len(model)) % 3 == 0
    for is_skipped in (True, False):
        before, moments = copy.deepcopy(model.state_dict()), copy.deepcopy(optimizer.state_dict())
        optimizer.skip = torch.ones(()) if is_skipped else None
        descend(model, optimizer, 3, drawn)
        moves = torch.zeros_like(drawn) if is_skipped else drawn | (kind == "adam")
        for name, value in model.state_dict().items():
            assert (before[name] != value).reshape(len(value), -1).any(1).tolist() == moves.tolist(), name
        for index, state in optimizer.state_dict().items():
            rests = slice(None) if is_skipped else ~moves
            assert torch.equal(state["exp_avg"][rests], moments[index]["exp_avg"][rests])
            assert not is_skipped or all(torch.equal(x, moments[index][key]) for key, x in state.items())

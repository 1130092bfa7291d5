"""The motion regulariser by hand, its gradient, its random numbers and neighbours, and how it is refused."""

import math
from typing import Any

import pytest
import torch
from interrupted import assert_same_bits
from models.small import seeded
from tiny_training import trainer

from gsbench.errors import InputError
from gsbench.models import CameraTime, GaussianModel, build
from gsbench.models.freetime import FreeTimeModel
from gsbench.scenes.scene import Camera, Points, View
from gsbench.schedule import ActiveComponents
from gsbench.train import regularisers
from gsbench.train.hooks.penalties import Penalties
from gsbench.train.regularisers import LEAST_DISTANCE, Strain

FRAMES = 7
QUERY = CameraTime.at(torch.tensor([0.0, 0.0, -4.0], dtype=torch.float64), 0.5)
VIEWMAT = torch.eye(4, dtype=torch.float64)
VIEWMAT[2, 3] = 4.0
VIEW = View("of QUERY", Camera(VIEWMAT, torch.eye(3, dtype=torch.float64), 16, 16), 0.5, torch.zeros(16, 16, 3))
TIMED: dict[str, dict[str, Any]] = {
    "4dgs": {},
    "7dgs": {"lambda_t": 0.5, "lambda_d": 0.3},
    "7dgs_nodir": {"lambda_t": 0.5},
    "dgs": {},
    "freetime": {},
}
WEIGHT = ("train.penalties.strain.weight=1.0", "train.batch_size=2")


def moving(positions: torch.Tensor, velocities: torch.Tensor) -> FreeTimeModel:
    """Gaussians that are at `positions` at time 1/2, all with the opacity factor 1 then, and move."""
    model = FreeTimeModel(duration=0.1)
    model.initialise(Points(positions.float(), positions.float()), 2.0, seeded(0))
    model.double()
    for name, value in (("means", positions), ("velocities", velocities), ("times", torch.full_like(positions, 0.5))):
        model.splats[name].data = value[:, : model.splats[name].shape[1]].clone()
    return model


def prepared(model: GaussianModel, step: int = 0, seed: int = 0) -> Strain:
    penalty = Strain(model, seed, FRAMES)
    penalty.prepare(step, VIEW)
    return penalty


def grid(count: int = 12) -> torch.Tensor:
    return torch.rand(count, 3, generator=seeded(1), dtype=torch.float64) * 2 - 1


def test_only_a_translation_has_no_strain():
    """Catches a penalty of motion itself, which holds a moving object still, or one that a rotation escapes."""
    x = grid()
    turn = torch.stack([-x[:, 1], x[:, 0], torch.zeros_like(x[:, 0])], -1)
    for velocities, is_strained in ((torch.tensor([[0.3, -0.2, 0.9]]).double().expand_as(x), False), (turn, True)):
        strain = float(prepared(moving(x, velocities))(QUERY, 0).detach())
        assert strain > 0.1 if is_strained else strain < 1e-25


def test_two_points_by_hand(monkeypatch):
    """Catches a missing factor: of the time step, the frames, the distance, the weight, or the number of pairs."""
    monkeypatch.setattr(regularisers, "NEIGHBOURS", 1)
    x = torch.tensor([[0.0, 0, 0], [0.5, 0, 0], [10, 0, 0], [10.5, 0, 0]], dtype=torch.float64)
    v = torch.tensor([[0.0, 0.2, 0], [0, -0.1, 0], [1, 1, 1], [1, 1, 1]], dtype=torch.float64)
    model = moving(x, v)
    model.splats["times"].data[0] -= 0.1  # one standard deviation of its opacity
    model.splats["means"].data[0] -= 0.1 * v[0]  # and yet in its place at t0
    weight = math.sqrt(math.exp(-0.5))
    expected = 2 * weight * 0.3**2 / (0.5**2 + (LEAST_DISTANCE * model.extent) ** 2) / 4
    for index in range(3):
        torch.testing.assert_close(float(prepared(model)(QUERY, index).detach()), expected)


def lively(name: str, agr: bool, noise: float = 0.05) -> GaussianModel:
    """A model in mid-training, all of whose Gaussians can be seen, in float64."""
    model, points, g = build(name, agr=agr, **TIMED[name]), grid(14).float(), seeded(2)
    model.initialise(Points(points, points), 2.0, seeded(0))
    model.double()
    for parameter in model.parameters():
        parameter.data += noise * torch.randn(parameter.shape, generator=g, dtype=torch.float64)
    model.splats["times"].data.fill_(0.1 if name == "dgs" else 0.55)
    model.set_active(ActiveComponents(3, agr, True))
    return model


# dGS with AGR is left out: no gradient flows through its direction, which AGR changes.
@pytest.mark.parametrize(
    ("name", "agr"), [(name, agr) for name in TIMED for agr in (False, True) if (name, agr) != ("dgs", True)]
)
def test_the_gradient_is_that_of_the_velocities(name, agr):
    """Catches a gradient that is lost on its way through a model, or that flows through weights or distances."""
    model = lively(name, agr)
    penalty, asked = prepared(model), []
    real = penalty._visible_means
    penalty._visible_means = lambda query: asked.append(query) or real(query)
    value = penalty(QUERY, 1)
    value.backward()
    neighbours, (now, later) = penalty.neighbours, asked
    assert sorted(penalty.rows.tolist()) == list(range(len(model)))
    pairs = neighbours.long()
    means, visible = real(now)
    distances = (means[:, None] - means[pairs]).square().sum(-1) + (LEAST_DISTANCE * model.extent) ** 2
    factors = ((visible[:, None] * visible[pairs]).sqrt() / distances / pairs.numel()).detach()

    def expected() -> torch.Tensor:
        velocities = (real(later)[0] - real(now)[0]) / (later.time - now.time)
        return (factors * (velocities[:, None] - velocities[pairs]).square().sum(-1)).sum().detach()

    torch.testing.assert_close(value.detach(), expected())
    learns = {key: x for key, x in model.named_parameters() if x.grad is not None and x.grad.any()}
    assert any("refinement" in key for key in learns) == agr
    assert "splats.opacities" not in learns
    for x in learns.values():
        step, ends = 1e-8 * torch.randn(x.shape, generator=seeded(3)).double(), []
        for sign in (1, -1):
            x.data += sign * step
            ends.append(expected())
            x.data -= sign * step
        torch.testing.assert_close((ends[0] - ends[1]) / 2, (x.grad * step).sum(), rtol=1e-4, atol=1e-14)


def test_what_is_culled_later_does_not_count():
    """Catches the jump of a mean that is culled at t1, and so stays at mu_p, taken for a very large velocity."""
    model = lively("7dgs_nodir", agr=False, noise=0.0)
    splats = {name: x.data for name, x in model.splats.items()}
    splats["times"].fill_(0.5)
    splats["times"][:3] -= 5e-5
    splats["log_diagonal"][:3, model.rows["t"]] = math.log(1e-4)
    splats["motion"][:3] = 1.0  # at t0, the mean is half a unit from mu_p
    penalty = prepared(model)
    later = CameraTime(QUERY.center, QUERY.time + 0.1 / FRAMES)
    assert penalty._visible_means(QUERY)[1].min() > 0.5
    assert penalty._visible_means(later)[1][:3].max() == 0
    assert (penalty._visible_means(later)[0] - penalty._visible_means(QUERY)[0])[:3].abs().min() > 0.4
    value = penalty(QUERY, 0)
    value.backward()
    assert value == 0
    assert all(x.grad is None or not x.grad.any() for x in model.splats.values())


def test_draws_are_of_the_seed_the_step_and_the_view():
    """Catches draws from a generator that threads share, and the same draw for all views."""
    model = lively("freetime", True)
    values = [
        float(prepared(model, step, seed)(QUERY, index).detach())
        for seed, step, index in ((0, 0, 0), (0, 0, 1), (0, 1, 0), (1, 0, 0), (0, 0, 0))
    ]
    assert values[0] == values[4]
    assert len(set(values)) == 4


def test_neighbours_are_searched_again():
    """Catches neighbours of rows that have moved to other indices, and ones that are never or always searched."""
    fitted = trainer("freetime", *WEIGHT)
    (penalty,), view = fitted.hook(Penalties).active.values(), fitted.scene.train[0]
    penalty.prepare(5, view)
    first = penalty.neighbours
    itself = torch.arange(len(first))[:, None]
    assert not (first == itself).any()
    distances = torch.cdist(fitted.model.splats["means"].double(), fitted.model.splats["means"].double()).detach()
    torch.testing.assert_close(distances.gather(1, first.long()), distances.sort().values[:, 1:9])
    penalty.prepare(104, view)
    assert penalty.neighbours is first
    fitted.rows.select(torch.arange(len(first)).flip(0))
    penalty.prepare(104, view)
    assert torch.equal(penalty.neighbours.flip(0), len(first) - 1 - first)
    second = penalty.neighbours
    penalty.prepare(204, view)
    assert penalty.neighbours is not second


@pytest.mark.parametrize("place", ["few", "same"])
def test_neighbours_at_the_edge(place):
    """Catches an index beyond the Gaussians where there are too few, and a Gaussian that is its own neighbour."""
    x = grid(8) if place == "few" else torch.zeros(30, 3, dtype=torch.float64)
    penalty = prepared(moving(x, grid(len(x))))
    assert not (penalty.neighbours == torch.arange(len(x))[:, None]).any()
    assert penalty(QUERY, 0).detach() >= 0
    assert (len(penalty.rows) == 0) == (place == "few")


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("name", ["7dgs", "4dgs", "dgs"])
def test_any_number_of_threads_gives_the_same_bits(name):
    """Catches draws that depend on the order of threads, gradients that threads add in any order, and no penalty."""
    ends = []
    for count, words in ((1, WEIGHT), (2, WEIGHT), (1, ())):
        torch.set_num_threads(count)
        fitted = trainer(name, *words, "train.refine_from=0", "train.batch_size=3")
        for fitted.step in range(6):
            fitted.train_step()
        ends.append({"loss": fitted.finite_check.loss, **fitted.model.state_dict()})
    assert_same_bits(*ends[:2])
    assert ends[2]["loss"] != ends[0]["loss"]


def test_damaged_neighbours_are_refused():
    """Catches an index beyond the Gaussians that a checkpoint brings, and one that forgets when they were searched."""
    fitted = trainer("7dgs", *WEIGHT)
    fitted.step = 7
    fitted.train_step()
    state = fitted.state_dict()
    assert state["hooks"]["penalties"]["strain"]["searched"] == 7
    state["hooks"]["penalties"]["strain"]["neighbours"][0, 0] = len(fitted.model)
    with pytest.raises(InputError, match="neighbours"):
        trainer("7dgs", *WEIGHT).load_state_dict(state)

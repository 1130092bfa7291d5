"""The mean of parameters over the last steps: which steps are in it, when it starts anew, and when it is kept."""

import copy

import pytest
import torch
from torch import nn

from gsbench.errors import InputError
from gsbench.train.averaging import NO_AVERAGE, Average


class Model(nn.Module):
    """Two parameters, which count steps."""

    def __init__(self) -> None:
        super().__init__()
        self.a, self.b = nn.Parameter(torch.zeros(3)), nn.Parameter(torch.zeros(()))

    def __len__(self) -> int:
        return 3


def trained(start: int | None, steps: int = 100) -> tuple[Model, Average]:
    model = Model()
    average = Average(model, start)  # type: ignore[arg-type]
    for step in range(steps):
        with torch.no_grad():
            model.a.fill_(step)
            model.b.fill_(-step)
        average.add(step)
    return model, average


def take(model: Model, average: Average) -> float:
    """Make the means the parameters; as a PSNR, they score higher by how much smaller `a` is."""
    last = -float(model.a.detach()[0])
    return average.keep_better(last, lambda: -float(model.a.detach()[0]), 100) - last


def test_it_is_the_mean_of_every_tenth_step_from_its_start() -> None:
    """Catches a mean of all steps, one that starts a step late, and a parameter that is left out."""
    model, average = trained(50)
    assert take(model, average) == pytest.approx(29.0)
    assert model.a.tolist() == pytest.approx([70.0] * 3)  # of 50, 60, 70, 80, 90
    assert float(model.b.detach()) == pytest.approx(-70.0)
    assert (average.kept, average.count) == (50, 0)
    assert take(model, average) == 0.0  # once
    assert float(model.b.detach()) == pytest.approx(-70.0)


@pytest.mark.parametrize("gain", [-1.0, 0.0, float("nan")])
def test_the_last_parameters_stay_where_the_mean_is_no_better(gain: float) -> None:
    """Catches a mean that replaces better parameters, and last parameters that are not put back."""
    model, average = trained(50)
    assert average.keep_better(30.0, lambda: 30.0 + gain, 100) == 30.0
    assert model.a.tolist() == [99.0] * 3
    assert float(model.b.detach()) == -99.0
    assert (average.kept, average.count) == (0, 0)


def test_without_a_start_nothing_changes() -> None:
    """Catches an option that is on for everybody."""
    model, average = trained(None)
    take(model, average)
    assert model.a.tolist() == [99.0] * 3


def test_it_starts_anew_when_gaussians_change() -> None:
    """Catches means of rows that are others now."""
    model, average = trained(50, steps=75)
    average.follow(torch.arange(3), torch.zeros(3, dtype=torch.bool))
    for step in (80, 90):
        with torch.no_grad():
            model.a.fill_(step)
        average.add(step)
    take(model, average)
    assert model.a.tolist() == pytest.approx([85.0] * 3)
    assert average.kept == 20  # iterations: the parameters of steps 80 to 99 have had a part in the mean


def test_a_checkpoint_has_it() -> None:
    """Catches a resumed training whose mean lacks the steps before, and state of another model."""
    whole, average = trained(50)
    part, other = trained(50, steps=65)
    state = copy.deepcopy(other.state_dict())
    resumed = Average(part, 50)  # type: ignore[arg-type]
    resumed.load_state_dict(state)
    for step in range(65, 100):
        with torch.no_grad():
            part.a.fill_(step)
            part.b.fill_(-step)
        resumed.add(step)
    take(whole, average)
    take(part, resumed)
    assert torch.equal(whole.a, part.a)
    assert (average.kept, resumed.kept) == (50, 50)
    resumed.load_state_dict(average.state_dict())
    assert resumed.kept == 50  # so that the record of a finished training, measured later, says the same
    resumed.load_state_dict(NO_AVERAGE)
    more, other_size = state | {"2": torch.zeros(3)}, state | {"0": torch.zeros(4)}
    numbers = ({"count": 1}, {"count": -1}, {"count": 0, "kept": "all"}, {"count": 0, "first": -1})
    for wrong in (*numbers, more, other_size):
        with pytest.raises(InputError):
            resumed.load_state_dict(wrong)

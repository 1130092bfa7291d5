"""A training step by the CUDA kernels: what Python asks of a GPU, and steps that are repeated in place of launched."""

import copy
import math
from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes

from gsbench.kernels import recording
from gsbench.kernels.library import CudaLibrary
from gsbench.train.divergence import LOOK_EVERY, DivergedError

_aten = torch.ops.aten
WITHOUT_LAUNCH = {
    _aten.empty.memory_format,
    _aten.empty_strided.default,
    _aten.empty_like.default,
    _aten.new_empty.default,
    _aten.detach.default,
}


class Calls(TorchDispatchMode):
    """Counts the torch operations that launch something on a GPU: all but views and allocations."""

    def __init__(self) -> None:
        super().__init__()
        self.counted: Counter[str] = Counter()

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if not operation.is_view and operation not in WITHOUT_LAUNCH:
            self.counted[str(operation)] += 1
        return operation(*args, **(kwargs or {}))


def graph_of(calls: list[Callable[[], object]]) -> Callable[[], None]:
    """The shim's graph: one call, whose own calls are not counted."""

    def play() -> None:
        with _disable_current_modes():
            for call in calls:
                call()

    return play


Training = Any  # a Trainer, whose module needs hydra
Start = Callable[..., Training]


@pytest.fixture
def start(cuda_device: str, monkeypatch: pytest.MonkeyPatch) -> Start:
    """Makes a small training by the CUDA kernels: on a GPU, or by the shim with all that a training on a GPU does."""
    pytest.importorskip("hydra", reason="needs hydra, which composes the settings of a training")
    from tiny_training import trainer

    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)  # the shim runs one kernel at a time
    for devices in ("REPEATED_ON", "TOGETHER_ON"):
        monkeypatch.setattr(f"gsbench.train.step.{devices}", ("cpu", "cuda"))
    if cuda_device == "cpu":  # the shim's graph is a list of calls
        monkeypatch.setattr("gsbench.train.step_replay.GRAPHED_ON", ("cpu",))
        monkeypatch.setattr(recording, "graph_of", graph_of)

    def make(model: str, *options: str, **arguments: Any) -> Training:
        fitted = trainer(model, "train.batch_size=4", f"device={cuda_device}", *options, **arguments)
        fitted.finite_check.every = LOOK_EVERY
        return fitted

    return make


def assert_equal_ends(trainings: list[Training]) -> None:
    """Compare by bits, or on a GPU, where the order of sums varies, by the loss."""
    from interrupted import assert_same_bits, without_times

    states = [without_times(fitted.state_dict()) for fitted in trainings]
    if trainings[0].config.device == "cpu":
        assert_same_bits(*states)
    assert trainings[0].loss == pytest.approx(trainings[1].loss, rel=1e-2)


def launched(fitted: Training) -> Training:
    fitted.gradients._signature = lambda *_: None
    return fitted


@pytest.mark.parametrize(
    ("model", "options", "kernels", "operations", "repeated"),
    [
        ("4dgs", (), 11, 34, 20),
        ("4dgs", ("optim=sparse_adam",), 11, 36, 20),
        ("7dgs_noagr", (), 11, 29, 17),
        ("7dgs", (), 13, 38, 17),
    ],
)
def test_calls_of_a_step(model, options, kernels, operations, repeated, start, monkeypatch):
    """Catches a change after which a step of four views launches more, or a repeated one more outside of its graphs:
    each call takes a GPU at least two microseconds, and Python five; and a value that the CPU waits for."""
    called, call = Counter[str](), CudaLibrary.call

    def count(library: CudaLibrary, name: str, *arguments: Any) -> None:
        called[name] += 1
        call(library, name, *arguments)

    monkeypatch.setattr(CudaLibrary, "call", count)
    for is_repeated in (False, True):
        fitted = start(model, *options) if is_repeated else launched(start(model, *options))
        fitted.step, fitted.schedule.densify_stop = 90, 100  # when all parts of a model learn
        for _ in range(4):
            fitted.train_step()
        fitted.step = 91
        called.clear()
        with Calls() as calls:
            fitted.train_step()
        assert fitted.gradients.replay.counts["replayed"] == 3 * is_repeated
        assert called.total() <= (0 if is_repeated else kernels), called
        assert calls.counted.total() <= (repeated if is_repeated else operations), calls.counted
        assert not [name for name in calls.counted if "local_scalar" in name or "nonzero" in name]


# The SH degree rises after steps 3, 6 and 9, AGR starts at 10, Gaussians are densified and sorted after 12, their
# opacities reset after 14, and lambda learns from 15.
EVENTS = ("train.densify.every=12", "train.lambda_from=4500", "train.curve_points=1")


@pytest.mark.parametrize(
    ("model", "steps"),
    [
        ("7dgs", 18),
        *[pytest.param(model, 60, marks=pytest.mark.slow) for model in ("3dgs", "4dgs", "6dgs", "7dgs_noagr", "7dgs")],
    ],
)
def test_repeated_steps_train_as_launched_ones(model, steps, start, repeats):
    """Catches work of a step that a repetition does not do again, or with an address, a count of Gaussians or a part
    of the model from before an event. The shim adds in a fixed order, so all bits are equal."""
    from tiny_training import train

    trainings = []
    for fitted in (start(model, *EVENTS), launched(start(model, *EVENTS))):
        fitted.schedule.resets_after = range(14, 15)
        counts = repeats["done"]
        trainings.append(train(fitted, until=steps))
        assert (repeats["done"] - counts > 4 * steps // 4) == (fitted is trainings[0])
    steps_of = [fitted.gradients.replay.counts for fitted in trainings]
    assert steps_of[1] == {"launched": steps, "replayed": 0, "recordings": 0}
    assert steps_of[0]["launched"] + steps_of[0]["replayed"] == steps
    assert 0 < steps_of[0]["recordings"] < steps_of[0]["launched"]
    assert_equal_ends(trainings)


def test_more_intersections_than_there_is_room_for(start, repeats, monkeypatch):
    """Catches lists of tiles that write beyond their memory, which was allocated for the view that was recorded, a step
    that learns from images without some of their intersections, or is not done again, and what earlier changed then."""
    from tiny_training import near_and_far, train

    monkeypatch.setattr("gsbench.kernels.raster.ROOM", 1.0)
    trainings, steps = [], 36  # the last of these steps is an event
    for end in (lambda fitted: fitted, launched):
        fitted = end(start("3dgs", "train.batch_size=2", *EVENTS, scene=near_and_far()))
        trainings.append(train(fitted, until=steps))
    assert repeats["done"] > 0
    assert trainings[0].done_again is not None
    counts = trainings[0].gradients.replay.counts
    assert counts["launched"] + counts["replayed"] == steps
    assert_equal_ends(trainings)


def test_a_bad_step_changes_nothing_until_it_is_looked_at(start, repeats):
    """Catches repeated steps after a bad gradient that move a parameter, a moment, a count of updates or the
    statistics of density control, and another step or parameter that is blamed when the CPU looks."""
    fitted = start("4dgs")
    real, before = fitted.gradients, None

    def states() -> list[Tensor]:
        moments = [x for each in fitted.optimizer.state_dict().values() for x in each.values()]
        return [*fitted.model.state_dict().values(), *moments, *fitted.density.rule.state_dict().values()]

    def poisoned(*arguments: Any) -> Any:
        results = real(*arguments)
        if fitted.step == 5:
            fitted.model.splats["left_quats"].grad[-1, -1] = math.inf
        return results

    fitted.gradients = poisoned
    for fitted.step in range(9):
        if fitted.step == 5:
            before = copy.deepcopy(states())
        fitted.train_step()
    assert before is not None
    assert repeats["done"] > 0
    assert all(map(torch.equal, before, states()))
    with pytest.raises(DivergedError, match="step 5: the gradient of 'left_quats' is not finite"):
        fitted.state_dict()


def test_a_value_that_is_not_finite_is_found_in_a_repetition(start, repeats):
    """Catches a training that goes on with NaN, as no check was repeated, and an error without the first bad step."""
    fitted = start("7dgs")

    def goes_on() -> bool:
        if fitted.step == 7:
            assert repeats["done"] > 0
            with torch.no_grad():
                fitted.model.splats["means"][0, 0] = math.nan
        return True

    with pytest.raises(DivergedError, match=r"step 7: .*means"):
        fitted.run(lambda _: None, "square", goes_on)

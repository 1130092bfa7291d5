"""What holds for every model whose field moves Gaussians: its warm-up, its checkpoints, its bits and its rows."""

from typing import Any

import pytest
import torch
from interrupted import assert_resumes, assert_same_bits, without_times
from small import fresh, raw, same, seeded
from tiny_training import train, trainer
from torch import Tensor

from gsbench.models import GaussianModel
from gsbench.models.render import render
from gsbench.models.scgs import Nodes

SHORT = "train.iterations=40"
FIELDS = pytest.mark.parametrize("name", ["deformable", "hexplane", "scgs"])


def shared(model: GaussianModel) -> dict[str, Tensor]:
    """All of a model but its Gaussians: weights and what else the field has."""
    return {name: x.clone() for name, x in model.state_dict().items() if not name.startswith("splats.")}


@pytest.mark.parametrize(
    ("name", "steps", "first"), [("deformable", 40, 4), ("hexplane", 46, 7), ("scgs", 40, 6)]
)  # of 40,000, 23,000 and 80,000 steps the first after a warm-up of 3,000, 3,000 and 10,000
def test_the_field_waits_for_the_end_of_the_warm_up(name, steps, first):
    """Catches a field that acts, learns or is penalised in the warm-up, or never, and a warm-up of another share; nodes
    that stay at the initial points, or that are placed again later."""
    fitted = trainer(name, f"train.iterations={steps}")
    model: Any = fitted.model
    before = shared(model)

    def stands_still() -> bool:
        camera = fitted.scene.train[0].camera
        return torch.equal(*(render(model, camera, time, torch.zeros(3)) for time in (0.1, 0.9)))

    train(fitted, until=first - 1)
    assert model.active.warms_up
    assert same(before, shared(model))
    assert stands_still()
    placed = Nodes(16)
    placed.place(model.splats["means"].detach())
    train(fitted, until=first)
    assert not model.active.warms_up
    assert not stands_still()
    after = shared(model)
    box = {"planes.low", "planes.high"} & before.keys()
    assert {key for key, x in before.items() if torch.equal(x, after[key])} == box
    if name == "scgs":
        torch.testing.assert_close(after["nodes.positions"], placed.positions.detach(), rtol=0, atol=1e-2)
        train(fitted, until=20)
        torch.testing.assert_close(model.nodes.positions.detach(), after["nodes.positions"], rtol=0, atol=0.05)


@pytest.mark.parametrize(("name", "step"), [("deformable", 20), ("hexplane", 20), ("scgs", 5), ("scgs", 20)])
def test_a_training_goes_on_from_its_checkpoint(name, step):
    """Catches nodes, weights, moments or a box that a checkpoint lacks, and nodes that are placed twice or never."""
    whole, _ = assert_resumes(lambda: trainer(name, SHORT), step)
    loaded = trainer(name, "seed=1", SHORT)
    if name == "hexplane":
        loaded.model.planes.high += 1  # type: ignore[operator, union-attr]
    loaded.load_state_dict(whole.state_dict())
    view = whole.scene.train[3]
    assert torch.equal(whole.render(view), loaded.render(view))


@FIELDS
def test_clones_and_children_are_canonical_and_share_the_field(name):
    """Catches children of the deformed Gaussian, which move twice, rows of the field, and a child's new features."""
    model, plain = fresh(name, 40), fresh("3dgs", 40)
    features = model.splats["features"].data if name == "scgs" else torch.zeros(40, 0)
    features += torch.rand(features.shape, generator=seeded(0))
    before, rows = shared(model), torch.arange(40).repeat_interleave(2)
    expected = features[rows]
    for each in (model, plain):
        each.select(rows)
        each.split_rows(torch.arange(80), seeded(1))
    after = raw(model)
    assert torch.equal(after.pop("features", expected), expected)
    assert same(after, raw(plain))
    assert same(before, shared(model))


@pytest.mark.usefixtures("threads")
@FIELDS
def test_a_field_trains_to_the_same_bits_for_any_number_of_threads(name, monkeypatch):
    """Catches a repetition of a recorded step, or a penalty, that uses all threads, only felt with one view."""
    monkeypatch.setattr("gsbench.train.step.WORTH_A_THREAD", 0)
    ends = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        ends.append(without_times(train(trainer(name, "train.batch_size=1")).state_dict()))
    assert_same_bits(*ends)

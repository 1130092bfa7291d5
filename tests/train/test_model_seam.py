"""What a model brings to a training of its own: a network, a penalty, a static first stage, and points with times."""

from dataclasses import replace
from typing import Any, ClassVar

import torch
from interrupted import assert_resumes
from tiny_training import compose, moving_square, train
from torch import Tensor, nn

from gsbench.config import LearningRate
from gsbench.models import CameraTime
from gsbench.models.base import Raw
from gsbench.models.gaussian_batch import Conditioned
from gsbench.models.gaussians3d import Gaussians3DModel
from gsbench.scenes import Points
from gsbench.train.batches import generator
from gsbench.train.loop import Trainer


class Deformed(Gaussians3DModel):
    """3DGS whose means a network moves over time, except in its warm-up."""

    observes: ClassVar[tuple[str, ...]] = ("time",)
    warm_up = 0.3

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.field = nn.Linear(1, 3)
        self.started_at: Tensor | None = None
        nn.init.zeros_(self.field.weight)
        nn.init.zeros_(self.field.bias)

    def groups(self) -> dict[str, list[nn.Parameter]]:
        return super().groups() | {"field": list(self.field.parameters())}

    def penalty(self) -> Tensor:
        return 0.5 * (self.field.weight.square().sum() - self.field.bias[0])

    def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
        self.started_at = points.times
        return super().initial_geometry(points, distances, generator)

    def condition(self, raw: Raw, query: CameraTime) -> Conditioned:
        time = torch.as_tensor(query.time).reshape(1)
        moved = raw if self.active.warms_up else raw | {"means": raw["means"] + self.field(time)}
        return self.static(moved)


def deformed(*words: str) -> Trainer:
    config = compose("3dgs", 100, "effects.gate=off", *words)
    config.model.lr["field"] = LearningRate(1e-2)
    model, square = Deformed(), moving_square()
    points = replace(square.points, times=torch.linspace(0, 1, len(square.points.means)))
    model.initialise(points, square.extent, generator(0))
    return Trainer(model, replace(square, val=square.train[:3]), square.train[3:5], config)


def test_a_model_brings_a_network_a_penalty_a_warm_up_and_points_with_times():
    """Catches a network that never learns or that a checkpoint lacks, a penalty without effect, and no warm-up."""
    start = deformed()
    model: Any = start.model
    assert model.started_at.shape == (len(model),)
    train(start, until=30)
    assert model.active.warms_up
    assert not model.field.weight.any(), "the penalty alone has no gradient by a weight of zero"
    assert model.field.bias[0] > 0.1, "the penalty has a gradient in the warm-up"
    model = assert_resumes(deformed, 30)[0].model
    assert not model.active.warms_up
    assert model.field.weight.any()

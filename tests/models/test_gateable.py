"""Which models can be gated: one that lacks a method of gates is refused, and a checkpoint cannot say otherwise."""

from typing import Any

import pytest
import torch

from gsbench import models
from gsbench.errors import InputError
from gsbench.models.classes import Classes, pack
from gsbench.models.gaussians3d import Gaussians3DModel
from gsbench.scenes.scene import Points


class Blinking(Gaussians3DModel):
    """Says that it observes time, and has no `still` and no `frozen`."""

    observes = ("time",)


class Half(Blinking):
    """Has one of the two."""

    def frozen(self, *_: Any) -> Any:
        return {}


def made(kind: type[Gaussians3DModel]) -> Gaussians3DModel:
    model, points = kind(), torch.rand(6, 3, generator=torch.Generator().manual_seed(0))
    model.initialise(Points(points, points), 1.0, torch.Generator().manual_seed(0))
    return model


def test_models_that_can_be_gated() -> None:
    """Catches a model of ours whose gates are refused, and one without the methods whose gates are not."""
    assert all(models.find(name).can_be_gated() for name in ("3dgs", "4dgs", "6dgs", "7dgs", "7dgs_nodir"))
    assert not Blinking.can_be_gated()
    assert not Half.can_be_gated()


def test_a_checkpoint_with_gates_of_a_model_without_them() -> None:
    """Catches a checkpoint that loads and then ends in NotImplementedError at its first image."""
    model = made(Gaussians3DModel)
    model.classes = Classes(0, 0, torch.full((6,), 3, dtype=torch.int32), torch.zeros(6, dtype=torch.uint8))
    state = pack(model)
    made(Gaussians3DModel).load_state(dict(state))
    with pytest.raises(InputError, match="Blinking cannot be gated"):
        made(Blinking).load_state(dict(state))

"""A checkpoint of an older version holds other names of the same things."""

from pathlib import Path

import torch

from gsbench.models import build
from gsbench.models.effect_sets import EffectSets
from gsbench.models.gated import as_gated
from gsbench.scenes import Points
from gsbench.train import checkpoint
from gsbench.train.checkpoint import Checkpoint

OLDER = {  # keys of a model's state
    "log_lambda.time": "log_modulation.time",
    "log_lambda.direction": "log_modulation.direction",
    "effect_sets.counts": "classes.counts",
    "effect_sets.orders": "classes.levels",
    "effect_sets.frozen": "classes.frozen",
    "effect_sets.intervals": "classes.spans",
}


def test_a_checkpoint_of_older_names_is_read(tmp_path: Path) -> None:
    """Catches a key that was renamed and that no checkpoint of before is found by any more."""
    model = as_gated(build("7dgs", lambda_t=0.5, lambda_d=0.25))
    model.initialise(Points(torch.rand(5, 3), torch.rand(5, 3)), 1.0, torch.Generator().manual_seed(0))
    model.effect_sets = EffectSets(1, 4, torch.full((5,), 3, dtype=torch.int32), torch.zeros(5, dtype=torch.uint8),
                                   torch.tensor([[0.25, 0.5]]))  # fmt: skip
    state = model.pack()
    assert OLDER.keys() <= state.keys()
    older = {"step": 7, "model": {OLDER.get(key, key): value for key, value in state.items()},
             "floor": {"least": torch.ones(5)}, "optimizer": {"means.0": {}, "modulation.1": {"step": 3}}}  # fmt: skip
    path = tmp_path / checkpoint.FILE_NAME
    checkpoint.save(path, Checkpoint("training", "data", older, {"data": {"modulation": 0.5}}))

    assert checkpoint.read(path).config == {"data": {"initial_lambda": 0.5}}
    found = checkpoint.read(path).state
    assert found.keys() == {"step", "model", "minimum_scale", "optimizer"}
    assert found["optimizer"] == {"means.0": {}, "lambda.1": {"step": 3}}
    assert found["model"].keys() == state.keys()
    other = as_gated(build("7dgs", lambda_t=1.0, lambda_d=1.0))
    other.initialise(Points(torch.rand(5, 3), torch.rand(5, 3)), 1.0, torch.Generator().manual_seed(1))
    other.load_state(found["model"])
    assert all(torch.equal(value, other.pack()[key]) for key, value in state.items())
    assert float(other.lambda_of("time")) == float(model.lambda_of("time"))

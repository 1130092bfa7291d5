"""Choices and numbers of a config that no run can have, refused by their key before anything is read."""

import pytest

from gsbench.config import Config
from gsbench.errors import InputError
from gsbench.run.checks import RANGES, check_config
from gsbench.stability.training_cases import compose

CHOICES = ("data.background", "scene.eval_split", "optim", "effects.gate", "device", "raster.backend")


@pytest.fixture(scope="module")
def config() -> Config:
    return compose("7dgs", 10)


def refusal(config: Config, key: str, value: object) -> str:
    """What is said of a config with another value at a key; the config is left as it was."""
    *groups, name = key.split(".")
    at = config
    for group in groups:
        at = getattr(at, group)
    before = getattr(at, name)
    setattr(at, name, value)
    with pytest.raises(InputError) as caught:
        check_config(config)
    setattr(at, name, before)
    return str(caught.value)


def test_every_choice_and_range_is_checked(config: Config) -> None:
    """Catches a key that is no longer looked at: its run would fail in the middle, or train as if nothing were said."""
    check_config(config)
    for key in CHOICES:
        said = key.replace("raster.", "raster ")  # the backend is resolved by name elsewhere too
        assert refusal(config, key, "nothing").startswith(f"{said} 'nothing' is not known")
    for key, (low, high) in RANGES.items():
        for value in (low - 1, 2 * high + 1):
            assert refusal(config, key, value).startswith(f"{key}: expected"), key
    for key in ("train.cooldown_from", "train.average_from"):  # steps of the recipe's 30,000
        assert refusal(config, key, 30_000).startswith(f"{key}: expected a step below train.recipe_iterations=30000")
    check_config(config)

"""The command line that Hydra gets: scene=all as an axis of the sweep, and Hydra's flag wherever it stands."""

import pytest

from gsbench.config import register_schema
from gsbench.errors import InputError
from gsbench.sweep.axes import expand

MINI = "scene=moving-matte,pendulum,suzanne"


@pytest.fixture(scope="module", autouse=True)
def schema() -> None:
    register_schema()


@pytest.mark.parametrize(
    ("words", "expanded"),
    [
        (["+exp=mini"], ["--multirun", "+exp=mini", MINI]),
        (["+exp=mini", "scene=all", "seed=1"], ["--multirun", "+exp=mini", "seed=1", MINI]),
        (["+exp=mini", "scene=suzanne"], ["+exp=mini", "scene=suzanne"]),
        (["+exp=mini", "-m", "seed=0,1"], ["--multirun", "+exp=mini", "seed=0,1", MINI]),
        (["+exp=mini", "data.scenes=[mine,suzanne]"],
         ["--multirun", "+exp=mini", "data.scenes=[mine,suzanne]", "scene=mine,suzanne"]),
        (["+exp=mini", "--cfg", "job"], ["+exp=mini", "--cfg", "job"]),
        (["--help"], ["--help"]),
        (["model=7dgs"], ["model=7dgs"]),
        (["+exp=nosuch"], ["+exp=nosuch"]),
        (["--config-dir", "/tmp", "model=7dgs"], ["--config-dir", "/tmp", "model=7dgs"]),
        (["model=7dgs", "--config-dir", "."], ["model=7dgs", "--config-dir", "."]),
        (["+exp=mini", "scene=dust", "+launch=slurm"], ["--multirun", "+exp=mini", "scene=dust", "+launch=slurm"]),
        (["+exp=mini", "scene=suzanne", "+launch=local"], ["+exp=mini", "scene=suzanne", "+launch=local"]),
        (["+exp=mini", "+launch=slurm", "--cfg", "job"], ["+exp=mini", "+launch=slurm", "--cfg", "job"]),
    ],
)  # fmt: skip
def test_scenes_are_an_axis(words: list[str], expanded: list[str]) -> None:
    """Catches scenes that a cluster does one after the other in one job, and a flag that Hydra does not see,
    a folder of configs that is taken for a choice, and a run for Slurm that trains on the login node instead."""
    assert expand(words) == expanded


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["+exp=mini", "data.scenes=[]"], "empty list"),
        (["+exp=mini,dnerf"], "expected one experiment"),
        (["+exp=mini", "model=7"], "model '7' is not known"),
    ],
)
def test_what_cannot_be_expanded_is_told(words: list[str], said: str) -> None:
    """Catches a sweep of no run that ends well."""
    with pytest.raises(InputError, match=said):
        expand(words)

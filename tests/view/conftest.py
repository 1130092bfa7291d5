"""A finished run that the tests of a room share."""

from pathlib import Path

import pytest
from tiny_run import gsbench, overrides, write_moving_square

from gsbench.measure import record


@pytest.fixture(scope="session")
def square(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set with one moving square."""
    return write_moving_square(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="session")
def folder(square: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished run of 7DGS with AGR on that data set."""
    root = tmp_path_factory.mktemp("run")
    done = gsbench(*overrides(square, root, "model=7dgs", "train.iterations=20"))
    assert done.returncode == 0, done.stderr
    (path,) = record.find(root)
    return path.parent

"""Finished runs that the tests of a room share."""

from pathlib import Path

import pytest
from tiny_run import overrides, run_here


def trained(square: Path, root: Path, *words: str) -> Path:
    """Do a run on that data set; return its folder."""
    record, folder = run_here(*overrides(square, root, *words))
    assert record.status == "ok", record.reason
    return folder


@pytest.fixture(scope="session")
def folder(square: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished run of 7DGS with AGR."""
    return trained(square, tmp_path_factory.mktemp("run"), "model=7dgs", "train.iterations=20")


@pytest.fixture(scope="session")
def other_folder(square: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished run of 4DGS, without AGR, on the same data."""
    return trained(square, tmp_path_factory.mktemp("other"), "model=4dgs", "train.iterations=60")

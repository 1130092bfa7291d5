"""Let cases use the small inputs of the other test folders, and share one pool of workers."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parents[1]
sys.path += [str(TESTS / folder) for folder in ("scenes", "report", "raster")]


@pytest.fixture(scope="session")
def pool(tmp_path_factory: pytest.TempPathFactory) -> Iterator["Pool"]:  # noqa: F821  known once the path is
    from workers import Pool

    pool = Pool(tmp_path_factory.mktemp("hostile"))
    yield pool
    pool.stop()

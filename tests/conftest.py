"""Fixtures that every test folder may use."""

import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

import gsbench  # noqa: F401  before torch: how its threads wait is settled as it loads

# Files of many seconds and few tests: first, so that at the end no process waits for another's.
LONGEST = (
    *("test_adding_a_kernel.py", "test_audit.py", "test_adding_a_model.py", "test_command_line.py"),
    *("test_checkpoint.py", "test_selection.py", "test_install.py", "test_start.py", "test_end_to_end.py"),
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Puts the longest files first."""
    items.sort(key=lambda item: LONGEST.index(item.path.name) if item.path.name in LONGEST else len(LONGEST))


def pytest_runtest_setup() -> None:
    """Lets each test draw the same numbers, whichever tests its process has run before."""
    import torch

    torch.manual_seed(0)


@pytest.fixture
def threads() -> Iterator[None]:
    """Puts the number of threads back."""
    import torch

    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture
def repeats(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Counts repetitions of recordings, those that are "done" and those that were found "outdated"."""
    from gsbench.kernels.recording import OutdatedError, Recording

    counted, repeat = Counter[str](), Recording.repeat

    def count(self: Recording) -> None:
        try:
            repeat(self)
        except OutdatedError:
            counted["outdated"] += 1
            raise
        counted["done"] += 1

    monkeypatch.setattr(Recording, "repeat", count)
    return counted


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of data sets that are not committed; skips where it is missing."""
    default = Path(__file__).resolve().parents[2] / "shared"
    data = Path(os.environ.get("GSBENCH_SHARED", default)) / "data"
    if not data.is_dir():
        pytest.skip(f"needs the shared data sets, not found at {data} (set GSBENCH_SHARED)")
    return data


@pytest.fixture(scope="session")
def square(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set with one scene, a moving square, which tests only read."""
    from tiny_run import write_moving_square

    return write_moving_square(tmp_path_factory.mktemp("data"))

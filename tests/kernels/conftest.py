"""Fixtures for tests of the compiled kernels; all of them are skipped where the extension was not built."""

from collections.abc import Iterator

import pytest
import torch

from gsbench import kernels


def pytest_ignore_collect() -> bool | None:
    return None if kernels.available() else True


@pytest.fixture(params=kernels.native().instruction_sets() if kernels.available() else [])
def instruction_set(request: pytest.FixtureRequest) -> Iterator[str]:
    """Runs the test once with each instruction set that this machine has."""
    best = kernels.native().instruction_sets()[-1]
    kernels.use_instruction_set(request.param)
    yield request.param
    kernels.use_instruction_set(best)


@pytest.fixture
def threads() -> Iterator[None]:
    """Puts the number of threads back."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)

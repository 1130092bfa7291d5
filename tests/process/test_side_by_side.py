"""Independent pieces of work on threads of Python."""

import pytest
import torch

from gsbench.process.workers import side_by_side


def slowly(item: int) -> tuple[int, int, bool]:
    """Work whose later pieces are done sooner."""
    torch.rand(40 - item, 1000).sort()
    return item, torch.get_num_threads(), torch.is_grad_enabled()


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("workers", [1, 2, 5])
def test_results_come_in_the_order_of_the_items(workers):
    """Catches results out of order, and workers that compute gradients for a caller without them."""
    torch.set_num_threads(4)
    with torch.no_grad():
        results = list(side_by_side(slowly, range(40), workers))
    assert [result[0] for result in results] == list(range(40))
    assert {result[1] for result in results} == {{1: 4, 2: 2, 5: 1}[workers]}, "workers with too many threads"
    assert not any(result[2] for result in results)
    assert torch.get_num_threads() == 4
    assert all(result[2] for result in side_by_side(slowly, range(2), workers))


def test_an_error_in_a_worker_is_the_caller_s():
    """Catches a piece of work that fails in silence."""

    def fail(item: int) -> int:
        if item == 3:
            raise ValueError("three")
        return item

    with pytest.raises(ValueError, match="three"):
        list(side_by_side(fail, range(5), 2))

"""Run `make slurm-check` as a test where a Slurm can be brought up: minutes, so it is among the slow ones."""

import check
import cluster
import pytest


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_sweep_survives_what_a_cluster_does_to_it():
    """Catches runs that a real Slurm loses, forgets or changes: see check.py. A fake Slurm would not."""
    reason = cluster.missing()
    if reason:
        pytest.skip(reason)
    assert check.main([]) == 0

"""The line that a run ends with."""

from dataclasses import replace

import pytest
from report.make_golden import make

from gsbench.measure.curve import Point
from gsbench.measure.record import Stop
from gsbench.run.execution import summary


@pytest.mark.parametrize(
    ("last", "sentence"),
    [(24.5, "PSNR on val was 0.50 dB higher at iteration 600: a shorter training may be better"),
     (24.95, ""), (25.2, ""), (None, "")],
)  # fmt: skip
def test_a_training_that_was_better_earlier_says_so(last: float | None, sentence: str) -> None:
    """Catches a training that overfits in silence, and one that is called too long for less than seeds differ by."""
    record = make()
    curve = [Point(300, 1.0, 24.0), Point(600, 2.0, 25.0), Point(900, 3.0, last)]
    line = summary(replace(record, curve=curve))
    assert (sentence in line) if sentence else "higher" not in line
    assert "higher" not in summary(replace(record, curve=curve, stop=Stop(iteration=900, kept=600)))
    assert "higher" not in summary(replace(record, curve=[]))


def test_views_at_the_cap_are_named() -> None:
    """Catches a PSNR that nobody can tell from one without a view that is rendered exactly."""
    assert "counts as" not in summary(make())
    assert ". PSNR of test/r_3 is infinite or nearly so and counts as 100 dB" in summary(
        replace(make(), exact=["test/r_3"])
    )

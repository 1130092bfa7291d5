"""What the page makes of numbers worked by hand: prices in words, points of a frontier, profiles, events in seconds."""

import dataclasses
import re

import numpy as np
import pytest
from make_golden import make
from many_records import EFFECTS, frontier
from test_compare import group, run

from gsbench.config import TrainConfig
from gsbench.measure.curve import Point
from gsbench.measure.record import Effects
from gsbench.report import paper
from gsbench.report.comparisons import comparisons
from gsbench.report.page import charts, cost, events, time_to_quality, worth
from gsbench.report.page.content import Canvas, Runs
from gsbench.report.page.palette import Style, styles

STEPS = {"iterations": 1000, "recipe_iterations": 1000, "refine_from": 250, "lambda_from": 750}


def canvas():
    return Canvas("x", Runs(), styles(list(EFFECTS)), 8)


def effects(runs):
    """What is said of the prices of runs."""
    found = group(*runs)
    return worth.effects_section(found, comparisons(found), canvas()).sentences


def circles(svg):
    """The number and the place across of each point that answers to a pointer."""
    return [(int(run), float(x)) for run, x in re.findall(r'data-run="(\d+)" data-colour="\d+" cx="([\d.]+)"', svg)]


@pytest.mark.parametrize(
    ("both", "said"),
    [(22.0, "2.00 dB less than the sum of their gains"), (26.0, "2.00 dB more than the sum of their gains")],
)
def test_effects_that_are_real_are_said_with_their_interaction(both, said):
    """Catches an interval that counts as holding zero though it does not, and an interaction told the wrong way round.

    Time brings 3 dB and direction 1 dB; both together 2 dB or 6 dB.
    """
    psnr = {"3dgs": 20.0, "4dgs": 23.0, "6dgs": 21.0, "7dgs_noagr": both}
    runs = [run(m, s, (v + s / 100, v + s / 50), effects=EFFECTS[m]) for m, v in psnr.items() for s in range(3)]
    sentences = effects(runs)
    assert any(s.startswith(f"Time × direction: together they gain {said}") for s in sentences)
    assert not any(s.startswith("Not significant") for s in sentences)


def test_an_effect_that_may_be_nothing_is_said_to_be():
    """Catches a price whose interval holds zero, told as if it were there."""
    values = {"3dgs": (20.0, 20.0, 20.0), "4dgs": (19.0, 20.0, 21.5)}
    runs = [run(m, s, (v, v), effects=EFFECTS[m]) for m, each in values.items() for s, v in enumerate(each)]
    assert "Not significant in dB: time alone." in effects(runs)


def test_a_point_is_drawn_once():
    """Catches points of the frontier that are drawn as beaten too."""
    records = frontier(models=("3dgs", "4dgs"), scenes=("suzanne",), seeds=1)
    drawn = canvas()
    (tab,) = cost.frontier_section(group(*records), drawn).tabs
    for drawing in tab.drawings:
        numbers = [number for number, _ in circles(drawing.svg)]
        assert len(numbers) == len(set(numbers)) == 2 * 4


def test_the_papers_point_is_at_its_milliseconds_and_seconds():
    """Catches frames a second drawn as milliseconds, and minutes as seconds, beside a run of 50 ms and 90 s."""
    row = paper.paper_row("D-NeRF", "trex", "7dgs")
    of_paper = {"paper_dataset": "D-NeRF", "background": "black", "resolution": "400x400"}
    protocol = {**make().protocol, **of_paper}
    drawn = canvas()
    (tab,) = cost.frontier_section(group(make(scene="trex", dataset="D-NeRF", protocol=protocol)), drawn).tabs
    names = [entry["name"] for entry in drawn.runs.entries]
    theirs = names.index("the paper's 7dgs on trex")
    for drawing, ours, paper_s in zip(
        tab.drawings[:2], (90.0, 50.0), (60 * row.train_min, 1000 / row.fps), strict=True
    ):
        places = dict(circles(drawing.svg))
        assert (places[theirs] < places[1 - theirs]) == (paper_s < ours)


def test_what_a_training_lost_at_its_end_is_said():
    """Catches a gain told as a loss: 0.5 dB below the best on val, which came before the end."""
    lost = make("7dgs", curve=[Point(500, 10.0, 20.0), Point(800, 20.0, 24.0), Point(1000, 30.0, 23.5)])
    kept = make("4dgs", curve=[Point(500, 10.0, 20.0), Point(1000, 30.0, 23.5)])
    (said,) = time_to_quality.anytime_section(group(lost, kept), canvas()).sentences
    assert said.endswith("in the mean over scenes: 7dgs by 0.50 dB. The other models end within 0.05 dB of theirs.")


@pytest.mark.parametrize("ends", [1000, 500])
def test_events_stand_at_the_seconds_of_their_steps(ends, monkeypatch):
    """Catches events at the wrong seconds, and beyond the last point, where no one measured: 10 s at 500 steps."""
    train = dataclasses.asdict(TrainConfig(**STEPS))
    config = {"train": train, "model": {"lr": {"lambda": {"start": 1e-3}}}}
    curve = [point for point in (Point(500, 10.0, 20.0), Point(1000, 40.0, 21.0)) if point.iteration <= ends]
    record = make(curve=curve)
    record = dataclasses.replace(record, provenance=dataclasses.replace(record.provenance, config=config))
    shown = []
    draw = charts.anytime
    monkeypatch.setattr(charts, "anytime", lambda curves: shown.extend(curves) or draw(curves))
    time_to_quality.anytime_section(group(record), canvas())
    steps, letters = zip(*events.of(record), strict=True)
    assert {250: "A", 750: "L"}.items() <= dict(zip(steps, letters, strict=True)).items()
    expected = np.interp(steps, [0, *(p.iteration for p in curve)], [0, *(p.seconds for p in curve)])
    assert [seconds for seconds, _ in shown[0].events] == pytest.approx(expected)


def test_what_comes_after_the_end_is_no_event():
    """Catches a mark for AGR that would have started after the last step."""
    config = {"train": dataclasses.asdict(TrainConfig(iterations=1000, refine_from=31_000)), "model": {"lr": {}}}
    record = make(effects=Effects(time=True, direction=True, refinement=True))
    record = dataclasses.replace(record, provenance=dataclasses.replace(record.provenance, config=config))
    found = events.of(record)
    assert found
    assert not any("A" in letters for _, letters in found)


@pytest.mark.parametrize("most", [300.0, 4e5, 2e9])
def test_a_logarithmic_axis_is_marked_to_its_end(most):
    """Catches at most seven ticks of a long axis that all stand at its left, and an axis without a number."""
    marks = [charts.Mark(x, 20.0, i) for i, x in enumerate((2e-3, 1.0, most))]
    panel = charts.frontier([charts.FrontierCurve(Style(0, "o"), marks)], "s")
    low, high = panel.axes.get_xlim()
    ticks = np.array(panel.axes.get_xticks())
    assert 3 <= len(ticks) <= 7
    assert low <= ticks.min() <= ticks.max() <= high
    gaps = np.diff(np.log10([low, *ticks, high]))
    assert gaps.max() < 0.5 * np.log10(high / low)


def test_a_profile_counts_what_is_reached_at_a_ratio():
    """Catches a share that leaves out the target at its own ratio: one of two at 1, both from 3 on, one never."""
    style = Style(0, "o")
    panel = charts.profile({"a": (style, [1.0, 3.0]), "b": (style, [1.0, np.inf])}, 2)
    a, b = ([*zip(*line.get_data(), strict=True)] for line in panel.axes.lines[:2])
    assert (1.0, 0.5) in a
    assert (3.0, 1.0) in a
    assert {share for _, share in b} == {0.5}

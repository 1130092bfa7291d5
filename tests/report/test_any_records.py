"""The report of any records: short, failed, equal, without val, curve or seconds, of several lengths and machines."""

import dataclasses
import itertools
import re

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from parsed_page import Page
from records import EFFECTS, but, elsewhere, gates, lost, make, write_all

from gsbench.measure.curve import Point
from gsbench.measure.record import Effects, LengthChoice, OnDemand, Record, Stop, TimeScreen, ViewScore
from gsbench.measure.speed import RenderTimes
from gsbench.report.__main__ import main

SETTINGS = settings(
    derandomize=True, deadline=None, database=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
NO_NUMBER = re.compile(r"(?<![\w.-])(nan|inf|infinity|None|NaN|Infinity)(?![\w.-])")
ANY_EFFECTS = EFFECTS | {"auto": Effects(True, True, True), "of_users": Effects(True, False, True)}
PSNR = (20.0, 31.5, None, 0.0, 100.0)  # None: infinite, or it was not measured
SECONDS = (4.0, 0.0, 1e-9, 300.0, 90_000.0)
LENGTHS = (1, 10, 30_000)


@st.composite
def records(draw: st.DrawFn) -> list[Record]:
    """Runs of few models, scenes, seeds and lengths on the paper's data or others; some fail, many lack something."""

    def some(of, most):
        return draw(st.lists(st.sampled_from(of), min_size=1, max_size=most, unique=True))

    def often(value, other):
        return draw(st.sampled_from((value, value, value, other)))

    def run(model: str, scene: str, seed: int, length: int) -> Record:
        mean = draw(psnr)
        took, ms = draw(st.sampled_from(seconds)), draw(st.sampled_from((5.0, 5.0, 0.0, 1e6)))
        record = but(
            make("7dgs", scene, seed),
            model=model,
            dataset=dataset,
            effects=ANY_EFFECTS[model],
            variant="" if length == max(LENGTHS) else f"iterations={length}",
            overrides=often(["+exp=mini", f"model={model}", f"scene={scene}", f"seed={seed}"], []),
            provenance={
                "device": often("Invented CPU", "another CPU"),
                "git_commit": often("0" * 40, None),
                "config": often({"train": {"iterations": length}}, {}),
            },
            metrics={"psnr": mean, "ssim": None, "lpips_alex": None, "psnr_best_on_val": None},
            missing=dict.fromkeys(("psnr", "ssim", "lpips_alex", "psnr_best_on_val"), "not measured"),
            per_view=[ViewScore(f"test/r_{i}", mean) for i in range(2)],
            cost={
                "train_s": took,
                "stage_s": often({"raster": took}, {}),
                "render_ms": RenderTimes(ms, ms, ms),
                "fps": 1000 / ms if ms else 0.0,
                "bytes": often(10**6, 0),
                "load": often(3.0, None),
                "train_cpu_s": often(took, None),
            },
            curve=often([Point(i, took * i / length, draw(psnr)) for i in sorted({1, (length + 1) // 2, length})], []),
            length_choice=often(None, LengthChoice(length, [])),
            stop=often(None, Stop(length, 1)),
        )
        measured = {name: why for name, why in record.missing.items() if (record.metrics or {})[name] is None}
        screen = TimeScreen(
            draw(st.sampled_from(("on", "off", "undecided"))), "why", often(0.001, None), None, None, 0.1
        )
        chosen = OnDemand(often(screen, None), often(gates(seed), []), ["one note"])
        on_demand = chosen if model == "auto" else often(None, chosen)
        record = dataclasses.replace(record, protocol=often(protocol, {}), missing=measured, on_demand=on_demand)
        status = draw(st.sampled_from(("failed", "diverged")))
        return often(record, lost(record, f"{status} in step 1", status))

    protocol = {
        "name": "gsbench",
        "background": "black",
        "resize": None,
        "quantise": False,
        "paper_dataset": "D-NeRF",
        "eval_split": draw(st.sampled_from(("test", "test", "val"))),
        "resolution": draw(st.sampled_from(("400x400", "400x400", "100x100"))),
    }
    psnr, seconds = st.sampled_from(some(PSNR, 2)), some(SECONDS, 2)  # equal runs and missing numbers are common
    dataset = draw(st.sampled_from(("D-NeRF", "mini")))
    names = (sorted(ANY_EFFECTS), ("trex", "lego", "suzanne"), (0, 1, 2), LENGTHS)
    runs = [run(*name) for name in itertools.product(*(some(of, 2) for of in names))]
    rendered = [r for r in runs[: draw(st.sampled_from((0, 1)))] if r.status == "ok"]
    return [*runs, *(elsewhere(r, "other", fps=draw(st.sampled_from((None, 30.0)))) for r in rendered)]


def check(runs: list[Record], root, capsys) -> None:
    """Write the report of records, and check its page, its table and what the terminal prints."""
    folder = write_all(runs, root)
    capsys.readouterr()
    assert main([str(folder)]) == 0
    page = Page((folder / "report.html").read_text())
    texts = {"page": page.text, "table.md": (folder / "table.md").read_text(), "terminal": capsys.readouterr().out}
    for where, text in texts.items():
        wrong = NO_NUMBER.search(text)
        assert not wrong, f"{where}: {text[max(0, wrong.start() - 80) : wrong.end() + 40]!r}"
    for r in runs:
        assert r.path.as_posix() in page.text, f"{r.path} is not listed"
        assert r.status == "ok" or str(r.reason) in page.text


@settings(SETTINGS, max_examples=12)
@given(runs=records())
def test_the_report_of_any_records(runs, tmp_path_factory, capsys):
    """Catches a section that divides by what these runs lack, a hole in the HTML, a number that is none, a lost run."""
    check(runs, tmp_path_factory.mktemp("any"), capsys)


@pytest.mark.slow
@settings(SETTINGS, max_examples=150)
@given(runs=records())
def test_the_report_of_many_records(runs, tmp_path_factory, capsys):
    """Catches what twelve sets of records leave out."""
    check(runs, tmp_path_factory.mktemp("many"), capsys)

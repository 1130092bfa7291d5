"""The report of any records: short, failed, equal, without val, curve or seconds, of several lengths and machines."""

import dataclasses
import json
import re
from html.parser import HTMLParser

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from make_golden import make
from many_records import EFFECTS, gates, write_all

from gsbench.measure.curve import Point
from gsbench.measure.record import Effects, LengthChoice, OnDemand, Record, Stop, TimeScreen, ViewScore
from gsbench.measure.speed import RenderTimes
from gsbench.report.__main__ import main

SETTINGS = settings(
    derandomize=True, deadline=None, database=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
VOID = {"meta", "link", "img", "input", "br", "hr"}
NO_NUMBER = re.compile(r"(?<![\w.-])(nan|inf|infinity|None|NaN|Infinity)(?![\w.-])")
ANY_EFFECTS = EFFECTS | {"auto": Effects(True, True, True), "mine": Effects(True, False, True)}
PSNR = (20.0, 31.5, None, 0.0, -3.25, 1e60)  # None: infinite, or it was not measured
SECONDS = (4.0, 0.0, 1e-9, 300.0, 90_000.0)
SCENES = ("trex", "lego", "suzanne")
LENGTHS = (1, 10, 30_000)


class Valid(HTMLParser):
    """A page whose elements are closed in order and whose ids are unique, and its texts and attributes."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.texts: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open, f"not closed: {self.open}"
        assert len(self.ids) == len(set(self.ids))
        assert not set(self.links) - set(self.ids), "a link or a label leads to nothing"

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        assert len(values) == len(attrs), f"an attribute comes twice: {attrs}"
        self.open += [] if tag in VOID else [tag]
        self.ids += [values["id"]] if "id" in values else []
        linked = [values.get("aria-labelledby") or ""]
        href = values.get("href") or ""
        self.links += filter(None, [*linked, href.removeprefix("#") if href.startswith("#") else ""])
        self.texts += [values[name] or "" for name in ("aria-label", "alt", "title") if name in values]

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.handle_endtag(tag)

    def handle_endtag(self, tag):
        assert [tag] == self.open[-1:], f"</{tag}> closes {self.open[-3:]}"
        self.open.pop()

    def handle_data(self, data):
        if not {"script", "style"} & set(self.open):
            self.texts.append(data)
        elif data.startswith("{"):
            json.loads(data, parse_constant=pytest.fail)


@st.composite
def records(draw: st.DrawFn) -> list[Record]:
    """Runs of few models, scenes, seeds and lengths on the paper's data or others; some fail, many lack something."""
    some = lambda of, most: draw(st.lists(st.sampled_from(of), min_size=1, max_size=most, unique=True))  # noqa: E731
    models, scenes, seeds, lengths = (
        some(*of) for of in ((sorted(ANY_EFFECTS), 2), (SCENES, 2), ((0, 1, 2), 2), (LENGTHS, 2))
    )
    protocol = {
        "name": "gsbench",
        "background": "black",
        "resize": None,
        "quantise": False,
        "eval_split": draw(st.sampled_from(("test", "test", "val"))),
        "paper_dataset": "D-NeRF",
        "resolution": draw(st.sampled_from(("400x400", "400x400", "100x100"))),
    }
    numbers = some(PSNR, 2), some(SECONDS, 2)  # so that equal runs and missing numbers are common
    dataset = draw(st.sampled_from(("D-NeRF", "mini")))
    return [
        dataclasses.replace(draw(runs(model, scene, seed, length, protocol, *numbers)), dataset=dataset)
        for model in models
        for scene in scenes
        for seed in seeds
        for length in lengths
    ]


@st.composite
def runs(
    draw: st.DrawFn,
    model: str,
    scene: str,
    seed: int,
    length: int,
    protocol: dict[str, object],
    psnr: list[float | None],
    seconds: list[float],
) -> Record:
    """One run, which finished or not, with one of the given numbers."""
    often = lambda value, other: draw(st.sampled_from((value, value, value, other)))  # noqa: E731
    measured, took = st.sampled_from(psnr), draw(st.sampled_from(seconds))
    base = make("7dgs", scene, seed)
    device, commit = often("Invented CPU", "another CPU"), often("0" * 40, None)
    config = often({"train": {"iterations": length}}, {})
    base = dataclasses.replace(
        base,
        model=model,
        effects=ANY_EFFECTS[model],
        variant="" if length == max(LENGTHS) else f"iterations={length}",
        overrides=often(["+exp=mini", f"model={model}", f"scene={scene}", f"seed={seed}"], []),
        protocol=often(protocol, {}),
        provenance=dataclasses.replace(base.provenance, device=device, config=config, git_commit=commit),
    )
    if often(False, True):
        nothing = {"metrics": None, "missing": {}, "cost": None, "per_view": [], "curve": []}
        status = draw(st.sampled_from(("failed", "diverged")))
        return dataclasses.replace(base, status=status, reason=f"{status} in step 1", **nothing)
    metrics = {**(base.metrics or {}), "psnr": draw(measured), "ssim": None, "lpips_alex": None}
    curve = [Point(i, took * i / length, draw(measured)) for i in sorted({1, (length + 1) // 2, length})]
    screen = TimeScreen(draw(st.sampled_from(("on", "off", "undecided"))), "why", often(0.001, None), None, None, 0.1)
    chosen = OnDemand(often(screen, None), often(gates(seed), []), ["one note"])
    ms = draw(st.sampled_from((5.0, 5.0, 0.0, 1e6)))
    return dataclasses.replace(
        base,
        metrics=metrics,
        missing={name: "not measured" for name, value in metrics.items() if value is None},
        per_view=often([ViewScore(f"test/r_{i}", draw(measured)) for i in range(2)], []),
        cost=dataclasses.replace(
            base.cost,
            train_s=took,
            stage_s=often({"raster": took}, {}),
            render_ms=RenderTimes(ms, ms, ms),
            fps=1000 / ms if ms else 0.0,
            bytes=often(10**6, 0),
            load=often(3.0, None),
            train_cpu_s=often(took, None),
        ),
        curve=often(curve, []),
        on_demand=chosen if model == "auto" else often(None, chosen),
        length_choice=often(None, LengthChoice(length, [])),
        stop=often(None, Stop(length, 1)),
    )


def check(made: list[Record], root, capsys) -> None:
    """Write the report of records, and check its page, its table and what the terminal prints."""
    folder = write_all(made, root)
    capsys.readouterr()
    assert main([str(folder)]) == 0
    printed, page = capsys.readouterr().out, (folder / "report.html").read_text()
    seen = Valid(page)
    texts = {"page": "\n".join(seen.texts), "table.md": (folder / "table.md").read_text(), "terminal": printed}
    for where, text in texts.items():
        wrong = NO_NUMBER.search(text)
        assert not wrong, f"{where}: {text[max(0, wrong.start() - 80) : wrong.end() + 40]!r}"
    for r in made:
        assert any(r.path.as_posix() in text for text in seen.texts), f"{r.path} is not listed"
        assert r.status == "ok" or str(r.reason) in texts["page"]


@settings(SETTINGS, max_examples=12)
@given(made=records())
def test_the_report_of_any_records(made, tmp_path_factory, capsys):
    """Catches a section that divides by what these runs lack, a hole in the HTML, a number that is none, a lost run."""
    check(made, tmp_path_factory.mktemp("any"), capsys)


@pytest.mark.slow
@settings(SETTINGS, max_examples=400)
@given(made=records())
def test_the_report_of_many_records(made, tmp_path_factory, capsys):
    """Catches what twelve sets of records leave out."""
    check(made, tmp_path_factory.mktemp("many"), capsys)

"""The page without a browser: its sentences, that texts stay texts, its size, the gallery, and writing it live."""

import base64
import dataclasses
import json
import math
import re
import time
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest
from make_golden import make
from many_records import EFFECTS, HOSTILE, frontier, hostile, on_demand, write_all
from skimage.color import deltaE_ciede2000, rgb2lab

from gsbench.config import TrainConfig
from gsbench.measure.curve import Point
from gsbench.measure.images import strip, write_png
from gsbench.measure.record import Candidate, Effects, ModelComparison, OnDemand, Region, ViewScore
from gsbench.measure.speed import RenderTimes
from gsbench.report import compare, live
from gsbench.report.__main__ import main
from gsbench.report.comparisons import comparisons
from gsbench.report.configurations import groups, is_beside_others
from gsbench.report.frontier import choose, points, targets
from gsbench.report.page import build, charts, cost, evidence, gallery, messages, palette, time_to_quality, worth
from gsbench.report.page.content import Canvas, Column, DataTable, Runs
from gsbench.report.page.events import of as events_of
from gsbench.report.page.palette import DARK, LIGHT, MARKERS, styles
from gsbench.schedule import Schedule


class Page(HTMLParser):
    """The elements and the visible text of a page."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.attributes, self.texts, self.inside = [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs
        self.inside = [*self.inside, tag] if tag in ("script", "style") else self.inside

    def handle_endtag(self, tag):
        self.inside = self.inside[:-1] if tag in ("script", "style") else self.inside

    def handle_data(self, data):
        if not self.inside:
            self.texts.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.texts).split())


def group(records):
    (only,) = groups(records)
    return only


def answers(records):
    return cost.answers(group(records), comparisons(group(records)))


def pairs_section(records):
    return worth.pairs_section(group(records), comparisons(group(records)), canvas())


def effects_section(records):
    return worth.effects_section(group(records), comparisons(group(records)), canvas())


def canvas():
    return Canvas("x", Runs(), styles([*EFFECTS, "auto"]), 8)


def page(records, tmp_path):
    return build.render(records, tmp_path)


SMALL = {"models": ("3dgs", "4dgs"), "scenes": ("suzanne",), "seeds": 2, "lengths": (1000,)}


@pytest.fixture(scope="module")
def small_page(tmp_path_factory):
    return Page(page(frontier(**SMALL), tmp_path_factory.mktemp("small")))


def lost(record):
    gone = {"metrics": None, "missing": {}, "cost": None, "per_view": [], "curve": []}
    return dataclasses.replace(record, status="failed", reason="out of memory", **gone)


def test_the_first_screen_answers(small_page):
    """Catches answers over the budget, without an interval, or from another model than the best that fits."""
    records = frontier()
    ten, minute, _, frames = answers(records)
    assert ten.budget == "10 s of training"
    assert minute.model == "7dgs"
    assert re.fullmatch(r"[\d.]+ dB", minute.value)
    assert re.fullmatch(r"95 % [\d.]+ to [\d.]+ over seeds", minute.interval)
    assert "2,000 iterations" in minute.detail
    assert frames.budget == "60 frames a second"
    text = small_page.text
    assert text.index("10 s of training") < text.index("What accuracy costs")


def test_the_first_screen_names_the_run():
    """Catches an answer that another capacity or gate won, told as if it were the model's default."""
    plain = dataclasses.replace(frontier(("7dgs",), lengths=(2000,))[0], variant="")
    config = {**plain.provenance.config, "effects": {"gate": "both"}}
    gated = dataclasses.replace(
        plain,
        variant="gate=both,iterations=2000,threshold=1e-4",
        metrics={**plain.metrics, "psnr": 40.0},
        per_view=[],
        curve=[Point(2000, 90.0, 40.5)],
        provenance=dataclasses.replace(plain.provenance, config=config),
    )
    (_, answer, *_) = answers([plain, gated])
    assert answer.model == "7dgs, gate=both"
    assert answer.detail.startswith("2,000 iterations, threshold=1e-4, ")


def test_sentences_where_models_tie():
    """Catches a winner among equal models, and a pair that is called a difference."""
    records = [dataclasses.replace(r, model=m) for m in ("a", "b") for r in frontier(("7dgs",), lengths=(1000,))]
    (_, answer, *_) = answers(records)
    assert "No significant difference to" in answer.detail
    assert pairs_section(records).sentences[1] == "The difference is not significant."


def test_sentences_of_one_seed():
    """Catches an interval or a p-value that one seed cannot give."""
    records = frontier(seeds=1)
    (_, minute, *_) = answers(records)
    assert minute.interval == ""
    assert minute.detail == "2,000 iterations, 32.5 s."
    assert pairs_section(records).sentences[0].startswith("The largest difference: ")
    assert "95 %" not in " ".join(effects_section(records).sentences)


def test_one_seed_is_said_once_with_the_command_for_more(tmp_path):
    """Catches a page that repeats what one seed cannot tell, or does not say how to run more seeds."""
    records = frontier(seeds=1, lengths=(1000,))
    text = Page(page(records, tmp_path)).text
    assert text.lower().count("one seed") == 1
    assert (
        "Run more seeds: python -m gsbench -m +exp=mini model=3dgs,4dgs,6dgs,7dgs,7dgs_noagr "
        "scene=moving-matte,suzanne seed=0,1,2 train.iterations=1000"
    ) in text
    mixed = [r for r in frontier(lengths=(1000,)) if r.model != "4dgs" or r.seed == 2]
    assert cost.seeds_words(group(mixed)) == (
        "1 of 5 models have one seed: no interval is known, and no difference is tested. Run more seeds:",
        "python -m gsbench -m +exp=mini model=4dgs scene=moving-matte,suzanne seed=0,1,2 train.iterations=1000",
    )
    assert cost.seeds_words(group(frontier(**SMALL))) == ("", "")
    apart = [dataclasses.replace(r, overrides=[*r.overrides, "data.repair=[a,b]"]) for r in records]
    assert " model=3dgs scene=suzanne seed=0,1,2 " in messages.more_seeds(apart)


def test_the_answers_and_the_pairs_agree():
    """Catches a model that an answer is "ahead" of by its own interval, and that the pairs do not tell apart."""
    near = {"a": 0.0, "b": -0.25, "c": -0.5, "d": -0.75, "e": -1.0}
    random = np.random.default_rng(3)
    records = []
    for run in frontier(("7dgs",), ("suzanne",), 3, (1000,)):
        for model, less in near.items():
            views = [dataclasses.replace(v, psnr=25 + less + 0.3 * random.normal()) for v in run.per_view]
            psnr = float(np.mean([v.psnr for v in views]))
            changed = {"per_view": views, "metrics": {**run.metrics, "psnr": psnr}, "curve": [Point(1000, 9.0, psnr)]}
            records.append(dataclasses.replace(run, model=model, **changed))
    of = group(records)
    family = comparisons(of)
    pairs = {frozenset((p.better.model, p.other.model)): p for p in compare.pairs(of, family)}
    choice = choose(points(of, of.basis), "seconds", 60.0, family)
    apart = {p.series for p in choice.ahead}
    assert apart == {m for m in near if m != "a" and pairs[frozenset("a" + m)].differs}
    raw = {m for m in near if m != "a" and pairs[frozenset("a" + m)].difference.low > 0}
    assert apart < raw, "these records do not set the two rules apart"


def test_differences_of_two_scenes_say_so_first():
    """Catches prices and pairs of two scenes whose intervals read as if they held for others."""
    said = "scenes. The intervals are for other seeds and views of these scenes. Another scene may differ by more."
    records = frontier(lengths=(1000,))
    assert effects_section(records).sentences[0] == f"Two {said}"
    assert pairs_section(records).sentences[0] == f"Two {said}"
    rows = effects_section(records).table.rows
    assert {row[-4] for row in rows} == {"seeds and views, on 2 scenes"}
    assert all(math.isfinite(row[-3]) for row in rows)
    assert {row[-2] + row[-1] for row in rows} <= {0, 1, 2}
    three = frontier(scenes=("a", "b", "c"), lengths=(1000,))
    assert effects_section(three).sentences[0].startswith("3 scenes. The intervals are for scenes like these.")


def test_every_colour_is_defined(tmp_path):
    """Catches a part of a bar that is black, as there are more stages than colours: eight of ours, and foreign ones."""
    records = frontier(**SMALL)
    stages = dict.fromkeys([*worth.STAGES, "mine", "theirs"], 1.0)
    cost_of = dataclasses.replace(records[0].cost, stage_s=stages, train_s=10.0)
    text = page([dataclasses.replace(records[0], cost=cost_of), *records[1:]], tmp_path)
    used = set(re.findall(r"var\(--((?:stage|model)-\d+)\)", text))
    assert {f"stage-{i}" for i in range(len(worth.STAGES) + 1)} <= used
    assert not used - set(re.findall(r"--((?:stage|model)-\d+):", text))
    assert len(palette.STAGES_LIGHT) == len(palette.STAGES_DARK) == len(set(palette.STAGES_LIGHT))


def test_the_largest_part_of_a_difference_is_not_called_most():
    """Catches "most of the difference" of a stage that has two fifths of it."""
    parts = {"a": {"slice": 1.0, "raster": 1.0, "loss": 1.0}, "b": {"slice": 3.0, "raster": 2.5, "loss": 2.5}}
    said = worth._slowest_words(parts, ["slice", "raster", "loss"])
    assert said == " b takes 2.7 times as long as a. 40 % of the difference is in slice."
    more = {"a": {"slice": 1.0, "loss": 1.0}, "b": {"slice": 3.0, "loss": 0.5}}
    assert "All of the difference is in slice." in worth._slowest_words(more, ["slice", "loss"])


def test_nothing_is_dominated_by_a_mean():
    """Catches a word of certainty for what only the means say."""
    records = [dataclasses.replace(r, model=m) for m in ("a", "b") for r in frontier(("7dgs",), lengths=(1000,))]
    slow = [dataclasses.replace(r, cost=dataclasses.replace(r.cost, train_s=99.0)) for r in records if r.model == "b"]
    (text,) = cost.frontier_section(group([*records[: len(slow)], *slow]), canvas()).sentences
    assert "b is both slower and worse than a, by their means. The difference may be chance." in text
    assert "dominated" not in text


def test_what_a_section_leaves_out_is_said():
    """Catches pairs that the drawing lacks in silence, a protocol of some runs that reads as that of all, and totals
    of stages with other digits than their neighbours."""
    records = frontier(lengths=(500, 1000))
    said = " ".join(evidence.protocol_section(group(records)).sentences)
    tabled = sum(r.variant == "" for r in records)
    assert 0 < tabled < len(records)
    assert f"describe the {tabled} runs in the tables" in said
    few = pairs_section(records)
    many = pairs_section([dataclasses.replace(r, model=f"{r.model}{i}") for r in frontier(seeds=2, views=2,
                          lengths=(1000,)) for i in range(2)])  # fmt: skip
    assert len(few.table.rows) <= worth.MOST_PAIRS < len(many.table.rows)
    assert not any("The figure has" in note for note in few.notes)
    drawn = f"The figure has the {worth.MOST_PAIRS} largest of {len(many.table.rows)} differences; the table has all."
    assert drawn in many.notes
    assert "6.60 s" in charts.stages([("a", {"slice": 6.6}), ("b", {"slice": 3.59})], ["slice"], [0]).svg("s", "")


def test_seconds_of_another_machine_are_nowhere(tmp_path):
    """Catches one chart, card or table that still averages over two machines: theirs are a thousand times as slow."""
    records = frontier(("3dgs", "7dgs"), ("suzanne",), 3, (1000,))
    records += on_demand([r for r in records if r.model == "7dgs"])
    other = dataclasses.replace(records[0].provenance, device="another CPU")

    def elsewhere(run):
        slow = {"train_s": 77777.0, "stage_s": {"slice": 77777.0}, "render_ms": RenderTimes(7777.0, 7777.0, 7777.0)}
        spent = dataclasses.replace(run.cost, train_cpu_s=77777.0, load=777.0, **slow)
        curve = [Point(p.iteration, 77777.0, p.psnr_val) for p in run.curve]
        chosen = run.on_demand
        if chosen:
            gates = [dataclasses.replace(g, frame_ms_before=7777.0, frame_ms=7777.0) for g in chosen.gates]
            chosen = OnDemand(dataclasses.replace(chosen.screen, seconds=7777.0), gates)
        return dataclasses.replace(run, provenance=other, cost=spent, curve=curve, on_demand=chosen)

    mixed = group([elsewhere(r) if r.seed == 2 else r for r in records])
    family = comparisons(mixed)
    sections = build._sections(mixed, family, tmp_path, canvas())
    values = [v for s in sections if s.table for row in s.table.rows for v in row if isinstance(v, float)]
    assert max(v for v in values if v < 1e6) < 2000, "a number of seconds or milliseconds is theirs"
    said = " ".join(t for s in sections for t in (*s.sentences, *s.notes))
    assert "3 runs on other machines are left out everywhere" in said
    assert "777" not in said
    assert "777" not in " ".join(a.detail for a in cost.answers(mixed, family))
    runs = Runs()
    for r in mixed.records:
        runs.of_record(mixed, r)
    assert "777" not in " ".join(e["facts"] for e in runs.entries)


def test_sentences_where_nothing_finished(tmp_path):
    """Catches a crash, and a page that says less than that nothing finished."""
    records = [lost(r) for r in frontier(lengths=(1000,))]
    assert all(a.model == "" for a in answers(records))
    text = Page(page(records, tmp_path)).text
    assert "No run has finished" in text
    assert "What did not finish" in text
    assert "out of memory" in text


def test_sentences_where_models_are_missing(tmp_path):
    """Catches effects that are priced from nothing, and a pair of one."""
    text = Page(page(frontier(("7dgs",), ("suzanne",), 3, (1000,)), tmp_path)).text
    assert "No two finished models differ in exactly one effect" in text
    assert "there is no pair to compare" in text
    assert "All runs have 1,000 iterations." in text
    assert "No other model has finished there." in text


def test_a_failed_run_does_not_hide_what_finished(tmp_path):
    """Catches one failure that empties the means over scenes."""
    records = frontier(("3dgs", "7dgs"), lengths=(1000,))
    text = Page(page([lost(records[0]), *records[1:]], tmp_path)).text
    assert "11 runs finished, 1 run did not" in text
    assert "On the mean of 2 scenes" in text


def test_the_best_value_is_the_tables():
    """Catches a page whose text and CSV tell different numbers."""
    records = frontier(("3dgs", "7dgs"), lengths=(250, 1000))
    section = cost.frontier_section(group(records), canvas())
    best = max(row[4] for row in section.table.rows if row[0] == "mean of 2 scenes")
    assert messages.plain(best) in section.sentences[0]
    csv = base64.b64decode(section.table.href.partition(",")[2]).decode()
    assert repr(best) in csv
    assert len(csv.splitlines()) == len(section.table.rows) + 1


def test_every_figure_has_its_numbers():
    """Catches a figure without the table behind it or a text alternative."""
    of = group(frontier(**SMALL))
    on = canvas()
    sections = [
        cost.frontier_section(of, on),
        time_to_quality.quality_section(of, on),
        effects_section(of.records),
        worth.stages_section(of, on),
        time_to_quality.anytime_section(of, on),
        pairs_section(of.records),
        evidence.protocol_section(of),
    ]
    for section in sections:
        assert section.sentences
        assert section.table
        assert section.table.rows
        for tab in section.tabs:
            assert tab.drawings
            assert all('role="img" aria-label="' in one.svg for one in tab.drawings)
            assert all("<text" in one.svg for one in tab.drawings)


def test_a_point_names_its_run_and_its_command():
    """Catches a point that cannot be repeated, seeds that are lost, and words a shell would take apart."""
    records = frontier(("7dgs",), ("suzanne",), 3, (1000,))
    runs = Runs()
    of = group(records)
    entry = runs.entries[runs.of_record(of, records[1])]
    assert entry["name"] == "mini/suzanne/7dgs/seed1"
    assert entry["command"] == "python -m gsbench +exp=mini model=7dgs scene=suzanne seed=1 train.iterations=1000"
    entry = runs.entries[runs.of_configuration(of, of.configurations[0], ["suzanne"])]
    assert entry["command"].startswith("python -m gsbench -m +exp=mini ")
    assert entry["command"].endswith(" seed=0,1,2")
    odd = dataclasses.replace(records[0], overrides=["scene.name=a b;rm"])
    assert messages.command([odd]) == "python -m gsbench 'scene.name=a b;rm'"
    assert messages.command([make()]) == ""


def test_hostile_texts_stay_text(small_page, tmp_path):
    """Catches markup, quotes, directions and length from a record that reach the page as anything but text."""
    text = page(hostile(), tmp_path)
    seen = Page(text)
    assert "alert(1)" in seen.text
    assert len(text) < 2_000_000
    assert not [name for name, _ in seen.attributes if name.startswith("on")]
    assert seen.tags.count("script") == small_page.tags.count("script")
    assert "x" * 800 not in seen.text
    assert "\u202e" not in text
    runs = re.search(r'id="runs">(.*?)</script>', text, re.S)[1]
    assert "alert" in json.loads(runs)[0]["command"]


def test_nothing_is_loaded_from_elsewhere(tmp_path):
    """Catches an address of the network or of the disk: a font, a script, an image."""
    write_all(frontier(**SMALL), tmp_path, pictures=1)
    text = page(frontier(**SMALL), tmp_path / "mini")
    seen = Page(text)
    for name, value in seen.attributes:
        if name in ("src", "href", "xlink:href", "action", "srcset", "poster", "data"):
            assert value.startswith(("#", "data:")), (name, value[:80])
    assert not re.search(r"url\((?!#)", text)
    assert "data:image/webp" in text


def test_equal_records_give_equal_pages(tmp_path):
    """Catches a page that changes from one call to the next, so that a difference says nothing."""
    records = frontier(**SMALL)
    assert page(records, tmp_path) == page(records[::-1], tmp_path)


def test_ids_are_unique(tmp_path):
    """Catches drawings that share their clip paths and markers, so that one hides in another's frame."""
    other = [dataclasses.replace(r, experiment="other") for r in frontier(**SMALL)]
    ids = [value for name, value in Page(page([*frontier(**SMALL), *other], tmp_path)).attributes if name == "id"]
    assert len(ids) == len(set(ids))


def contrast(a, b):
    """WCAG's ratio of two colours."""
    light = []
    for colour in (a, b):
        parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
        light.append(0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2])
    return (max(light) + 0.05) / (min(light) + 0.05)


def test_prices_within_one_parametrisation_are_said_beside_the_others():
    """Catches a nested price without its name, its sentence or its note, and a name whose capitals are lost."""
    records = frontier(models=("3dgs", "4dgs", "7dgs_noagr"), scenes=("suzanne",), seeds=3, lengths=(1000,))
    without = effects_section(records)
    assert worth.NOT_NESTED in " ".join(without.notes)
    less = [dataclasses.replace(r, model="7dgs_nodir") for r in records if r.model == "4dgs"]
    section = effects_section([*records, *less])
    assert worth.NESTED in " ".join(section.notes)
    assert any(said.startswith("Direction, with time, nested: ") for said in section.sentences)
    assert {"direction, with time", "direction, with time, nested"} <= {row[0] for row in section.table.rows}
    assert messages.sentence("with AGR") == "With AGR"


def test_colours_are_readable_in_both_themes():
    """Catches a colour of a model that disappears on its page."""
    assert min(contrast(c, "#ffffff") for c in LIGHT) >= 4.5
    assert min(contrast(c, "#141619") for c in DARK) >= 4.5
    assert len(LIGHT) == len(DARK) == len(MARKERS) == len(set(MARKERS))


@pytest.mark.parametrize("theme", [LIGHT, DARK])
def test_colours_of_models_differ(theme):
    """Catches 7dgs, 7dgs_noagr and auto in three shades of one colour."""
    rgb = np.array([[int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)] for colour in theme])
    lab = rgb2lab(rgb[None])[0]
    apart = deltaE_ciede2000(lab[:, None], lab[None]) + 100 * np.eye(len(theme))
    usual = [palette.MODELS.index(m) for m in ("3dgs", "4dgs", "6dgs", "7dgs", "7dgs_noagr", "auto")]
    assert apart.min() > 11
    assert apart[np.ix_(usual, usual)].min() > 18


def test_a_model_keeps_its_colour():
    """Catches colours that depend on which other models are there, and two models that share one."""
    assert styles(["3dgs", "7dgs"])["7dgs"] == styles(["7dgs"])["7dgs"]
    many = styles(["3dgs", "4dgs", "6dgs", "7dgs", "7dgs_noagr", "mine", "other"])
    assert len({s.marker for s in many.values()}) == 7
    known = styles([*palette.MODELS, "mine"])
    assert len({s.colour for s in known.values()}) == len({s.marker for s in known.values()}) == len(known)
    assert len(styles([f"m{i}" for i in range(40)])) == 40


def test_strips_are_cut_back_to_their_images(tmp_path):
    """Catches a crop that is off by the gap or the header, and pixels that stay enlarged."""
    random = np.random.default_rng(0)
    pairs = [(random.random((30, 50, 3)), random.random((30, 50, 3))) for _ in range(3)]
    write_png(strip(pairs), tmp_path / "pictures.png")
    rows = gallery.cut_strip(tmp_path / "pictures.png")
    assert len(rows) == 3
    for (render, truth), found in zip(pairs, rows, strict=True):
        for image, part in zip((render, truth), found[:2], strict=True):
            assert np.array_equal(part[..., ::-1], (image * 255).round().astype(np.uint8))
    large = [(random.random((300, 260, 3)), random.random((300, 260, 3)))]
    write_png(strip(large), tmp_path / "large.png")
    assert gallery.cut_strip(tmp_path / "large.png")[0][0].shape == (300, 260, 3)


def test_a_file_that_is_no_strip_is_left_out(tmp_path):
    """Catches a crash for a damaged or foreign image."""
    (tmp_path / "pictures.png").write_bytes(b"no image")
    assert gallery.cut_strip(tmp_path / "pictures.png") == []
    write_png(np.zeros((20, 20, 3), np.uint8), tmp_path / "small.png")
    assert gallery.cut_strip(tmp_path / "small.png") == []


def test_the_gallery_has_every_model_on_the_same_view(tmp_path):
    """Catches a view without a model, and names of views that are not those of the rows."""
    records = frontier(("3dgs", "7dgs"), ("suzanne",), 1, (1000,))
    folder = write_all(records, tmp_path, pictures=3)
    views = gallery.gallery(records, folder)
    assert [view.name for view in views] == ["test/r_000", "test/r_003", "test/r_006"]
    assert list(views[0].render) == list(views[0].error) == ["3dgs", "7dgs"]
    data = base64.b64decode(views[0].truth.partition(",")[2])
    assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).shape == (40, 60, 3)
    assert gallery.gallery(records, tmp_path / "nothing") == []


def test_the_gallery_has_the_scores_of_its_views(tmp_path):
    """Catches the score of another view or of the whole run, and regions that are shown where there are none."""
    records = frontier(("3dgs", "7dgs"), ("suzanne",), 1, (1000,))
    scored = [dataclasses.replace(view, psnr_moving=None if i == 3 else 20.0 + i)
              for i, view in enumerate(records[1].per_view)]  # fmt: skip
    regions = {"moving": Region("masks", 9, 0.1, "0" * 64)}
    records[1] = dataclasses.replace(records[1], per_view=scored, regions=regions)
    views = gallery.gallery(records, write_all(records, tmp_path, pictures=3))
    plain, moving = ([f"PSNR {record.per_view[i].psnr:.2f} dB" for i in (0, 3, 6)] for record in records)
    assert [view.scores["3dgs"] for view in views] == plain
    assert [view.scores["7dgs"] for view in views] == [f"{moving[0]}, moving 20.00", f"{moving[1]}, moving –",
                                                       f"{moving[2]}, moving 26.00"]  # fmt: skip


def test_the_gallery_fits(tmp_path, monkeypatch):
    """Catches images that make the page too large: noise compresses worst, and the budget is for one view of three."""
    records = frontier(("3dgs", "7dgs"), ("suzanne",), 1, (1000,))
    folder = write_all(records, tmp_path, pictures=3)
    everything = sum(map(gallery._size, gallery.gallery(records, folder)))
    monkeypatch.setattr(gallery, "BUDGET", everything // 5)
    views = gallery.gallery(records, folder)
    assert len(views) == 1
    assert sum(map(gallery._size, views)) <= everything // 5
    monkeypatch.setattr(gallery, "BUDGET", 10)
    assert gallery.gallery(records, folder) == []


def events_by_letter(
    train: TrainConfig, model: dict, effects: Effects, comparison: ModelComparison | None = None
) -> dict[str, list[int]]:
    """The marks of a run with this recipe, model and effects, whose model a comparison may have chosen."""
    one = make()
    provenance = dataclasses.replace(one.provenance, config={"train": dataclasses.asdict(train), "model": model})
    chosen = OnDemand(comparison=comparison)
    marks = events_of(dataclasses.replace(one, provenance=provenance, effects=effects, on_demand=chosen))
    return {letter: [step for step, letters in marks if letter in letters] for letter in "RDAL"}


LEARNT = {"lr": {"lambda": {"start": 1e-3}}}
FIXED = {"lr": {"lambda": {"start": 0}}}


def test_events_are_those_of_the_schedule():
    """Catches marks at other steps than those at which training changes."""
    for length in (250, 2000, 7000):
        config = TrainConfig(iterations=length)
        schedule = Schedule(config, 3, True)
        found = events_by_letter(config, LEARNT, Effects(time=True, direction=True, refinement=True))
        resets = [step + 1 for step in range(length) if schedule.resets(step)]
        assert found["R"] == resets[:4]
        assert found["D"] == [schedule.densify_stop]
        assert found["A"] == [next(s for s in range(length) if schedule.active(s).refine)]
        assert found["L"] == [next(s for s in range(length) if schedule.active(s).tunes_lambda)]
    assert events_of(make()) == []


def test_a_lambda_that_is_fixed_is_not_said_to_be_learned():
    """Catches a mark for 4DGS and 6DGS, whose rate is 0, and none for model=auto, whose rates are its candidate's."""
    config, both = TrainConfig(iterations=2000), {"candidates": {"moving": LEARNT, "static": FIXED}, "lr": {}}
    moving = Effects(time=True, direction=True, refinement=True)
    static = Effects(time=False, direction=True, refinement=False)
    assert events_by_letter(config, FIXED, moving)["L"] == []
    assert events_by_letter(config, both, moving)["L"] == events_by_letter(config, LEARNT, moving)["L"] != []
    assert events_by_letter(config, both, static)["L"] == []
    both["compared"] = {"moving_4dgs": {"name": "4dgs"} | FIXED}
    choices = {name: ModelComparison(1400, name, [Candidate(name, 20.0, 1.0)]) for name in ("4dgs", "7dgs_noagr")}
    assert events_by_letter(config, both, moving, choices["4dgs"])["L"] == []
    assert events_by_letter(config, both, moving, choices["7dgs_noagr"])["L"] != []


def test_a_table_fits_its_page():
    """Catches a column that says the same in every row, and thirty columns beside each other where rows are few."""
    columns = [Column("run"), Column("dB", 2), Column("machine"), Column("seeds")]
    table = DataTable("t.csv", columns, [[f"run {i}", 1.0, "one machine", 1234] for i in range(3)])
    assert [c.title for c in table.shown_columns] == ["run", "dB"]
    assert table.shown[2] == ["run 2", "1.00"]
    assert table.same == "machine one machine; seeds 1,234"
    assert "one machine" in base64.b64decode(table.href.partition(",")[2]).decode()
    assert DataTable("t.csv", columns, [["run 0", 1.0, "one machine", 1]]).same == ""
    many = [Column(str(i), 1) for i in range(30)]
    assert DataTable("t.csv", many, [[1.0] * 30] * 3).is_turned
    long = DataTable("t.csv", many, [[1.0] * 30] * 300)
    assert not long.is_turned
    assert len(long.shown[0]) == len(long.shown_columns) == 30 - long.hidden_columns
    assert 10 < len(long.shown_columns) < 30
    assert not table.is_turned


def test_the_total_of_the_seconds_comes_first():
    """Catches a total that is the last of ten columns, which a narrow screen cuts."""
    section = worth.stages_section(group(frontier(**SMALL)), canvas())
    assert [c.title for c in section.table.columns[:2]] == ["model", "total s"]
    for row in section.table.rows:
        assert row[1] == pytest.approx(sum(row[2:]))


def test_a_row_of_events_has_the_name_of_its_model():
    """Catches letters in rows that nobody can tell apart."""
    section = time_to_quality.anytime_section(group(frontier(**SMALL)), canvas())
    rows = re.findall(r">([^<>]+)</text>", section.tabs[0].drawings[0].svg)
    assert {"3dgs", "4dgs"} <= set(rows)


def test_runs_of_another_length_are_left_out_and_that_is_said():
    """Catches a mean over runs of two lengths, and runs that a section drops without a word."""
    records = frontier(lengths=(500, 1000))
    of = group(records)
    mains = [r for r in records if r.variant == ""]
    said = "Shown: 30 runs with 1,000 iterations. 30 runs with other lengths or settings are left out."
    assert len(mains) == 30
    for section, alone in (
        (effects_section(records), effects_section(mains)),
        (worth.stages_section(of, canvas()), worth.stages_section(group(mains), canvas())),
        (time_to_quality.anytime_section(of, canvas()), time_to_quality.anytime_section(group(mains), canvas())),
        (pairs_section(records), pairs_section(mains)),
    ):
        assert section.notes[0] == said
        assert said not in alone.notes
    stages = worth.stages_section(of, canvas()).table.rows
    assert stages == worth.stages_section(group(mains), canvas()).table.rows


def test_a_time_beside_other_work_is_marked():
    """Catches an answer of 60 frames a second that was measured while another run slowed the machine."""

    def loaded(record, load, cpu_s):
        return dataclasses.replace(record, cost=dataclasses.replace(record.cost, load=load, train_cpu_s=cpu_s))

    records = [loaded(r, 1.2, r.cost.train_s) for r in frontier(("7dgs",), ("suzanne",), 2, (1000,))]
    assert "beside" not in " ".join(a.detail for a in answers(records))
    assert "beside" not in cost.basis_words(group(records), comparisons(group(records)))
    busy = [loaded(records[0], 2.1, records[0].cost.train_s), records[1]]
    *_, frames = answers(busy)
    assert frames.detail.startswith("1,000 iterations, 2.75 ms a frame (beside other work).")
    assert "measured while the machine was busy" in cost.basis_words(group(busy), comparisons(group(busy)))
    assert not is_beside_others(loaded(records[0], 2.1, 2 * records[0].cost.train_s)), "its own second thread"
    assert not is_beside_others(loaded(records[0], 2.4, None)), "a record without CPU-seconds has two threads"
    assert not is_beside_others(loaded(records[0], None, None))


def test_auto_is_explained_and_linked(small_page, tmp_path):
    """Catches a recommendation of a model that nobody knows from a paper, and a link to nothing."""
    records = frontier(("7dgs",), ("suzanne",), 2, (1000,))
    text = page([*records, *on_demand(records)], tmp_path)
    assert "auto is a model of gsbench" in Page(text).text
    assert '<a href="#g0-on-demand">What auto chose here</a>' in text
    assert "auto is a model" not in small_page.text


def test_a_table_shows_its_first_rows_and_links_all():
    """Catches a page that grows with every run, and a file that is cut like the page."""
    table = DataTable("t.csv", [Column("a", 1), Column("b")], [[i / 3, f"run {i}"] for i in range(500)])
    assert len(table.shown) == 60
    assert table.hidden == 440
    assert len(base64.b64decode(table.href.partition(",")[2]).decode().splitlines()) == 501
    assert table.shown[1] == ["0.3", "run 1"]


def test_the_command_writes_the_page(tmp_path, capsys):
    """Catches a command that forgets the page, and a page that is not self-contained."""
    folder = write_all(frontier(**SMALL), tmp_path, pictures=1)
    assert main([str(folder)]) == 0
    assert "report.html" in capsys.readouterr().out
    assert (folder / "report.html").stat().st_size < 2_000_000


def test_live_writes_again_when_a_record_arrives(tmp_path, capsys, monkeypatch):
    """Catches a loop that draws once, one that stops at a missing folder, and one that has no end."""
    records = frontier(("3dgs", "7dgs"), ("suzanne",), 1, (1000,))
    folder = tmp_path / "mini"
    steps = iter(
        [
            lambda: write_all(records[:1], tmp_path),
            lambda: write_all(records[1:], tmp_path),
            lambda: None,
        ]
    )
    pages = []

    def sleep(_):
        written = folder / "report.html"
        pages.append(written.read_text() if written.exists() else None)
        try:
            next(steps)()
        except StopIteration:
            raise KeyboardInterrupt from None

    monkeypatch.setattr(time, "sleep", sleep)
    assert live.watch(folder) == 0
    printed = capsys.readouterr().out.splitlines()
    assert "expected a folder of results" in printed[0]
    assert "1 records" in printed[1]
    assert "2 records" in printed[2]
    assert printed[-1].startswith("Stopped. 2 records")
    assert len(printed) == 5
    assert pages[0] is None
    assert 'data-reload="5"' in pages[1]
    assert pages[2] == pages[3]
    assert 'data-reload="0"' in (folder / "report.html").read_text()


@pytest.mark.slow
def test_five_thousand_records(tmp_path):
    """Catches a page that takes longer than 20 s or grows beyond 10 MB with the number of runs."""
    records = frontier(
        scenes=tuple(f"scene{i}" for i in range(10)), seeds=10, lengths=tuple(250 * i for i in range(1, 11))
    )
    assert len(records) == 5000
    start = time.process_time()
    text = build.render(records, tmp_path)
    assert time.process_time() - start < 20
    assert len(text.encode()) < 10_000_000


def test_a_view_without_a_number_is_left_out():
    """Catches a null of one view that empties the whole page."""
    records = frontier(**SMALL)
    records[0] = dataclasses.replace(records[0], per_view=[ViewScore("test/r_000"), *records[0].per_view[1:]])
    assert "significant" in pairs_section(records).sentences[1]


def test_hostile_is_hostile():
    """Catches a text that lost what it is to test."""
    assert len(HOSTILE) > 10_000
    assert "<script>" in HOSTILE


def test_the_papers_points_are_marked_as_other_hardware(tmp_path):
    """Catches the paper's seconds among ours without a word, on a stand-in of the same name, and at another size."""
    for dataset, size, expected in (
        ("D-NeRF", "400x400", True),
        ("mini", "400x400", False),
        ("D-NeRF", "80x80", False),
    ):
        of_paper = {"paper_dataset": "D-NeRF", "background": "black", "resolution": size}
        protocol = {**make().protocol, **of_paper}
        runs = [make(scene="trex", seed=s, psnr=31.0 + s, dataset=dataset, protocol=protocol) for s in range(2)]
        text = page(runs, tmp_path)
        assert ("the paper's number, on other hardware" in Page(text).text) == expected
        names = [run["name"] for run in json.loads(re.search(r'id="runs">(.*?)</script>', text, re.S)[1])]
        assert ("the paper's 7dgs on trex" in names) == expected


@pytest.mark.slow
def test_many_experiments_share_one_page(tmp_path):
    """Catches a page that grows with the experiments: single scenes are drawn only where there is room."""
    records = [dataclasses.replace(r, experiment=f"e{i}") for i in range(9) for r in frontier(("3dgs",), seeds=1)]
    text = page(records, tmp_path)
    assert len(text) < 2_000_000
    assert "have figures of their own; the table has all" in Page(text).text


def test_a_target_that_no_run_reached_has_no_profile(tmp_path):
    """Catches a division by no target after a first short run on the paper's data, whose 7DGS no run here reached."""
    protocol = {**make().protocol, "paper_dataset": "D-NeRF", "background": "black", "resolution": "400x400"}
    short = make(scene="trex", psnr=21.0, dataset="D-NeRF", protocol=protocol)
    section = time_to_quality.quality_section(group([short]), canvas())
    assert section.sentences == ["No finished run reached the target."]
    assert [row[1:] for row in section.table.rows] == [["paper's 7dgs", 30.72, math.inf]]
    assert section.tabs[0].drawings == []
    assert "never" in Page(page([short], tmp_path)).text
    small = dataclasses.replace(short, protocol={**protocol, "resolution": "100x100"})
    assert not any(target.rule == "paper's 7dgs" for target in targets(group([small])))


def test_zeros_and_single_points_can_be_drawn(tmp_path):
    """Catches a division by zero and a scale without extent: no seconds, no bytes, one view, one point of the curve."""
    nothing = dataclasses.replace(
        make().cost, train_s=0.0, stage_s={}, render_ms=dataclasses.replace(make().cost.render_ms, p50=0.0), bytes=0
    )
    runs = [make("3dgs"), make("4dgs")]
    runs = [dataclasses.replace(r, cost=nothing, curve=[Point(1, 0.0, 5.0)]) for r in runs]
    assert "never" not in Page(page(runs, tmp_path)).text


def test_records_that_are_left_out_are_named_on_the_page(tmp_path):
    """Catches a damaged record of which only the terminal knows."""
    folder = write_all(frontier(**SMALL), tmp_path)
    (folder / "damaged").mkdir()
    (folder / "damaged" / "record.json").write_text("{<script>")
    assert main([str(folder)]) == 1
    text = Page((folder / "report.html").read_text()).text
    assert "Left out" in text
    assert "damaged/record.json: expected JSON" in text


def test_a_variant_that_all_runs_share_is_said_once(tmp_path):
    """Catches names of models that all carry the same words, and a length that is said twice."""
    records = [dataclasses.replace(r, variant="iterations=1000,downscale=4") for r in frontier(**SMALL)]
    text = Page(page(records, tmp_path)).text
    assert "All runs have downscale=4. All runs have 1,000 iterations." in text
    assert "4dgs, iterations" not in text

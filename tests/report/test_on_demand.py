"""Effects on demand on the page: its words and numbers, that gated models stand apart, that texts stay texts."""

import base64
import csv
import dataclasses
import io
import re
from pathlib import Path

import pytest
from make_golden import make
from many_records import frontier, gates, hostile, on_demand, write_all
from test_page import Page, canvas, group

from gsbench.effects.messages import reason
from gsbench.measure.record import Candidate, ModelComparison, OnDemand, Record, TimeScreen
from gsbench.report import compare
from gsbench.report import frontier as points
from gsbench.report.comparisons import comparisons
from gsbench.report.configurations import groups
from gsbench.report.on_demand import decided
from gsbench.report.page import build, gallery, messages, worth
from gsbench.report.page import on_demand as page_part
from gsbench.report.page.palette import MODELS, styles

WHOLE = frontier(("7dgs",), ("suzanne",), 3, (1000,))
NOWHERE = Path("/nowhere")  # without pictures


def sentences(records: list[Record]) -> list[str]:
    """What the section says."""
    (of,) = groups(records)
    return page_part.on_demand_section(of, canvas(), NOWHERE).sentences


def test_one_seed_in_words():
    """Catches removed Gaussians of one gate only, a sign that is turned, and an interval of one seed."""
    (said,) = sentences(on_demand(WHOLE[:1]))
    assert said == (
        "On suzanne, auto kept time: a static model's error changes over time (p = 0.001). The gates left 700 of 1,000 "
        "Gaussians (70 %): 300 refined by AGR, 150 conditioned, 40 time frozen, 10 direction frozen and 200 static. "
        "AGR moves 75 % of its Gaussians in a frame; the others are invisible at its time. The gate after training "
        "changed PSNR on test by −0.020 dB, and a frame of 4.00 ms by −1.00 ms."
    )


def test_three_seeds_in_words():
    """Catches a mean that is a sum, and seeds without an interval."""
    (said,) = sentences(on_demand(WHOLE))
    assert said == (
        "On suzanne, auto kept time: a static model's error changes over time (p = 0.001); all 3 seeds agree. The "
        "gates left 710 of 1,000 Gaussians (71 %): 310 refined by AGR, 150 conditioned, 40 time frozen, 10 direction "
        "frozen and 200 static. AGR moves 75 % of its Gaussians in a frame; the others are invisible at its time. The "
        "gate after training changed PSNR on test by −0.030 dB (95 % −0.055 to −0.005 over seeds), and a frame of "
        "4.00 ms by −1.00 ms (95 % −1.00 to −1.00 over seeds)."
    )


def screened(record: Record, decision: str, reason: str = "so", **changes: object) -> Record:
    screen = TimeScreen(decision, reason, None, None, None, 0.5)
    return dataclasses.replace(record, on_demand=OnDemand(screen, **changes))


@pytest.mark.parametrize(
    ("old", "now"),
    [
        (
            "the images of each of 12 camera places differ, in 29% of their blocks, and with time (p = 0.001, z = 4.0)",
            "the images of each of 12 camera positions change over time, in 29% of their blocks (p = 0.001)",
        ),
        (
            "the images of the camera's place differ, in less than 1% of their blocks, but not by slow waves of time "
            "(p = 0.400, z = -0.2)",
            "the images of the camera's position differ in less than 1% of their blocks, but not clearly over time "
            "(p = 0.400)",
        ),
        (
            "what a static fit leaves over does not change with time (p = 0.310, z = 0.4, 99% of time's slow waves are "
            "free of the camera)",
            "a static model's error does not change over time (p = 0.310)",
        ),
        ("the views have no times", "the views have no times"),
    ],
)
def test_reasons_of_older_records_are_in_present_words(old, now):
    """Catches words that a page of published records keeps, as they are in the records."""
    assert reason(TimeScreen("on", old, None, None, None, 0.0)) == now


def test_a_comparison_of_models_is_said():
    """Catches a page that hides how a model was chosen, and seeds that chose another one."""
    tried = [Candidate("7dgs", 22.836, 9.0), Candidate("4dgs", 22.4, 8.0), Candidate("6dgs", None, 1.0, "a NaN")]
    runs = [
        screened(one, "on", comparison=ModelComparison(700, chosen, tried))
        for one, chosen in zip(on_demand(WHOLE), ("7dgs", "4dgs", "7dgs"), strict=True)
    ]
    assert sentences(runs) == [
        "On suzanne, auto kept time: so; all 3 seeds agree. PSNR on val after 700 iterations: 7dgs 22.84 dB, 4dgs "
        "22.40 dB, 6dgs failed; 7dgs is trained to the end; 4dgs with 1 seed. No Gaussian was changed."
    ]


def test_what_is_undecided_or_differs_is_said():
    """Catches a seed that decided otherwise and is not named, and a model that no gate changed but has a bar."""
    one, two, three = on_demand(WHOLE)
    runs = [screened(one, "undecided", "the camera moves"), screened(two, "off"), screened(three, "undecided")]
    assert sentences(runs) == [
        "On suzanne, auto kept time, because the test cannot decide: the camera moves; off with 1 seed. "
        "No Gaussian was changed."
    ]
    (of,) = groups(runs)
    section = page_part.on_demand_section(of, canvas(), NOWHERE)
    assert section.tabs == []
    assert section.swatches == []
    mixed = [runs[0], two, three]
    assert "The gates left 715 of 1,000 Gaussians (72 %) with 2 of 3 seeds" in sentences(mixed)[0]


def test_a_loss_that_was_not_evaluated_is_that_of_the_check():
    """Catches a number on val that is called one on test, and seconds of another machine."""
    (run,) = on_demand(WHOLE[:1])
    plain = [dataclasses.replace(g, eval_loss_db=None, checked_on="held-out training views") for g in gates()]
    run = dataclasses.replace(run, on_demand=OnDemand(None, plain))
    said = "PSNR on held-out training views by −0.030 dB, and a frame of 4.00 ms by −1.00 ms."
    assert said in sentences([run])[0]
    other = dataclasses.replace(run.provenance, device="another machine")
    elsewhere = dataclasses.replace(run, provenance=other, seed=9)
    assert "a frame of" not in sentences([*WHOLE, dataclasses.replace(elsewhere, model="auto")])[0]
    only_in_training = dataclasses.replace(run, on_demand=OnDemand(None, gates()[:1]))
    assert sentences([only_in_training])[0].endswith("500 refined by AGR, 200 conditioned and 100 static.")


def test_the_table_has_what_the_figure_shows():
    """Catches a bar and a file that tell different numbers, and waves that are not counted with their degree."""
    (of,) = groups(on_demand(WHOLE))
    section = page_part.on_demand_section(of, canvas(), NOWHERE)
    text = base64.b64decode(section.table.href.partition(",")[2]).decode()
    (row,) = csv.DictReader(io.StringIO(text))
    assert (row["scene"], row["model"], row["variant"], row["seeds"], row["time"]) == (
        "suzanne", "auto", "none", "3", "on 3",
    )  # fmt: skip
    counts = {"refined by AGR": 310, "conditioned": 150, "time frozen": 40, "direction frozen": 10, "static": 200}
    counts |= {
        "% of AGR left out of a frame": 25,
        "removed": 290,
        "degree 0": 350,
        "degree 1": 50,
        "degree 2": 100,
        "degree 3": 210,
    }
    assert {name: float(row[name]) for name in counts} == counts
    assert [float(row[name]) for name in ("MB before", "MB", "predicted dB", "PSNR dB")] == [0.4, 0.2, -0.04, -0.03]
    classes, degrees = (drawing.svg for drawing in section.tabs[0].drawings)
    assert "710 of 1,000" in classes
    for name in ("7dgs", "7dgs_noagr", "6dgs", "4dgs", "3dgs"):
        assert f"var(--model-{MODELS.index(name)})" in classes
    assert "mean degree 1.2" in degrees
    assert [f"{one.name}: {one.variable}" for one in section.swatches] == [
        "refined by AGR: model-3", "conditioned: model-4", "time frozen: model-2", "direction frozen: model-1",
        "static: model-0", "removed: line", "degree 0: stage-3", "degree 1: stage-2", "degree 2: stage-1",
        "degree 3: stage-0",
    ]  # fmt: skip


def test_a_page_without_choices_says_nothing(tmp_path):
    """Catches an empty section, or a link to one."""
    assert page_part.on_demand_section(group(WHOLE), canvas(), tmp_path) is None
    text = build.render(WHOLE, tmp_path)
    assert "Effects on demand" not in text
    assert "on-demand" not in text
    assert "Effects on demand" in Page(build.render([*WHOLE, *on_demand(WHOLE)], tmp_path)).text


def test_notes_are_listed_once():
    """Catches a note that is lost, or repeated for every seed."""
    runs = [dataclasses.replace(r, on_demand=OnDemand(None, gates(), ["few <b>views</b>"])) for r in on_demand(WHOLE)]
    (of,) = groups(runs)
    notes = page_part.on_demand_section(of, canvas(), NOWHERE).notes
    assert notes == ["suzanne, auto, seeds 0, 1 and 2: few <b>views</b>", page_part.IN_TRAINING]
    assert "few <b>views</b>" in Page(build.render(runs, NOWHERE)).text
    many = [dataclasses.replace(r, on_demand=OnDemand(None, [], [f"{i}" for i in range(50)])) for r in runs]
    (of,) = groups(many)
    notes = page_part.on_demand_section(of, canvas(), NOWHERE).notes
    assert len(notes) == 13
    assert notes[-1] == "and 38 more notes."


def test_hostile_choices_stay_text(tmp_path):
    """Catches markup in reasons, notes and names of classes, and numbers that break a drawing."""
    seen = Page(build.render(hostile(), tmp_path))
    part = seen.text[seen.text.index("suzanne, 7dgs decided") : seen.text.rindex("Where the seconds go")]
    assert "<script>document.title='owned'</script>" in part
    assert "and 41 more notes." in part
    assert not [name for name, _ in seen.attributes if name.startswith("on")]
    assert "x" * 400 not in part
    assert "\u202e" not in part


def test_lengths_stay_apart_in_labels_and_only_the_common_one_is_told():
    """Catches bars of one name, whose ends were cut off, and a wall of sentences that differ in a length."""
    runs = on_demand(frontier(("7dgs",), ("moving-matte",), 2, (250, 1000, 2000, 4000)))
    section = page_part.on_demand_section(group(runs), canvas(), NOWHERE)
    drawn = section.tabs[0].drawings[0].svg
    assert all(f"iterations={n}" in drawn for n in (250, 2000, 4000))
    assert len(section.sentences) == 2
    assert section.sentences[0].startswith("On moving-matte, auto kept time: ")
    assert section.sentences[1] == "These are 1 of 4 results; the table has all."


def test_many_choices_are_cut(tmp_path):
    """Catches a section that grows with the scenes."""
    runs = on_demand(frontier(("7dgs",), tuple(f"s{i}" for i in range(30)), 1, (1000,)))
    section = page_part.on_demand_section(group(runs), canvas(), tmp_path)
    assert len(section.sentences) == 13
    assert section.sentences[-1] == "These are 12 of 30 results; the table has all."
    assert "The figures have 24 of 30 rows; the table has all." in section.notes
    assert len(section.table.rows) == 30


def test_pictures_by_class_are_part_of_the_page(tmp_path):
    """Catches a picture that stays beside the page, one of another run, and more of them than fit."""
    runs = [*WHOLE, *on_demand(WHOLE)]
    folder = write_all(runs, tmp_path, pictures=1)
    section = page_part.on_demand_section(group(runs), canvas(), folder)
    (image,) = section.images
    assert (image.caption, image.width, image.height) == ("suzanne, auto", 912, 120)
    text = build.render(runs, folder)
    assert text.count(image.source) == 1
    assert 'alt="suzanne, auto: the image beside its Gaussians by effect set"' in text
    for picture in folder.glob("suzanne/auto/*/effect_sets.png"):
        picture.rename(picture.with_name("classes.png"))  # as runs of before have it
    assert page_part.on_demand_section(group(runs), canvas(), folder).images == [image]
    (folder / "suzanne" / "auto" / "seed0" / "effect_sets.png").write_bytes(b"damaged")
    assert page_part.on_demand_section(group(runs), canvas(), folder).images == []


def test_pictures_by_class_keep_to_their_budget(tmp_path, monkeypatch):
    """Catches pictures that make the page too large: noise compresses worst."""
    runs = on_demand(frontier(("7dgs",), ("a", "b", "c"), 1, (1000,)))
    folder = write_all(runs, tmp_path, pictures=1)
    at = sorted(gallery.places(folder, "effect_sets.png").values())
    whole = [len(one.source) for one in gallery.images([(str(path), path) for path in at])]
    assert len(whole) == 3
    monkeypatch.setattr(gallery, "IMAGES_BUDGET", sum(whole) // 3)
    few = gallery.images([(str(path), path) for path in at])
    assert 1 <= len(few) < 3
    assert sum(len(one.source) for one in few) <= sum(whole) // 3


def test_gated_models_have_frontiers_of_their_own(tmp_path):
    """Catches gated runs that are points of the ungated model's frontier, and lengths that are told apart by it."""
    whole = frontier(("7dgs", "3dgs"), ("suzanne",), 3, (500, 1000))
    full = [r for r in whole if r.model == "7dgs"]
    runs = [*whole, *on_demand(full), *on_demand(full, label="7dgs")]
    of = group(runs)
    assert of.series == ["3dgs", "7dgs", "7dgs, gate=both", "auto"]
    found = points.points(of, ["suzanne"])
    assert {p.series: len([q for q in found if q.series == p.series]) for p in found} == dict.fromkeys(of.series, 2)
    text = Page(build.render(runs, tmp_path)).text
    assert "7dgs, gate=both" in text
    look = styles(of.series)
    assert len({(s.colour, s.marker) for s in look.values()}) == 4
    assert look["auto"].colour == MODELS.index("auto")


def test_what_was_gated_alike_keeps_its_name():
    """Catches a model that is called gated where nothing was not, and the default of model=auto as a word."""
    of = group([*on_demand(WHOLE, label="7dgs")])
    assert of.series == ["7dgs"]
    both = [*on_demand(WHOLE), *on_demand(WHOLE, label="7dgs")]
    assert group(both).series == ["7dgs, gate=both", "auto"]


def test_gated_models_price_no_effect():
    """Catches the price of AGR from a model of which half the Gaussians have none."""
    runs = frontier(("7dgs", "7dgs_noagr"), ("suzanne",), 3, (1000,))
    bare = [r for r in runs if r.model == "7dgs_noagr"]
    gated = on_demand([r for r in runs if r.model == "7dgs"])
    mixed, both = group([*bare, *gated]), group([*runs, *gated])
    assert compare.cube(mixed, comparisons(mixed)).prices == []
    cube = compare.cube(both, comparisons(both))
    assert [p.models for p in cube.prices] == ["7dgs − 7dgs_noagr"]
    notes = worth.effects_section(both, comparisons(both), canvas()).notes
    assert "Left out, because each Gaussian keeps only the effects that it needs: auto." in notes


def test_nothing_is_measured_where_nothing_was_chosen():
    """Catches runs without choices among those that the numbers are means of."""
    without = dataclasses.replace(on_demand(WHOLE)[0], on_demand=None)
    (found,) = decided(group([without, *on_demand(WHOLE)[1:]]))
    assert [r.seed for r in found.runs] == [1, 2]
    assert decided(group([make()])) == []


def test_a_change_that_rounds_to_nothing_has_no_sign():
    """Catches a minus before zero."""
    assert [messages.signed(x) for x in (-0.001, 0.0, 0.001, -0.01, 0.01)] == ["0.00", "0.00", "0.00", "−0.01", "+0.01"]


def test_the_command_line_for_a_gated_run_names_it(tmp_path):
    """Catches a card of a gated point without its command."""
    text = build.render([*WHOLE, *on_demand(WHOLE, label="7dgs")], tmp_path)
    assert re.search(r"7dgs, gate=both, suzanne, 3 seeds", text)


def test_a_gated_model_is_told_apart_from_the_ungated_one(tmp_path):
    """Catches pairs that leave out the one a reader of gates asks for."""
    text = Page(build.render([*WHOLE, *on_demand(WHOLE, label="7dgs")], tmp_path)).text
    assert re.search(r"7dgs \(gate=both\S*\) − 7dgs\b|7dgs − 7dgs \(gate=both", text)

"""Runs of several people as one set: what is told apart, counted once, refused, and the site that is made of them."""

import dataclasses
import re
from pathlib import Path

import pytest
from parsed_page import Page
from records import HOSTILE, but, elsewhere, frontier, lost, make, on_demand
from tiny_run import ROOT

from gsbench.errors import InputError
from gsbench.measure.record import Record, ViewScore
from gsbench.report import contributors, merge, study
from gsbench.report.__main__ import main
from gsbench.report.sections.experiment import table

OTHER_COMMIT = {"git_commit": "ab" * 20}
SCENES = ("suzanne", "moving-matte")


def published(root: Path, **people: list[Record]) -> list[Path]:
    for name, records in people.items():
        study.write(records, root / name)
    return [root / name for name in people]


def runs_of(model: str, psnr: float, **changes) -> list[Record]:
    """Runs of a model on two scenes with three seeds; `changes` as in `but`."""
    return [
        but(make(model, scene, seed, psnr + seed / 10), **changes)
        for scene, seed in ((scene, seed) for scene in SCENES for seed in range(3))
    ]


def alice() -> list[Record]:
    return [*runs_of("3dgs", 20.0), *runs_of("4dgs", 24.0), *runs_of("7dgs", 26.0)]


def tables(folders: list[Path]) -> dict[str, list[dict[str, object]]]:
    """The rows of the result table of each experiment, by what its protocol is called."""
    chapters = merge.read(folders).chapters()
    return {chapter.runs.protocol.iloc[0]: table(chapter, []).table.to_dict("records") for chapter in chapters}


def test_runs_of_other_people_commits_and_machines_are_rows_of_their_own(tmp_path):
    """Catches a mean over two people, two commits or two machines, seconds that are lost or ranked across machines, a
    row without its commit or machine, an average over other scenes than a row beside it has, and a variant in every
    name that all share."""
    bob = runs_of("7dgs", 28.0, provenance=OTHER_COMMIT | {"device": "GPU"}, cost={"train_s": 6.0}, curve=[])
    bob = [r for r in bob if r.scene == "suzanne"]
    carol = runs_of("7dgs", 30.0)
    carol[0] = but(carol[0], provenance=OTHER_COMMIT)
    people = {"alice": alice(), "bob": bob, "carol": carol}
    people = {who: [dataclasses.replace(r, variant="iterations=9") for r in of] for who, of in people.items()}
    (rows,) = tables(published(tmp_path, **people)).values()
    for row in (row for row in rows if row["scene"] in SCENES):
        same = [
            (r.metrics["psnr"], r.cost.train_s / 60)
            for r in people[row["contributor"]]
            if (r.model, r.scene) == (row["model"], row["scene"])
            if (r.provenance.machine, r.provenance.git_commit[:12]) == (row["machine"], row["git_commit"])
        ]
        means = [sum(values) / len(same) for values in zip(*same, strict=True)]
        assert (row["psnr_db"], row["train_min"]) == pytest.approx(means)
    named = [(row["scene"], row["model"], row["contributor"], row["seeds"]) for row in rows]
    assert ("suzanne", "7dgs", "carol", 2) in named or ("moving-matte", "7dgs", "carol", 2) in named
    averages = [(of, who) for scene, of, who, _ in named if scene.startswith("average over 2 of 2")]
    assert averages == [("3dgs", "alice"), ("4dgs", "alice"), ("7dgs", "alice"), ("7dgs", "carol")]
    assert {row["machine"] for row in rows if row["contributor"] == "bob"} == {"GPU, 2 threads"}
    assert "train_min rank" not in rows[0]
    best = {(row["scene"], row["contributor"]) for row in rows if row["psnr_db rank"] == 1}
    assert ("suzanne", "carol") in best


def test_protocols_and_data_are_with_distinct_names(tmp_path):
    """Catches a table with two backgrounds, and a scene whose images two people have otherwise, under one name."""
    white, black = ([but(r, protocol={"background": b}) for r in runs_of("4dgs", 24.0)] for b in ("white", "black"))
    recoded = [but(r, provenance={"data_hash": "ff" * 32}) if r.scene == "suzanne" else r for r in black]
    by_protocol = tables(published(tmp_path, alice=white, bob=black, carol=recoded))
    assert [re.search("background (.*?),", protocol)[1] for protocol in by_protocol] == ["black", "white"]
    of_white, of_black = (by_protocol[name] for name in sorted(by_protocol, reverse=True))
    assert {row["contributor"] for row in of_white} == {"alice"}
    who = {row["scene"]: set() for row in of_black}
    for row in of_black:
        who[row["scene"]].add(row["contributor"])
    assert who["suzanne (data 5e5e5e5e)"] == {"bob"}
    assert who["suzanne (data ffffffff)"] == {"carol"}
    # The rest of carol's runs are bob's, number for number.
    assert who["moving-matte"] == {"bob"}
    silent = [but(r, protocol={"resize": "area", "paper_dataset": "other"}) for r in white]
    assert len(tables(published(tmp_path, dora=white, eve=silent))) == 1


def test_a_run_that_two_publish_counts_once_and_other_numbers_are_told(tmp_path):
    """Catches a run that counts twice or hides one of other numbers, and a repetition that passes for the same run."""
    first, second, third = runs_of("4dgs", 24.0)[:3]
    elsewhere_run = but(second, provenance={"device": "GPU"}, cost={"train_s": 100.0})
    forged = but(third, metrics={"ssim": 0.95})
    forged = dataclasses.replace(forged, per_view=[dataclasses.replace(v, ssim=0.95) for v in forged.per_view])
    longer = but(
        make("3dgs", seed=7), provenance=OTHER_COMMIT | {"config": {"train": {"iterations": 9}}}, metrics={"psnr": 25.0}
    )
    folders = published(
        tmp_path, alice=[first, second, third, make("3dgs")], bob=[first, elsewhere_run, forged, longer]
    )
    results = merge.read(folders)
    assert results.runs.contributor.tolist().count("alice") == 4
    assert results.runs[results.runs.published_by == "alice, bob"].seed.tolist() == [first.seed]
    people, conflicts, trainings = contributors.sections(results)
    shown = people.table.set_index("contributor")[["runs", "earlier", "repeats", "equal"]].T.to_dict("list")
    assert shown == {"alice": [4, 0, 2, 1], "bob": [4, 1, 2, 1]}
    (row,) = conflicts.table.to_dict("records")
    assert (row["seed"], row["machine"], row["also differs in"]) == (str(third.seed), "the same", "ssim")
    (row,) = trainings.table.to_dict("records")
    assert row["settings of the second"] == "train.iterations 9 instead of 1000"


def test_trainings_of_each_variant_are_compared(tmp_path):
    """Catches a second variant that is not looked at where the first is the same training."""
    alice = [make("3dgs"), make("3dgs", variant="ablation=schur")]
    bob = [but(alice[0], provenance=OTHER_COMMIT), but(alice[1], provenance={"config": {"train": {"iterations": 9}}})]
    *_, trainings = contributors.sections(merge.read(published(tmp_path, alice=alice, bob=bob)))
    assert trainings.table.model.tolist() == ["3dgs ablation=schur"]


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (lost(make(seed=9)), "failed: out of memory"),
        (but(make(seed=9), provenance={"git_commit": "0123-dirty"}), "its commit is 0123-dirty"),
        (but(make(seed=9), provenance={"git_commit": HOSTILE}), "which does not reproduce it"),
        (but(make(seed=9), protocol={"background": HOSTILE}), "protocol: expected at most 300 characters"),
    ],
)
def test_what_nobody_can_repeat_is_left_out_in_a_line(bad, reason, tmp_path):
    """Catches a made-up or unfinished run that ranks among others, and one that keeps everyone else's out."""
    results = merge.read(published(tmp_path, alice=[make()], mallory=[make(seed=1), bad]))
    assert results.runs.seed.tolist() == [0, 1]
    (fault,) = results.faults
    assert str(tmp_path / "mallory/runs.csv") in fault
    assert reason in fault
    assert fault.isprintable()


def test_own_published_runs_are_plausible():
    """Catches bounds that refuse runs that were measured."""
    assert merge.read([ROOT / "results/published/static"]).faults == ()


def test_folders_name_their_contributors(tmp_path):
    """Catches two people under one name, and a folder that counts twice."""
    paths = [tmp_path / name for name in ("alice/mini", "bob/mini", "bob/.x", "bob/a b")]
    for path in paths:
        study.write([make()], path)
    assert [*merge.contributors(paths[:1])] == ["mini"]
    assert [*merge.contributors(paths[:2])] == ["alice/mini", "bob/mini"]
    assert [*merge.contributors([paths[0], paths[2]])] == ["mini", ".x"]
    assert [*merge.contributors([Path("/mini"), Path("/alice/mini")])] == ["mini", "alice/mini"]
    for folders in ([tmp_path, paths[0]], [paths[0], paths[0]]):
        with pytest.raises(InputError, match="expected folders apart from each other"):
            merge.contributors(folders)
    with pytest.raises(InputError, match="expected a name of letters"):
        merge.contributors(paths[3:])


def people() -> dict[str, list[Record]]:
    """Runs of two people, and of one whose texts attack the pages."""
    runs = frontier(("3dgs", "7dgs"), ("suzanne",), 1, (1000,), views=3)
    bob = [but(r, provenance=OTHER_COMMIT) for r in on_demand(runs[-1:])]
    mallory = but(
        make("4dgs"),
        dataset=HOSTILE,
        protocol={"name": "<b>&|`=1", "eval_split": "=2+2"},
        overrides=[HOSTILE],
        provenance={"data_hash": "=1+1", "device": HOSTILE},
        per_view=[ViewScore(HOSTILE, 25.0, 25.1)],
    )
    return {"alice": [*runs, elsewhere(runs[0], "other")], "bob": bob, "mallory": [mallory]}


def test_the_command_writes_a_site(tmp_path, capsys):
    """Catches an experiment without a page, a page that no link leads to, and a contributor's markup or formula."""
    folders, site = published(tmp_path, **people()), tmp_path / "site"
    assert main([str(site), "--merge", *map(str, folders)]) == 0
    out = capsys.readouterr().out
    assert str(site / "index.html") in out
    assert "Contributors" in out
    pages = {path.name: Page(path.read_text()) for path in site.glob("*.html")}
    for name, page in pages.items():
        assert not [attribute for attribute, _ in page.attributes if attribute.startswith("on")]
        assert "<img src=x" not in (site / name).read_text()
        assert {*page.pages} == ({*pages} - {name} if name == "index.html" else {"index.html"})
    of_mini = [page.text for name, page in pages.items() if name != "index.html" and "Every run" in page.text]
    assert len(of_mini) == len(pages) - 1 == 3
    assert len((site / "index.html").read_text()) < 500_000, "it has no charts, and so not their library"
    assert not [line for line in (site / "table.csv").read_text().splitlines() if re.search(r"(^|,)[=+@]", line)]
    assert "<script" not in (site / "table.md").read_text()


def test_other_forms_take_a_merged_set(tmp_path, capsys):
    """Catches --json and --select that know one folder only, and options that cannot go together."""
    folders = [str(path) for path in published(tmp_path, alice=[make()], bob=[make("6dgs")])]
    assert main(["nothing", "--json", "--merge", *folders]) == 0
    assert '"contributor": "bob"' in capsys.readouterr().out
    assert main(["nothing", "--select", "model=6dgs", "--merge", *folders]) == 0
    assert "alice" not in capsys.readouterr().out.partition("Protocol")[0]
    assert main(["nothing", "--merge", str(tmp_path / "nobody")]) == 2
    assert "nobody: expected a folder of results" in capsys.readouterr().err
    for words in (
        ["--publish", "x", "--merge", *folders],
        *(["--train", each, "x"] for each in ("--publish", "--against")),
    ):
        with pytest.raises(SystemExit):
            main(["nothing", *words])
    assert not Path("nothing").exists()

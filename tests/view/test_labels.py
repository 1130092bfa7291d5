"""Labels of the viewer's images: short names of runs, what was measured, where a label is written."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gsbench.measure import record
from gsbench.run.load import LoadedRun, load_run
from gsbench.view.labels import labelled, measurements, short_names

ROWS = "7dgs", "18.48 dB PSNR on test", "4,187 Gaussians"


@pytest.fixture(scope="module")
def run(folder: Path) -> LoadedRun:
    return load_run(folder)


@pytest.fixture(scope="module")
def other(other_folder: Path) -> LoadedRun:
    return load_run(other_folder)


@pytest.mark.parametrize(
    ("folders", "names"),
    [
        (["r/mini/s/7dgs/seed0"], ["7dgs"]),
        (["r/mini/s/7dgs,iterations=200/seed0"], ["7dgs"]),
        (["r/mini/s/7dgs/seed0", "r/mini/s/7dgs/seed1"], ["7dgs seed0", "7dgs seed1"]),
        (
            ["r/mini/s/7dgs/seed0", "r/mini/s/7dgs,sh_degree=1,iterations=9/seed0"],
            ["7dgs", "7dgs sh_degree=1 iterations=9"],
        ),
        (
            ["r/mini/s/7dgs,sh_degree=1,iterations=9/seed0", "r/mini/s/7dgs,iterations=9/seed1"],
            ["7dgs sh_degree=1", "7dgs"],
        ),
        (["r/mini/s/7dgs/seed0", "r/frontier/s/7dgs/seed0"], ["7dgs mini", "7dgs frontier"]),
        (["r/a", "r/b"], ["7dgs a", "7dgs b"]),
        (["r/a", "r/a"], ["r/a", "r/a"]),
    ],
)
def test_names_are_what_distinguishes_runs(folders, names, run, other):
    """Catches a name that all runs have, two runs with one name, and words beside models that differ."""
    assert short_names([replace(run, folder=Path(folder)) for folder in folders]) == names
    models = {"7dgs": run, "4dgs": other}
    named = [replace(loaded, folder=Path(f"r/s/{name},iterations=9/seed0")) for name, loaded in models.items()]
    assert short_names(named) == list(models)


def test_a_label_says_what_was_measured(run, tmp_path):
    """Catches numbers of another run, a size in other units than the report's, and a record that hides a failure."""
    kept = record.read(run.folder / record.FILE_NAME)
    assert kept.metrics is not None
    assert kept.cost is not None
    rows = (
        f"{kept.metrics['psnr']:.2f} dB PSNR on test",
        f"{kept.cost.num_gaussians:,} Gaussians",
        f"{kept.cost.bytes / 1e6:.2f} MB",
    )
    assert measurements(run) == (*rows, "20 iterations")
    interrupted = replace(run, step=7, folder=tmp_path)
    assert measurements(interrupted) == ("no PSNR on test yet", *rows[1:], "7 of 20 iterations")
    copy = tmp_path / record.FILE_NAME
    shutil.copy(run.folder / record.FILE_NAME, copy)
    plain = json.loads(copy.read_text())
    plain["metrics"]["psnr"], plain["missing"]["psnr"] = None, "not a number"
    copy.write_text(json.dumps(plain))
    assert measurements(interrupted)[0] == "no PSNR on test"
    plain["metrics"]["psnr"] = 99.0  # not the mean of its views
    del plain["missing"]["psnr"]
    for text in ("{}", json.dumps(plain)):
        copy.write_text(text)
        assert measurements(interrupted)[0] == "record.json is not valid"


@pytest.mark.parametrize("grey", [0, 128, 255])
def test_each_side_of_the_edge_has_its_label(grey):
    """Catches swapped labels, one that covers the line or the picture, and ink that cannot be seen on a background."""
    image = np.full((300, 600, 3), grey, np.uint8)
    both = labelled(image, 300, ROWS, (*ROWS, "a fourth row"))
    assert (image == grey).all()
    changed = (both != grey).any(-1) | (grey == 0) & (both > 0).any(-1)
    left, right = changed[:, :299], changed[:, 301:]
    assert not changed[:, 299:301].any()
    assert 0 < left.any(1).sum() < right.any(1).sum() < 100  # rows of pixels
    assert not left[:, :100].any()
    assert not right[:, -100:].any()
    assert both.max() == 255
    assert np.median(both[:20, 301:400]) <= 90  # paper
    equal = labelled(np.zeros((300, 600, 3), np.uint8), 600, ("words", "words"))[..., 0].astype(float).sum(1)
    middle = np.flatnonzero(equal)[[0, -1]].sum() // 2
    assert equal[:middle].sum() > 1.1 * equal[middle:].sum()  # the first row is bold
    alone = labelled(image, 600, ROWS)
    assert (alone[:, :400] == grey).all()
    assert (alone[:, 599 - 299 : 599] == both[:, :299]).all() or (alone[:, 400:599] == both[:, 100:299]).all()


def test_labels_are_cut_at_the_border_and_keep_their_size_on_the_screen():
    """Catches an index out of the image, and labels that jump when the resolution falls."""
    for height, width, edge in ((300, 600, 0), (300, 600, 600), (300, 600, 20), (5, 5, 2), (1, 1, 1), (900, 2, 1)):
        assert labelled(np.zeros((height, width, 3), np.uint8), edge, ROWS, ROWS).shape == (height, width, 3)
    tall = [
        float((labelled(np.full((n, 2 * n, 3), 255, np.uint8), n, ROWS, ROWS) != 255).any((1, 2)).sum()) / n
        for n in (300, 600, 1200)
    ]
    assert tall == pytest.approx([tall[0]] * 3, rel=0.05)

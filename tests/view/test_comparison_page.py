"""The page that compares two runs: what it shows, that it needs nothing else, and what is asked wrong."""

import html
import re
from dataclasses import replace

import pytest

from gsbench.errors import InputError
from gsbench.measure import record
from gsbench.measure.exact_views import MOST_PSNR
from gsbench.run.load import load_run, scene_of
from gsbench.run.setup import evaluated_views
from gsbench.view import comparison_page
from gsbench.view.__main__ import main
from gsbench.view.comparison_page import write_page
from gsbench.view.frame import FrameRenderer, FrameRequest


def test_it_shows_both_runs_and_their_errors(folder, other_folder, tmp_path):
    """Catches runs that are swapped, a PSNR that is not the record's, a missing image, and a request of the network."""
    path = tmp_path / "a.html"
    assert main([str(folder), str(other_folder), "--page", str(path)]) == 0
    text = path.read_text()
    scores = [record.read(run / record.FILE_NAME).per_view for run in (folder, other_folder)]
    shown = re.findall(r"<figcaption>error of (\w+).*?, ([\d.]+) dB", text)
    names = ("7dgs", "4dgs")
    expected = [(names[i], f"{pair[i].psnr:.2f}") for pair in zip(*scores, strict=True) for i in (0, 1)]
    assert shown == expected
    assert text.count('<img src="data:image/png;base64,') == 6 * len(scores[0])
    assert text.count('type="range"') == len(scores[0])
    assert not re.search(r"https?://|<script", text)
    assert [*tmp_path.iterdir()] == [path]


def test_names_are_escaped(folder, other_folder, tmp_path):
    """Catches a page that runs what a record of others names its scene."""
    run, other = load_run(folder), load_run(other_folder)
    bad = "<script>alert(1)</script>"
    run = replace(run, scene=replace(run.scene, name=bad))
    write_page([run, other], tmp_path / "a.html")
    assert bad not in (tmp_path / "a.html").read_text()
    assert html.escape(bad) in (tmp_path / "a.html").read_text()


def test_a_view_rendered_exactly_leaves_the_mean_finite(folder, tmp_path, monkeypatch):
    """Catches one empty view by which the mean of all is infinite, and a model that is "0.00 dB better"."""
    run = load_run(folder)
    views = evaluated_views(scene_of(run), run.config.scene.eval_split)
    renderer = FrameRenderer(run, "7dgs", 1.0)
    exact = replace(views[0], pixels=renderer.image(views[0].camera, FrameRequest(views[0].time)))
    monkeypatch.setattr(comparison_page, "evaluated_views", lambda *_: [exact, *views[1:]])
    write_page([run, run], tmp_path / "a.html")
    text = (tmp_path / "a.html").read_text()
    assert f"{MOST_PSNR:.2f} dB" in text
    assert not re.search(r"\b(inf|nan)\b", text)
    assert text.count("equal PSNR") == len(views)
    assert "better" not in text


def test_what_cannot_be_compared_is_refused(folder, other_folder, tmp_path):
    """Catches images of two scenes beside each other, and a third run that is left out without a word."""
    run, other = load_run(folder), load_run(other_folder)
    with pytest.raises(InputError, match="expected two runs"):
        write_page([run], tmp_path / "a.html")
    elsewhere = replace(other, scene=replace(other.scene, fingerprint="0"))
    with pytest.raises(InputError, match="runs of one scene"):
        write_page([run, elsewhere], tmp_path / "a.html")
    for name in ("nowhere/a.html", "a.png", "a"):
        assert main([str(folder), str(other_folder), "--page", str(tmp_path / name)]) == 2
    assert [*tmp_path.iterdir()] == []

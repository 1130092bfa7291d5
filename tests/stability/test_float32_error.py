"""How exact a model's images are: the numbers of the command and of a record, what is written and what is refused."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from tiny_run import main_here, overrides, write_moving_square
from tiny_training import compose, moving_square

from gsbench import kernels
from gsbench.errors import InputError
from gsbench.measure.images import inferno
from gsbench.models import CameraTime, GaussianModel, build
from gsbench.models.cameras import around
from gsbench.models.render import render
from gsbench.raster.exact import ExactImage
from gsbench.run import setup
from gsbench.run.load import load_run
from gsbench.scenes import Points, View
from gsbench.scenes.gaussian_ply import TrainedGaussians, ply_of
from gsbench.stability import __main__ as stability
from gsbench.stability import float32_error, report
from gsbench.stability.__main__ import Subject, main
from gsbench.stability.float32_error import Culprit, Exactness, ViewExactness, float64_camera
from gsbench.train.batches import generator

pytestmark = pytest.mark.skipif(not kernels.available(), reason="the kernels are not built")
BLACK = (0.0, 0.0, 0.0)
REPORT = """\
a run: 20 Gaussians. Pixel values are in steps of 8 bits (1/255).

| view | largest error | RMS | largest bound | median bound | undecided pixels | PSNR, dB | \
changed by float32 | at most |
| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |
| front | 5.0e-01 | 2.5e-04 | 1.0e+00 | 1.2e-01 | 25.00 % | 30.0000 | -1.0e-04 | 2.0e-04 |
| back | 1.0e-01 | 5.0e-05 | 2.0e-01 | 1.0e-02 | 0.00 % | - | - | - |

Gaussians that add most to the bounds:

| Gaussian | view | pixels | sum of their bounds | why |
| --- | ---: | ---: | ---: | ---: |
| 7 | front | 12 | 3.5 | flat, far, huge, opaque, skipped, stopped, order |
| 3 | back | 1 | 0.5 | - |

flat: its shortest axis is below 1/1000 of its longest.
far: rounding of world coordinates moves its mean by more than 1/1000 pixel.
huge: it covers more than the image.
opaque: its opacity is above 0.99.
skipped: rounding may decide whether its alpha reaches 1/255, in the pixels with most of its share.
stopped: rounding may decide whether a pixel ends before it.
order: its depth equals another one's within rounding.

Float32 changes the mean PSNR by 5.0e-05 dB, that of one view by 1.0e-04 dB. Rounding to 8 bits changes an image \
1,155 times as much as float32 (RMS of the worst view)."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished run of 7DGS."""
    root = tmp_path_factory.mktemp("exact")
    assert main_here(*overrides(write_moving_square(root / "data"), root / "results", "model=7dgs", "agr=false")) == 0
    return next(path.parent for path in root.rglob("checkpoint.pt"))


def write_ply(path: Path, spread: float = 1.0, count: int = 10) -> Path:
    """A PLY of Gaussians around the origin."""
    g = torch.Generator().manual_seed(0)
    fields = {
        "means": spread * torch.randn(count, 3, generator=g),
        "log_scales": torch.full((count, 3), -1.0),
        "quats": torch.randn(count, 4, generator=g),
        "logits": torch.zeros(count),
        "dc": torch.randn(count, 3, generator=g),
        "rest": torch.zeros(count, 15, 3),
    }
    path.write_bytes(ply_of(TrainedGaussians(**fields)))
    return path


# ---- the command


def test_a_run_is_measured_in_its_test_views(run, capsys):
    """Catches other views than those of the record, another PSNR than it, and an error that its bound does not hold.
    Also a picture that --json writes into the run's folder, which may be read-only, and one that is missing."""
    (run / "exactness.png").unlink(missing_ok=True)
    content = set(run.iterdir())
    assert main([str(run), "--json"]) == 0
    assert set(run.iterdir()) == content
    numbers = json.loads(capsys.readouterr().out)
    record = json.loads((run / "record.json").read_text())
    assert [view["name"] for view in numbers["views"]] == [view["name"] for view in record["per_view"]]
    for view, known in zip(numbers["views"], record["per_view"], strict=True):
        assert view["psnr"] == pytest.approx(known["psnr"], abs=0.05)  # the record's images are rounded to 8 bits
        assert 0 < view["largest"] <= view["bound"] < 0.5
        assert abs(view["psnr_change"]) <= view["psnr_bound"] < 0.01
    bounds = [worst["bound"] for worst in numbers["worst"]]
    assert bounds == sorted(bounds, reverse=True)
    assert 0 < len(bounds) <= float32_error.WORST
    assert numbers["verdict"].startswith("Float32 changes the mean PSNR by ")
    assert main([str(run)]) == 0
    text = capsys.readouterr().out
    assert f"Written: {run / 'exactness.png'}" in text
    assert (run / "exactness.png").read_bytes()[:4] == b"\x89PNG"


def test_a_ply_is_measured_on_an_orbit(tmp_path, capsys):
    """Catches a PLY that is not read, is seen from inside, or is said to have a PSNR."""
    assert main([str(write_ply(tmp_path / "third party.ply")), "--out", str(tmp_path / "out")]) == 0
    text = capsys.readouterr().out
    rows = [line for line in text.splitlines() if line.startswith("| orbit")]
    assert len(rows) == 10
    views = "Views: 10 on an orbit around the median of the means, 2.98 world units away."
    assert text.startswith(f"{views}\n\nthird party.ply: 10 Gaussians. ")
    assert all(row.endswith("| - | - | - |") and "0.0e+00" not in row for row in rows)
    assert "Rounding to 8 bits changes an image" in text
    assert (tmp_path / "out/third party.exactness.png").exists()


def centers(subject: Subject) -> torch.Tensor:
    return torch.stack([shot.camera.center for shot in subject.shots])


def test_an_orbit_is_a_full_circle_at_a_moment_each(run, monkeypatch):
    """Catches half a circle, times that end before 1, and a data set that is named, cannot be read and is left out.
    Also an orbit of another size or middle, one of a PLY without extent, and a PLY seen otherwise than by itself."""
    ply = stability.of_ply(write_ply(run / "a.ply"), run)
    assert {(shot.camera.width, shot.camera.height, shot.time) for shot in ply.shots} == {(400, 400, None)}
    assert (ply.model.active.sh_degree, ply.background, ply.antialias) == (3, BLACK, False)
    means = ply.model.splats["means"]
    assert (centers(ply) - means.median(0).values).norm(dim=-1).tolist() == pytest.approx([2.98] * 10, abs=0.005)
    at_one_point = stability.of_ply(write_ply(run / "point.ply", spread=0.0), run)
    assert centers(at_one_point).norm(dim=-1).tolist() == pytest.approx([1e-6] * 10)
    monkeypatch.setattr(stability, "scene_of", lambda *_: (_ for _ in ()).throw(InputError("gone")))
    subject = stability.of_run(run)
    assert subject.note == "No photographs, so 10 views of an orbit: gone"
    assert subject.title == "/".join((run.parent.parent.name, run.parent.name, run.name))
    assert [shot.time for shot in subject.shots] == [i / 9 for i in range(10)]
    for orbit in (ply, subject):
        steps = (centers(orbit) - centers(orbit).roll(1, 0)).norm(dim=-1)
        assert torch.allclose(steps, steps.mean().expand(10), rtol=1e-3)
    with pytest.raises(InputError, match="gone"):
        stability.of_run(run, "elsewhere")


def test_what_cannot_be_read_or_written_is_one_line(tmp_path, capsys):
    """Catches a stack trace for no run, no PLY, an --out that is a file, and options that are not read."""
    for name in ("broken.ply", "a.splat", "run.pt"):
        (tmp_path / name).write_text("no")
    for arguments, expected in (
        ([tmp_path], "expected the folder of a run"),
        ([tmp_path / "broken.ply"], "expected a PLY"),
        ([tmp_path / "a.splat"], "this file is compressed (SPLAT): npx"),
        ([tmp_path / "run.pt"], "run.pt: expected the folder of a run, got a file: name the folder of a checkpoint.pt"),
        ([write_ply(tmp_path / "few.ply", count=3)], f"{tmp_path / 'few.ply'}: expected at least 4 Gaussians, found 3"),
        ([tmp_path / "broken.ply", "--data-root", tmp_path], "--data-root: expected none with a PLY"),
        ([tmp_path, "--out", tmp_path], "--out: expected none with a run"),
        ([write_ply(tmp_path / "right.ply"), "--out", tmp_path / "broken.ply"], "--out: expected a folder that can"),
    ):
        assert main([*map(str, arguments)]) == 2
        line = capsys.readouterr().err.splitlines()[-1]  # the PLY has a note on its columns
        assert line.startswith("gsbench.stability: error: ")
        assert expected in line


def test_an_exact_view_has_no_change(run):
    """Catches a mean PSNR whose change is NaN, infinity less infinity, as one view is the background alone."""
    model = load_run(run).model
    empty = float32_error.Shot("empty", around(model, 4.0, 32, 32, 0.0), 0.0, torch.zeros(32, 32, 3))
    with torch.no_grad():
        model.splats["opacities"].fill_(-50.0)
    exactness = float32_error.measure(model, [empty], BLACK, "")
    assert (exactness.views[0].psnr, exactness.views[0].psnr_change) == (100.0, 0.0)
    assert "changes the mean PSNR by 0.0e+00 dB, that of one view by 0.0e+00 dB" in report.verdict(exactness)
    views = [replace(exactness.views[0], psnr_change=change) for change in (-4e-5, 1e-5)]
    verdict = report.verdict(replace(exactness, views=views))
    assert "changes the mean PSNR by 1.5e-05 dB, that of one view by 4.0e-05 dB" in verdict
    views = [replace(exactness.views[0], psnr_change=change) for change in (None, 3e-5)]  # one has no photograph
    assert "the mean PSNR by 1.5e-05 dB" in report.verdict(replace(exactness, views=views))
    views = [replace(exactness.views[0], rms=rms) for rms in (1e-5, 2e-4)]
    verdict = report.verdict(replace(exactness, views=views))  # of a step of 8 bits, whose rounding is 1 / sqrt(12)
    assert "Rounding to 8 bits changes an image 1,443 times as much as float32" in verdict


def test_the_report_word_for_word():
    """Catches a number under another title, a share that is no percentage, and a reason that is not explained."""
    of_front = ViewExactness("front", 0.5, 0.00025, 1.0, 0.125, 0.25, 30.0, -1e-4, 2e-4)
    of_back = ViewExactness("back", 0.1, 0.00005, 0.2, 0.01, 0.0)
    worst = [Culprit(7, "front", 12, 3.5, [*report.MEANINGS]), Culprit(3, "back", 1, 0.5, [])]
    assert report.text(Exactness("a run", 20, [of_front, of_back], worst, None)) == REPORT  # type: ignore[arg-type]
    assert float32_error.BRANCHES.keys() < report.MEANINGS.keys()


def test_the_picture_shows_image_error_and_bound(tmp_path):
    """Catches panes in another order, and a linear scale, on which all errors are black."""
    image, plane = torch.full((8, 8, 3), 0.5, dtype=torch.float64), torch.ones(8, 8, dtype=torch.float64)
    exact = ExactImage(image, plane / 255, plane.int(), plane.byte())
    shown = ("front", (image + 1e-3 / 255).float(), exact)  # an error of 1e-3 steps, and a bound of one
    report.draw(Exactness("a run", 1, [], [], shown), tmp_path / "a.png")
    picture = cv2.cvtColor(cv2.imread(str(tmp_path / "a.png")), cv2.COLOR_BGR2RGB).astype(int)
    middle, brightest = (inferno(np.array([[level]]))[0, 0] for level in (0.5, 1.0))
    columns = [np.nonzero((np.abs(picture - color) <= 4).all(-1))[1] for color in ((128,) * 3, middle, brightest)]
    assert min(map(len, columns)) > 20_000  # pixels
    assert np.median(columns[0]) < np.median(columns[1]) < np.median(columns[2])


# ---- which Gaussians, and why


def hard_model() -> GaussianModel:
    """Five Gaussians of 3DGS in view of a camera at -4 along y; each but the first is hard in its own way."""
    model = build("3dgs", sh_degree=0)
    means = torch.tensor([[0.0, 0, 0], [0.5, 0, 0], [-0.5, 0, 0], [0, 0, 0.5], [0, 0, -0.5]])
    model.initialise(Points(means, torch.rand(5, 3)), 1.0, torch.Generator().manual_seed(0))
    with torch.no_grad():
        model.splats["scales"].fill_(-2.0)
        model.splats["scales"][1, 0] -= 8.0
        model.splats["scales"][2] = 4.0
        model.splats["opacities"].zero_()
        model.splats["opacities"][3] = 6.0
    return model.requires_grad_(False)


def test_why_a_gaussian_is_hard():
    """Catches a reason given to the wrong Gaussian."""
    model = hard_model()
    camera = around(model, 4.0, 32, 32, 0.0, 0.0)
    exact = model.double().slice(CameraTime.of(float64_camera(camera), None))
    far_away = exact._replace(means=exact.means + torch.tensor([1e6, 0.0, 0.0]))
    shift = torch.eye(4)
    shift[:3, 3] = camera.viewmat[:3, 3] - camera.viewmat[:3, :3] @ torch.tensor([1e6, 0.0, 0.0])
    shift[:3, :3] = camera.viewmat[:3, :3]
    rows = torch.arange(5)
    assert float32_error.reasons(exact, camera, rows) == [[], ["flat"], ["huge"], ["opaque"], []]
    wide = exact._replace(factors=exact.factors * torch.tensor([1, 1, 1, 1, 11.0])[:, None, None])
    assert float32_error.reasons(wide, camera, rows)[4] == ["huge"]
    profiles = wide._replace(beta_exponents=torch.full((5,), 4.0, dtype=torch.float64))  # which end at their axes
    assert float32_error.reasons(profiles, camera, rows)[4] == []
    moved = float32_error.reasons(far_away, float32_error.Camera(shift, camera.K, 32, 32), rows)
    assert all("far" in words for words in moved)
    for width, height in ((320, 32), (32, 320)):
        assert "huge" not in float32_error.reasons(wide, replace(camera, width=width, height=height), rows)[4]


def test_the_first_gaussian_counts():
    """Catches the number 0 taken for none."""
    model = hard_model()
    model.splats["opacities"].data[1:] = -50.0
    shot = float32_error.Shot("front", around(model, 4.0, 32, 32, 0.0, 0.0), None, None)
    exactness = float32_error.measure(model, [shot], BLACK, "")
    assert [culprit.index for culprit in exactness.worst] == [0]
    assert exactness.views[0].median_bound > 0


def test_the_worst_gaussians_have_the_largest_sums():
    """Catches the least ones, a Gaussian twice, one of a view in which it is less hard, and a sum of other pixels."""
    model = small_model()
    double, sums = float32_error.float64_model(model), []
    for view in VIEWS[:2]:
        exact = float32_error.render_twice(model, double, view.camera, view.time, torch.zeros(3), False).exact
        shown = exact.culprit >= 0
        sums.append(torch.zeros(len(model)).double().index_add(0, exact.culprit[shown].long(), exact.bound[shown]))
    largest, at = torch.stack(sums).max(0)
    order = largest.argsort(descending=True)[: float32_error.WORST]
    worst = float32_error.measure(model, [*map(float32_error.Shot.of, VIEWS[:2])], BLACK, "").worst
    assert [(culprit.index, culprit.view) for culprit in worst] == [(int(i), VIEWS[at[i]].name) for i in order]
    assert [culprit.bound for culprit in worst] == pytest.approx((255 * largest[order]).tolist())


def test_what_is_said_of_a_view():
    """Catches a number in other units, and a bound on the change of PSNR that is not that of its pixels."""
    image, plane = torch.full((2, 2, 3), 0.5, dtype=torch.float64), torch.ones(2, 2, dtype=torch.float64)
    branches = torch.tensor([[0, 1], [0, 0]], dtype=torch.uint8)
    shot = float32_error.Shot("a", VIEWS[0].camera, None, torch.full((2, 2, 3), 0.4))
    single = image.float()
    single[0, 0, 0] += 0.02
    for bound, share in ((0.01, 0.21), (0.1, 3.0)):  # (2 x 0.1 x bound + bound^2) / 0.1^2
        exact = ExactImage(image, bound * plane, plane.int(), branches)
        known = float32_error.compare(shot, single, exact)
        assert known.largest == pytest.approx(255 * 0.02, rel=1e-4)
        assert known.rms == pytest.approx(255 * 0.02 / math.sqrt(12), rel=1e-4)
        assert (known.bound, known.median_bound) == pytest.approx((255 * bound, 255 * bound))
        assert known.undecided == 0.25
        assert known.psnr_change == pytest.approx(-10 * math.log10((11 * 0.01 + 0.12**2) / 0.12), rel=1e-4)
        assert known.psnr_bound == pytest.approx(-10 * math.log10(1 - share) if share < 1 else math.inf, rel=1e-4)


def small_model(name: str = "7dgs", backend: str = "cpu") -> GaussianModel:
    """A model at its start in the scene of the moving square."""
    model, square = setup.build(compose(name, 100, f"raster.backend={backend}")), moving_square()
    model.initialise(square.points, square.extent, generator(0))
    return model


# ---- the metric of a record


def psnr_float32(model: GaussianModel, views: Sequence[View]) -> tuple[float | None, str]:
    return float32_error.psnr_float32(model, views, torch.zeros(3), False)


VIEWS = moving_square().train[:8]


def test_it_is_the_largest_change_of_three_spaced_views(monkeypatch):
    """Catches a mean or a sum instead of the largest change, other views, and a bound instead of a change."""
    model = small_model()
    change, why = psnr_float32(model, VIEWS)
    assert not why
    shots = [float32_error.Shot.of(VIEWS[i]) for i in (0, 2, 5)]
    assert len(shots) == float32_error.VIEWS
    known = float32_error.measure(model, shots, BLACK, "").views
    assert change == max(abs(view.psnr_change or 0.0) for view in known) > 0
    changes = iter((1e-5, -3e-5, 2e-5))
    monkeypatch.setattr(float32_error, "compare", lambda *_: replace(known[0], psnr_change=next(changes)))
    assert psnr_float32(model, VIEWS)[0] == 3e-5


@pytest.mark.parametrize("kind", [RuntimeError, TypeError])
def test_a_model_of_float32_alone_loses_no_run(kind, monkeypatch):
    """Catches an error of a user's model in float64 that ends a trained run, and images of two backends compared."""
    assert psnr_float32(small_model(backend="reference"), VIEWS)[0] is None
    assert "needs raster.backend=cpu" in psnr_float32(small_model(backend="reference"), VIEWS)[1]
    model = small_model()
    right = type(model).slice

    def single(self: Any, query: CameraTime) -> Any:
        if query.center.dtype == torch.float64:
            raise kind("expected scalar type Float but found Double")
        return right(self, query)

    monkeypatch.setattr(type(model), "slice", single)
    reason = "the model has no image in float64: expected scalar type Float but found Double"
    assert psnr_float32(model, VIEWS) == (None, reason)


def test_equal_images_have_no_change():
    """Catches an infinity where an image equals its view, whose PSNR is capped, and one of two images not filtered."""
    model = small_model()
    double = float32_error.float64_model(model)
    rendered = [
        float32_error.render_twice(model, double, view.camera, view.time, torch.zeros(3), False).image for view in VIEWS
    ]
    exact = float32_error.render_twice(model, double, VIEWS[0].camera, VIEWS[0].time, torch.zeros(3), True)
    assert torch.equal(exact.image, render(model, VIEWS[0].camera, VIEWS[0].time, torch.zeros(3), True))
    assert torch.allclose(exact.image.double(), exact.exact.image, atol=1e-4)
    assert not torch.allclose(exact.image, rendered[0], atol=1e-3)
    equal = [replace(view, pixels=image) for view, image in zip(VIEWS, rendered, strict=True)]
    assert psnr_float32(model, equal) == (0.0, "")


def test_a_long_title_stays_over_its_pane(tmp_path, monkeypatch):
    """Catches the name of a run with a long variant that is cut at the border or runs into the next title."""
    drawn = []

    class Kept(Figure):
        def __init__(self, *arguments, **options) -> None:
            super().__init__(*arguments, **options)
            drawn.append(self)

    monkeypatch.setattr(report, "Figure", Kept)
    exact = SimpleNamespace(image=torch.zeros(8, 8, 3), bound=torch.zeros(8, 8))
    title = "suzanne/7dgs,downscale=8,initial_points=500,iterations=30,gate=end/seed0"
    shown = ("test/r_009", torch.zeros(8, 8, 3), exact)
    report.draw(Exactness(title, 1, [], [], shown), tmp_path / "a.png")  # type: ignore[arg-type]
    boxes = [axes.title.get_window_extent() for axes in drawn[0].axes[:2]]
    assert 0 <= boxes[0].x0 < boxes[0].x1 < boxes[1].x0

"""How exact a trained model's images are: the command's numbers, its Gaussians, and what it writes and refuses."""

import json
from pathlib import Path

import pytest
import torch
from tiny_run import main_here, overrides, write_moving_square

from gsbench import kernels
from gsbench.models import GaussianModel, Query, build
from gsbench.models.cameras import around
from gsbench.run.load import load_run
from gsbench.scenes import Points
from gsbench.scenes.trained import TrainedGaussians, ply_of
from gsbench.stability import frame, frame_report, spectrum
from gsbench.stability.__main__ import main

pytestmark = pytest.mark.skipif(not kernels.available(), reason="the kernels are not built")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished run of 3DGS."""
    root = tmp_path_factory.mktemp("exact")
    assert main_here(*overrides(write_moving_square(root / "data"), root / "results", "model=3dgs")) == 0
    return next(path.parent for path in root.rglob("checkpoint.pt"))


def plys(path: Path, **changed: torch.Tensor) -> Path:
    """A PLY of ten Gaussians around the origin."""
    g = torch.Generator().manual_seed(0)
    fields = {"means": torch.randn(10, 3, generator=g), "log_scales": torch.full((10, 3), -1.0),
              "quats": torch.randn(10, 4, generator=g), "logits": torch.zeros(10),
              "dc": torch.randn(10, 3, generator=g), "rest": torch.zeros(10, 15, 3)}  # fmt: skip
    path.write_bytes(ply_of(TrainedGaussians(**fields | changed)))
    return path


def test_a_run_is_measured_in_its_test_views(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Catches other views than those of the record, another PSNR than it, and an error that its bound does not hold."""
    assert main([str(run), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    record = json.loads((run / "record.json").read_text())
    assert [view["name"] for view in found["views"]] == [view["name"] for view in record["per_view"]]
    for view, known in zip(found["views"], record["per_view"], strict=True):
        assert view["psnr"] == pytest.approx(known["psnr"], abs=0.05)  # the record's images are rounded to 8 bits
        assert 0 < view["largest"] <= view["bound"] < 0.5
        assert abs(view["psnr_change"]) <= view["psnr_bound"] < 0.01
    assert 0 < len(found["worst"]) <= frame.WORST
    assert "decimal of the mean PSNR" in found["verdict"]


@pytest.mark.parametrize("words", [(), ("--checkpoint", "checkpoint.pt")])
def test_a_folder_that_takes_no_file_is_told(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a stack trace after the audit, or after the condition numbers, as --out is a file."""
    monkeypatch.setattr(spectrum, "measure", lambda _: None)
    monkeypatch.setattr(spectrum, "failures", lambda _: {})
    monkeypatch.setattr(spectrum, "draw", lambda _, folder, __: folder.mkdir())
    (tmp_path / "out").write_bytes(b"")
    assert main([*words, "--out", str(tmp_path / "out")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{tmp_path / 'out'}: File exists" in line


def test_json_writes_no_picture(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a picture that --json writes into the run's folder, which may be read-only, and one that is missing."""
    (run / "exactness.png").unlink(missing_ok=True)
    content = set(run.iterdir())
    assert main([str(run), "--json"]) == 0
    assert set(run.iterdir()) == content
    assert main([str(run)]) == 0
    assert f"Written: {run / 'exactness.png'}" in capsys.readouterr().out
    assert (run / "exactness.png").read_bytes()[:4] == b"\x89PNG"


def test_an_exact_view_has_no_change(run: Path) -> None:
    """Catches a mean PSNR whose change is NaN, infinity less infinity, as one view is the background alone."""
    model = load_run(run).model
    empty = frame.Shot("empty", around(model, 4.0, 32, 32, 0.0), 0.0, torch.zeros(32, 32, 3))
    with torch.no_grad():
        model.splats["opacities"].fill_(-50.0)
    found = frame.measure(model, [empty], (0.0, 0.0, 0.0), "")
    assert (found.views[0].psnr, found.views[0].psnr_change) == (100.0, 0.0)
    assert "no decimal of the mean PSNR" in frame_report.verdict(found)


def test_a_ply_is_measured_on_an_orbit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a PLY that is not read, is seen from inside, or is said to have a PSNR."""
    assert main([str(plys(tmp_path / "third party.ply")), "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    rows = [line for line in said.splitlines() if line.startswith("| orbit")]
    assert len(rows) == 10
    assert all(row.endswith("| - | - | - |") and "0.0e+00" not in row for row in rows)
    assert "Rounding to 8 bits changes an image" in said
    assert (tmp_path / "out/third party.exactness.png").exists()


def test_what_cannot_be_read_is_said_in_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a stack trace for a folder without a run, and for a file that is no PLY."""
    (tmp_path / "broken.ply").write_text("no")
    for path, expected in ((tmp_path, "expected the folder of a run"), (tmp_path / "broken.ply", "expected a PLY")):
        assert main([str(path)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("gsbench.stability: error: ")
        assert expected in line


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


def test_why_a_gaussian_is_hard() -> None:
    """Catches a reason given to the wrong Gaussian."""
    model = hard_model()
    camera = around(model, 4.0, 32, 32, 0.0, 0.0)
    exact = model.double().slice(Query.of(frame.doubled(camera), None))
    far_away = exact._replace(means=exact.means + torch.tensor([1e6, 0.0, 0.0]))
    shift = torch.eye(4)
    shift[:3, 3] = camera.viewmat[:3, 3] - camera.viewmat[:3, :3] @ torch.tensor([1e6, 0.0, 0.0])
    shift[:3, :3] = camera.viewmat[:3, :3]
    rows = torch.arange(5)
    assert frame.reasons(exact, camera, rows) == [[], ["flat"], ["huge"], ["opaque"], []]
    moved = frame.reasons(far_away, frame.Camera(shift, camera.K, 32, 32), rows)
    assert all("far" in words for words in moved)


@pytest.mark.parametrize(("name", "motion"), [("7dgs", 300), ("7dgs_nodir", 3000)])
def test_the_papers_formula_is_indefinite_for_correlated_gaussians(name: str, motion: int) -> None:
    """Catches a Gaussian whose published covariance is indefinite in float32 and is not named, or the reverse."""
    model = build(name, sh_degree=0, lambda_t=0.5, **({"lambda_d": 0.5} if name == "7dgs" else {}))
    g = torch.Generator().manual_seed(0)
    model.initialise(Points(torch.rand(20, 3, generator=g), torch.rand(20, 3, generator=g)), 1.0, g)
    with torch.no_grad():
        model.splats["motion"][10:] = motion * torch.randn(10, model.splats["motion"].shape[1], generator=g)
    found = list(frame.by_published_formula(model.double(), torch.arange(20)))
    assert not any(found[:10])
    assert any(found[10:])


@pytest.mark.parametrize(("change", "words"), [(0.2, "the first decimal"), (2e-4, "the fourth decimal"),
                                               (3.0, "the digits before"), (0.0, "no decimal")])  # fmt: skip
def test_the_verdict_names_the_decimal(change: float, words: str) -> None:
    """Catches a decimal off by one, and the logarithm of zero."""
    view = frame.ViewExactness("a", 1e-3, 1e-4, 1e-2, 1e-3, 0.0, 30.0, change, 1.0)
    image = frame.ExactImage(*[torch.zeros(0)] * 4)
    found = frame.Exactness("a", 1, [view], [], ("a", torch.zeros(0), image))
    assert f"changes {words}" in frame_report.verdict(found)

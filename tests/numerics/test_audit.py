"""The audit in small: the defaults keep their bounds, the schemes that subtract do not, and the page says so."""

import json
import math

import pytest
import torch

from gsbench.models.cholesky import FACTOR_ORDERS
from numerics import __main__ as command
from numerics import audit, page, pictures, population, trainings
from numerics.cases import CASES, Bound, Cell, present

BACKENDS = present()
# Trainings of hundreds of steps, and a picture of 10^5 Gaussians.
LONG = {"one_frame", "all_images_equal", "seen_by_no_view", "reset_into_refinement", "lambda_switched_on"}
LONG |= {"faint_crowd"}


@pytest.mark.timeout(900)
def test_the_short_audit_passes(tmp_path, monkeypatch, capsys):
    """Catches a default that loses digits, is not finite or leaks a gradient in a hard case, in any backend. Det of a
    splat of 10^9 pixels overflowed, a gradient of a static 4DGS was off by 95 %, a NaN in a photograph was trained on.
    The cells that are over their bound are printed. The drift of one training is in it."""
    results, run = [], audit.run
    monkeypatch.setattr(audit, "run", lambda **words: results.append(run(**words)) or results[0])
    assert command.main(["--short", "--out", str(tmp_path / "none")]) == 0, capsys.readouterr().out
    assert {cell.case for cell in results[0].cells} >= CASES.keys() - LONG
    assert results[0].verified.keys() == {*population.MOVING, *FACTOR_ORDERS}
    assert max(results[0].verified.values()) < 1e-6, "the float64 slices that others are held to"
    assert not (tmp_path / "none").exists(), "a page of half the cases"


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_the_whole_audit_passes(tmp_path, capsys):
    """Catches a default over its bound in what the short audit leaves out: other models, seeds, long trainings."""
    assert command.main(["--out", str(tmp_path)]) == 0, capsys.readouterr().out
    drifts = [line for line in (tmp_path / "table.md").read_text().splitlines() if "single_against_double" in line]
    assert [line.count("Gaussians, in float64") for line in drifts] == [3, 3, 3]


@pytest.mark.parametrize("order", FACTOR_ORDERS)
def test_schemes_on_hard_slices(order):
    """Catches a default beyond its bounds, and an audit so blind that the schemes that subtract pass it."""
    cells, _ = population.hard_slices(order, 4_000, BACKENDS)
    for cell in cells:
        assert cell.holds == cell.is_default, cell
        assert cell.is_default or cell.bad > 0.3, cell


def test_splats_of_a_billion_pixels_have_a_gradient():
    """Catches units in which det of the 2D covariance leaves float32: the gradient was 0."""
    arguments = CASES["larger_than_the_scene"]()[-1] | {"Ks": pictures.intrinsics(1e4, 1e4)}
    arguments["means"] = arguments["means"] * torch.tensor([1e-3, 1e-3, 1.0])
    truth = pictures.alone(arguments)
    for backend in BACKENDS:
        forward, gradient, bad = pictures.compare(arguments, truth, backend)
        assert (forward <= 1e-4, gradient <= 1e-3, bad) == (True, True, 0)


def cell(scheme: str, forward: float) -> Cell:
    return Cell("slicing", "static", "7dgs", scheme, "cpu", forward, 1e-6, 0.0, 1.0, Bound())


@pytest.mark.parametrize(
    ("scheme", "forward", "code"),
    [("square_root", 1e-6, 0), ("square_root", 1.0, 1), ("square_root", math.nan, 1), ("schur", 1.0, 0)],
)
def test_page_and_exit_code(scheme, forward, code, tmp_path, monkeypatch, capsys):
    """Catches a default over its bound, NaN included, that is not marked or ends in 0; others may break theirs. Also a
    short audit that does not say where to look, and a page without its table, figures or machine."""
    monkeypatch.setattr(audit, "run", lambda **_: audit.Audit(["cpu"], [cell(scheme, forward)]))
    assert command.main(["--out", str(tmp_path)]) == code
    text = (tmp_path / "page.md").read_text()
    assert ("**over**" in text.split("## slicing")[1].split("## training")[0]) == (forward != 1e-6)
    assert (tmp_path / "table.csv").read_text().splitlines()[1].startswith("slicing,static,7dgs")
    assert json.loads((tmp_path / "audit.json").read_text())["backends"] == ["cpu"]
    assert "](condition.png)" in text
    assert (tmp_path / "condition.png").read_bytes()[:4] == b"\x89PNG"
    capsys.readouterr()
    assert command.main(["--short"]) == code
    lines = capsys.readouterr().out.splitlines()
    assert [line.startswith("static, 7dgs, cpu: **over** ") for line in lines] == [True] * code + [False]
    assert ("static (7dgs, cpu)" in lines[-1]) == bool(code)


def test_a_folder_that_takes_no_file_is_one_line(tmp_path, capsys):
    """Catches a stack trace after the minutes of the audit, as --out is a file."""
    (tmp_path / "out").write_bytes(b"")
    assert command.main(["--out", str(tmp_path / "out")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{tmp_path / 'out'}: File exists" in line


def test_missing_numbers_are_not_good_ones():
    """Catches a NaN error that passes a comparison, and an infinite one hidden by a percentile."""
    assert not cell("square_root", math.nan).holds
    assert page.show(cell("square_root", 2.0)).startswith(page.MARK)
    errors = torch.full((1000,), 1e-7)
    errors[-2:] = math.nan
    assert population.percentile(errors) == math.inf


def test_every_case_has_a_reason_and_a_judge():
    """Catches a case without its line on the page, and one in an area that no judge looks at."""
    assert min(len(case.stresses) for case in CASES.values()) > 40
    assert {case.area for case in CASES.values()} == {*audit.FIXED, *page.RUNS}


# ---- drift


@pytest.mark.parametrize(("spread", "holds"), [(0.0, False), (0.1, False), (1.0, True)])
def test_drift_is_that_of_the_worst_seed(spread, holds, monkeypatch):
    """Catches a drift on training views, of one seed, or averaged over seeds until it is small. It is excused if small
    changes of the start values move both kinds of trainings as far, and only then."""
    gaps, shaken = {0: 0.001, 1: -0.5, 2: 0.002}, []

    class Fitted:
        def __init__(self, training: trainings.Training, backend: str, shaken_by: int | None = None) -> None:
            self.scene, self.model = training.scene, torch.nn.ParameterList([torch.zeros(3)])
            self.gap = gaps[training.config.seed] if backend == "cpu" else 0.0
            if shaken_by is not None:
                shaken.append((training.config.seed, backend))
                self.gap += spread * (shaken_by - 2)  # -1, 0, 1

        def psnr(self, views: list[object]) -> float:
            return 30.0 + (self.gap if views is self.scene.test else 0.0)

    monkeypatch.setattr(trainings, "fit", Fitted)
    (drift,) = trainings.drift(audit.only(CASES["single_against_double"], "7dgs"), "cpu")
    assert drift.forward == pytest.approx(0.5)
    assert drift.holds == holds
    # The variance of (0, -1, 0, 1) spreads is 2/3, and t of 6 degrees of freedom at 1 % / 3 is 4.69 (tables).
    assert drift.bound.forward == pytest.approx(max(0.02, 4.69 * spread * math.sqrt(2 / 3 / 4 * 2)), rel=0.01)
    assert shaken == [(1, "cpu")] * 3 + [(1, "reference")] * 3  # only where the difference asks for it
    assert "seed 1: 29.5000 dB" in drift.note


def test_a_shaken_start_is_64_roundings_away():
    """Catches start values that stay, that move by more than what ten steps round, or that two seeds move alike."""
    models = [torch.nn.ParameterList([torch.linspace(-3, 3, 50).double()]) for _ in range(3)]
    for model, seed in zip(models[1:], (1, 2), strict=True):
        trainings.shake(model, seed)
    start, first, second = (next(iter(model)).detach() for model in models)
    assert 2.0**-19 < ((first - start) / start).abs().max() <= 2.0**-18
    assert not torch.equal(first, second)


def test_a_seed_of_the_drift_is_that_of_the_points_too():
    """Catches three seeds that all start from the same points."""
    drifts = [CASES["single_against_double"](model="7dgs", run_seed=seed) for seed in (0, 1)]
    assert [training.config.seed for training in drifts] == [0, 1]
    first, second = (training.scene.points.means for training in drifts)
    assert not torch.equal(first, second)


def test_a_scene_in_float64_is_trained_in_float64():
    """Catches a tensor of the trainer that stays float32: the drift is measured against such a training."""
    scene = trainings.double(trainings.moving_square())
    fitted = trainings.fit(trainings.Training("3dgs", trainings.compose("3dgs", 2), scene), "reference")
    assert all(p.dtype == torch.float64 for p in fitted.model.parameters())
    assert math.isfinite(trainings.psnr(fitted))

"""The audit in small: the defaults keep their bounds, the schemes that subtract do not, and the page says so."""

import json
import math
import sys
from pathlib import Path

import pytest
import torch

from gsbench.extras import how_to_install
from gsbench.stability import __main__ as command
from gsbench.stability import audit, page, picture_cases, pictures, population, training_cases, trainings
from gsbench.stability.cases import CASES, Bound, Cell

BACKENDS = audit.present()


# Trainings of hundreds of steps, and a picture of 10^5 Gaussians.
LONG = {"one_frame", "all_images_equal", "seen_by_no_view", "reset_into_refinement", "lambda_switched_on"}
LONG |= {"faint_crowd"}


@pytest.mark.timeout(900)
def test_the_short_audit_passes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a default that loses digits, is not finite or leaks a gradient in a hard case, in any backend.

    Det of a splat of 10^9 pixels overflowed, a gradient of a static 4DGS was off by 95 %, a NaN in a photograph was
    trained on. The cells that are over their bound are printed. The drift of one training is in it.
    """
    found, run = [], audit.run
    monkeypatch.setattr(audit, "run", lambda **words: found.append(run(**words)) or found[0])
    assert command.main(["--short", "--out", str(tmp_path / "none")]) == 0, capsys.readouterr().out
    assert {cell.case for cell in found[0].cells} >= CASES.keys() - LONG
    assert {*audit.moving_population.MODELS} < found[0].verified.keys()
    assert max(found[0].verified.values()) < 1e-6, "the float64 slices that others are held to"
    assert not (tmp_path / "none").exists(), "a page of half the cases"


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_the_whole_audit_passes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a default over its bound in what the short audit leaves out: other models, seeds, long trainings."""
    assert command.main(["--out", str(tmp_path)]) == 0, capsys.readouterr().out
    drifts = [line for line in (tmp_path / "table.md").read_text().splitlines() if "single_against_double" in line]
    assert [line.count("Gaussians, in float64") for line in drifts] == [3, 3, 3]


@pytest.mark.parametrize("order", ["paper", "conditioned_first"])
def test_schemes_on_hard_slices(order: str) -> None:
    """Catches a default beyond its bounds, and an audit so blind that the schemes that subtract pass it."""
    found = audit.Audit(BACKENDS)
    audit.hard_slices(found, order, 4_000)
    for cell in found.cells:
        assert cell.holds == cell.is_default, cell
        assert cell.is_default or cell.bad > 0.3, cell


def test_splats_of_a_billion_pixels_have_a_gradient() -> None:
    """Catches units in which det of the 2D covariance leaves float32: the gradient was 0."""
    arguments = CASES["larger_than_the_scene"]()[-1] | {"Ks": picture_cases.intrinsics(1e4, 1e4)}
    arguments["means"] = arguments["means"] * torch.tensor([1e-3, 1e-3, 1.0])
    truth = pictures.alone(arguments)
    for backend in BACKENDS:
        forward, gradient, bad = pictures.compare(arguments, truth, backend)
        assert (forward <= 1e-4, gradient <= 1e-3, bad) == (True, True, 0)


def cell(scheme: str, forward: float) -> Cell:
    return Cell("slicing", "static", "7dgs", scheme, "cpu", forward, 1e-6, 0.0, 1.0, Bound())


def test_the_short_audit_names_what_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a short audit that passes whatever it finds, or does not say where to look."""
    monkeypatch.setattr(audit, "run", lambda **_: audit.Audit(["cpu"], [cell("square_root", 1.0), cell("schur", 1.0)]))
    assert command.main(["--short", "--out", str(tmp_path)]) == 1
    first, verdict = capsys.readouterr().out.splitlines()
    assert first.startswith("static, 7dgs, cpu: **over** 1e+00 / 1e-06")
    assert "static (7dgs, cpu)" in verdict


@pytest.mark.parametrize(("spread", "holds"), [(0.0, False), (0.1, False), (1.0, True)])
def test_drift_is_that_of_the_worst_seed(spread: float, holds: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a drift on training views, of one seed, or averaged over seeds until it is small.

    It is excused if small changes of the start values move both kinds of trainings as far, and only then.
    """
    gaps, shaken = {0: 0.001, 1: -0.5, 2: 0.002}, []

    class Fitted:
        def __init__(self, training: training_cases.Training, backend: str, shaken_by: int | None = None) -> None:
            self.scene, self.model = training.scene, torch.nn.ParameterList([torch.zeros(3)])
            self.gap = gaps[training.config.seed] if backend == "cpu" else 0.0
            if shaken_by is not None:
                shaken.append((training.config.seed, backend))
                self.gap += spread * (shaken_by - 2)  # -1, 0, 1

        def psnr(self, views: list[object]) -> float:
            return 30.0 + (self.gap if views is self.scene.test else 0.0)

    monkeypatch.setattr(trainings, "fit", Fitted)
    (found,) = trainings.drift(audit.only(CASES["single_against_double"], "7dgs"), "cpu")
    assert found.forward == pytest.approx(0.5)
    assert found.holds == holds
    # The variance of (0, -1, 0, 1) spreads is 2/3, and t of 6 degrees of freedom at 1 % / 3 is 4.69 (tables).
    assert found.bound.forward == pytest.approx(max(0.02, 4.69 * spread * math.sqrt(2 / 3 / 4 * 2)), rel=0.01)
    assert shaken == [(1, "cpu")] * 3 + [(1, "reference")] * 3  # only where the difference asks for it
    assert "seed 1: 29.5000 dB" in found.note


@pytest.mark.parametrize(("scheme", "forward", "code"), [("square_root", 1e-6, 0), ("square_root", 1.0, 1),
                                                         ("square_root", math.nan, 1), ("schur", 1.0, 0)])  # fmt: skip
def test_page_and_exit_code(
    scheme: str, forward: float, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a default over its bound, NaN included, that is not marked or ends in 0; others may break theirs."""
    monkeypatch.setattr(audit, "run", lambda **_: audit.Audit(["cpu"], [cell(scheme, forward)]))
    assert command.main(["--out", str(tmp_path)]) == code
    text = (tmp_path / "page.md").read_text()
    assert ("**over**" in text.split("## slicing")[1].split("## training")[0]) == (forward != 1e-6)
    assert (tmp_path / "table.csv").read_text().splitlines()[1].startswith("slicing,static,7dgs")
    assert json.loads((tmp_path / "audit.json").read_text())["backends"] == ["cpu"]
    for name in ("condition.png", "time_slicing.png", "time_picture.png"):
        assert f"]({name})" in text
        assert (tmp_path / name).read_bytes()[:4] == b"\x89PNG"


def test_experiment_is_the_audit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches `+exp=stability` that asks for data, or trains."""
    from gsbench import __main__ as gsbench

    seen: list[list[str]] = []
    monkeypatch.setattr(command, "main", lambda arguments: seen.append(arguments) or 0)
    monkeypatch.setattr(sys, "argv", ["gsbench", "+exp=stability", f"results={tmp_path}"])
    with pytest.raises(SystemExit) as end:
        gsbench.main()
    assert not end.value.code
    assert seen == [["--out", str(tmp_path / "stability")]]


@pytest.mark.parametrize("missing", [["mpmath"], ["matplotlib", "mpmath"]])
def test_without_the_extra_a_line_says_what_to_install(
    missing: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a stack trace from the middle of the audit, by either command, where gsbench came without the extra."""
    from gsbench import __main__ as gsbench

    for name in missing:
        monkeypatch.setitem(sys.modules, name, None)
    line = f"expected {' and '.join(missing)}: {how_to_install('stability')}\n"
    assert command.main(["--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err == f"gsbench.stability: error: {line}"
    monkeypatch.setattr(sys, "argv", ["gsbench", "+exp=stability", f"results={tmp_path}"])
    with pytest.raises(SystemExit) as end:
        gsbench.main()
    assert end.value.code == 1
    assert capsys.readouterr().err == f"gsbench.stability: error: {line}"
    assert not list(tmp_path.iterdir())


def test_missing_numbers_are_not_good_ones() -> None:
    """Catches a NaN error that passes a comparison, and an infinite one hidden by a percentile."""
    assert not cell("square_root", math.nan).holds
    assert page.show(cell("square_root", 2.0)).startswith(page.MARK)
    errors = population.np.full(1000, 1e-7)
    errors[-2:] = math.nan
    assert audit.curves.percentile(errors) == math.inf


def test_a_shaken_start_is_64_roundings_away() -> None:
    """Catches start values that stay, that move by more than what ten steps round, or that two seeds move alike."""
    made = [torch.nn.ParameterList([torch.linspace(-3, 3, 50).double()]) for _ in range(3)]
    for model, seed in zip(made[1:], (1, 2), strict=True):
        trainings._shake(model, seed)  # type: ignore[arg-type]
    start, one, two = (next(iter(model)).detach() for model in made)
    assert 2.0**-19 < ((one - start) / start).abs().max() <= 2.0**-18
    assert not torch.equal(one, two)

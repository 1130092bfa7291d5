"""The audit in small: the defaults keep their bounds, the schemes that subtract do not, and the page says so."""

import dataclasses
import json
import math
import sys
from pathlib import Path

import pytest
import torch

from gsbench.stability import __main__ as command
from gsbench.stability import audit, colors, page, picture_cases, pictures, population, slices, trainings
from gsbench.stability.cases import CASES, Bound, Cell, of_area

BACKENDS = audit.present()
QUICK = [case.name for case in of_area("blending") if case.name != "faint_crowd"]


@pytest.mark.parametrize("name", [case.name for case in of_area("slicing")])
def test_slices(name: str) -> None:
    """Catches a default that loses digits, is not finite or leaks a gradient in a hard slice, in any backend.

    6DGS is 7DGS without time: `make stability` has its cells.
    """
    subjects = tuple(model for model in CASES[name].subjects if model != "6dgs")
    for cell in slices.judge(dataclasses.replace(CASES[name], subjects=subjects), BACKENDS):
        assert cell.holds or not cell.is_default, cell


@pytest.mark.parametrize("name", [case.name for case in of_area("colour")])
def test_colors(name: str) -> None:
    """Catches a colour or its gradient lost where the direction is undefined, coefficients large, or time far."""
    for cell in colors.judge(CASES[name], BACKENDS):
        assert cell.holds, cell


@pytest.mark.parametrize("name", [case.name for case in of_area("projection")] + QUICK)
def test_pictures(name: str) -> None:
    """Catches an overflow or a cancellation in projecting and blending: det of a splat of 10^9 pixels was one."""
    for cell in pictures.judge(CASES[name], BACKENDS):
        assert cell.holds, cell


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


@pytest.mark.parametrize("name", [case.name for case in of_area("training")])
@pytest.mark.slow
def test_trainings(name: str) -> None:
    """Catches a recipe that ends in NaN: one frame, black images, unseen Gaussians, learning rates times 30."""
    for cell in trainings.judge(CASES[name], BACKENDS[0]):
        assert cell.holds, cell


def test_a_training_driven_too_far() -> None:
    """Catches 7DGS, the model with most to go wrong, diverging at 30 times its learning rates, in a few steps."""
    (cell,) = (c for c in trainings.judge(only("learning_rates_times_30", "7dgs"), BACKENDS[0], steps=40))
    assert cell.holds, cell


def test_poisoned_photograph() -> None:
    """Catches a NaN in a photograph that is trained on."""
    (cell,) = trainings.judge(CASES["poisoned_photograph"], BACKENDS[0])
    assert cell.holds
    assert "train/3" in cell.note


def only(name: str, model: str) -> object:
    return dataclasses.replace(CASES[name], subjects=(model,))


def cell(scheme: str, forward: float) -> Cell:
    return Cell("slicing", "static", "7dgs", scheme, "cpu", forward, 1e-6, 0.0, 1.0, Bound())


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
    line = f"expected {' and '.join(missing)}: install with pip install 'gsbench[stability]'\n"
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

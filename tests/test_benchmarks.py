"""The rows of `python -m benchmarks` on few Gaussians, and its --against on a small repository; nothing is timed."""

import json
import shutil
import subprocess
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
import torch

from benchmarks import __main__ as command
from benchmarks import against, gpu, rows, scene
from benchmarks.against import Built, built
from benchmarks.compare import Place, compared
from benchmarks.roofline import Limits
from benchmarks.stages import MODELS, SUCCESSORS, blended_alphas, recorded, stages
from benchmarks.timing import Cost, Row
from benchmarks.training import one_view
from gsbench.kernels.headers import ALPHA_MIN
from gsbench.models import CameraTime
from gsbench.models.render import rasterize_slice

MAIN = """
import json, sys, gsbench
section, _, folder, _, name = sys.argv[1:]
rows = {"rows": [{"section": section, "name": "a", "median": gsbench.MILLISECONDS}]}
open(f"{folder}/{name}.json", "w").write(json.dumps(rows))
"""


def test_calls_are_timed_alone_and_back_to_back(monkeypatch):
    """Catches a row of calls whose time is that of one call, or of all, and a table without it."""
    calls: list[float] = []

    def timed(_: Place, call) -> float:
        before = sum(calls)
        call()
        return sum(calls) - before

    monkeypatch.setattr(Place, "timed", timed)
    ours, other = (Place("cpu").cost(lambda ms=ms: calls.append(ms)) for ms in (2.0, 3.0))
    assert ours == (2.0, 2.0, 2.0, 2.0, 0)
    row = compared("raster", "small", "forward", ours, other)
    assert row["ratio"] == row["ratio_back_to_back"] == 1.5
    assert "| raster | small | forward | 2.000 | 3.000 | 1.500 | 2.000 | 3.000 | 1.500 |" in gpu.table(
        {"gsplat": "1", "git_commit": "1"}, [row]
    )


def test_no_two_rows_have_one_name(monkeypatch):
    """Catches rows that --against would compare with each other's times."""
    monkeypatch.setattr(rows, "model", lambda name, _, **options: scene.model(name, 50, **options))
    monkeypatch.setattr(rows, "gaussians", lambda _: scene.gaussians(50))
    monkeypatch.setitem(rows.SECTIONS, "stages", lambda: stages(50, 32))
    names = Counter((row.section, row.name) for section in rows.SECTIONS.values() for row in section())
    assert len(names) > 100
    assert {name for name, count in names.items() if count > 1} == set()


def test_every_stage_is_timed_once_and_has_a_floor():
    """Catches a stage that is left out or that cannot be called twice, and a floor that is zero."""
    stage_rows = list(stages(50, 32))
    for row in stage_rows:
        for _ in range(2):
            row.call()
        assert row.name.endswith("whole step") or (row.floor is not None and row.floor[1] > 0), row.name
    both = [f"{stage} {way}" for stage in ("slice", "colours", "project", "blend") for way in ("forward", "backward")]
    whole = [*both, "check values", "bin", "loss forward + backward", "Adam", "whole step"]
    expected = {f"{name} {stage}" for name in MODELS for stage in whole} | {"7dgs AGR forward", "7dgs AGR backward"}
    expected |= {f"{name} slice {way}" for name in SUCCESSORS for way in ("forward", "backward")}
    assert sorted(row.name for row in stage_rows) == sorted(expected)


def test_a_trained_model_shows_a_part_of_its_rows_in_order():
    """Catches stages that are timed with every Gaussian visible, or with visible ones far apart."""
    for name in ("4dgs", "7dgs", "dgs", "dbs", "freetime"):
        fitted, view = scene.trained(name, 1600), one_view(32, 32)
        visible = fitted.slice(CameraTime.of(view.camera, view.time)).opacities >= ALPHA_MIN
        assert abs(float(visible.float().mean()) - scene.VISIBLE) < 0.02
        assert visible.unflatten(0, (-1, 16)).any(1).float().mean() < 0.6  # it is 1 in any order


def test_gradients_of_a_stage_are_added_in_place():
    """Catches a backward row that allocates its gradients, which most views of a batch do not."""
    fitted = scene.model("7dgs", 50)
    call = recorded(fitted, one_view(32, 32))["slice_triangular"]
    gradient = fitted.splats["motion"].grad
    before = gradient.clone()
    call.backward_again()
    torch.testing.assert_close(gradient, 1.5 * before)


def test_blended_alphas_are_those_of_the_image():
    """Catches a floor that counts pixels beyond the Gaussian, or Gaussians behind the end of a pixel."""
    view = one_view(32, 24)
    fitted = scene.model("3dgs", 4, sigma=0.3)
    fitted.select(torch.tensor([0]))
    batch = fitted.slice(CameraTime.of(view.camera, view.time))
    drawn = rasterize_slice(batch, view.camera, torch.zeros(3), fitted.backend).alpha > 0
    assert 0 < drawn.sum() < drawn.numel()
    assert blended_alphas(recorded(fitted, view)["project"]) == drawn.sum()
    stacked = scene.model("3dgs", 20, sigma=30.0)  # each covers the image: 1e-4 of the light is left after some
    stacked.splats["opacities"].data.fill_(2.0)
    full = blended_alphas(recorded(stacked, view)["project"])
    assert 3 * 32 * 24 < full < 6 * 32 * 24


@pytest.fixture
def commit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A commit of a repository whose benchmarks read their results from its gsbench."""
    if shutil.which("git") is None:
        pytest.skip("needs git")
    root = tmp_path / "repository"
    texts = {
        "benchmarks/__init__.py": "",
        "benchmarks/__main__.py": MAIN,
        "gsbench/__init__.py": "MILLISECONDS = 0",
        "benchmarks/rows.py": "SECTIONS = {'loss': None, 'step': None}",
    }
    for path, text in texts.items():
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).write_text(text)
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b", "-c", "init.defaultBranch=main"]
    for arguments in (["init", "-q"], ["add", "."], ["commit", "-qm", "first"]):
        subprocess.run([*git, *arguments], cwd=root, check=True)
    monkeypatch.setattr(against, "ROOT", root)
    return subprocess.check_output(["git", "rev-parse", "HEAD"], cwd=root, text=True).strip()


def install(other: Built, _: Path) -> None:
    (other.folder / "site/gsbench").mkdir(parents=True)
    (other.folder / "site/gsbench/__init__.py").write_text("MILLISECONDS = 2.5")


def test_a_commit_is_measured_by_its_own_benchmarks(commit, tmp_path, monkeypatch):
    """Catches the benchmarks or the gsbench of this tree, which an editable install puts before others, and a folder of
    a hundred MiB, or an entry in git's list of worktrees, that Ctrl-C leaves behind."""
    monkeypatch.setattr(against, "_install", install)
    with suppress(KeyboardInterrupt), built("HEAD", tmp_path / "log") as other:
        assert other.commit == commit
        assert other.sections() == ["loss", "step"]
        assert other.medians("loss") == {("loss", "a"): 2.5}
        raise KeyboardInterrupt
    assert not other.folder.exists()
    assert subprocess.check_output(["git", "worktree", "list"], cwd=against.ROOT).count(b"\n") == 1


def test_a_commit_that_cannot_be_measured_is_one_line(commit, tmp_path, monkeypatch, capsys):
    """Catches a stack trace for a name that git does not know, for a build that fails, and for missing benchmarks."""

    def error(name: str) -> str:
        assert command.main(["loss", "--out", str(tmp_path), "--against", name]) == 2
        return capsys.readouterr().err.splitlines()[-1]

    unknown = error("nonsense")
    assert "expected a commit" in unknown
    assert "'nonsense'" in unknown
    monkeypatch.setattr(against, "INSTALL", ["-c", "print('first'); print('no compiler'); raise SystemExit(1)"])
    assert "expected it to build, got no compiler" in error(commit)
    assert (tmp_path / "against.log").read_text() == "first\nno compiler\n"
    monkeypatch.setattr(against, "_install", lambda *_: None)  # so that it has no gsbench
    monkeypatch.setattr(against, "LIST", "import no_such_module")
    monkeypatch.setattr(command, "limits", lambda: Limits(1, 1, 1))
    assert "No module named 'no_such_module': choose" in error(commit)


def test_the_table_shows_ratios_where_the_commit_has_the_row(tmp_path, monkeypatch, capsys):
    """Catches a ratio upside down or of another row, a column without cells, and sections that are not in turns."""
    calls: list[str] = []

    class Fake(Built):
        """A commit that has one of the sections, and in it one of two rows."""

        def sections(self) -> list[str]:
            return ["first"]

        def medians(self, section: str) -> dict[tuple[str, str], float]:
            calls.append(section)
            return {("s", "a"): 4.0}

    @contextmanager
    def fake(*_: object) -> Iterator[Built]:
        yield Fake("0123456789", tmp_path)

    sections = {
        key: lambda key=key: iter([Row("s", name, lambda: calls.append(f"our {key}"), pixels=1000) for name in "ab"])
        for key in ("first", "second")
    }
    monkeypatch.setattr(command, "SECTIONS", sections)
    monkeypatch.setattr(command, "built", fake)
    monkeypatch.setattr(command, "limits", lambda: Limits(1, 1, 1))
    monkeypatch.setattr(command, "measure", lambda call: call() or Cost(2.0, 1.0, 3.0, 2.0))
    assert command.main(["--out", str(tmp_path), "--against", "abc"]) == 0
    assert calls == ["first", "our first", "our first", "our second", "our second"]
    printed = capsys.readouterr().out
    assert printed.count("0123456 has no section second: its column is empty.") == 1
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in printed.splitlines() if line[:1] == "|"]
    assert {len(cells) for cells in lines} == {len(command.HEADER.split("|")) - 1}
    table = [dict(zip(lines[0], cells, strict=True)) for cells in lines if cells[0] in ("a", "b")]
    assert [row["x 0123456"] for row in table] == ["0.50", "", "", ""]
    assert {row["ns a pixel"] for row in table} == {"2000.0"}
    written = json.loads((tmp_path / "cpu.json").read_text())
    assert [row["against_ms"] for row in written["rows"]] == [4.0, None, None, None]
    assert written["machine"]["against"] == "0123456789"
    assert command.main(["--out", str(tmp_path), "--against", "abc", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"] == written["rows"]

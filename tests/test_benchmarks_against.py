"""`python -m benchmarks --against COMMIT`, of a small repository in place of this one; nothing is built or timed."""

import json
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from benchmarks import __main__ as command
from benchmarks import against
from benchmarks.against import Built, built
from benchmarks.roofline import Limits
from benchmarks.timing import Cost, Row

MAIN = """
import json, sys, gsbench
section, _, folder, _, name = sys.argv[1:]
rows = {"rows": [{"section": section, "name": "a", "median": gsbench.MILLISECONDS}]}
open(f"{folder}/{name}.json", "w").write(json.dumps(rows))
"""


@pytest.fixture
def commit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A commit of a repository whose benchmarks read their results from its gsbench."""
    if shutil.which("git") is None:
        pytest.skip("needs git")
    root = tmp_path / "repository"
    texts = {"benchmarks/__init__.py": "", "benchmarks/__main__.py": MAIN, "gsbench/__init__.py": "MILLISECONDS = 0",
             "benchmarks/rows.py": "SECTIONS = {'loss': None, 'step': None}"}  # fmt: skip
    for path, text in texts.items():
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).write_text(text)
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b", "-c", "init.defaultBranch=main"]
    for arguments in (["init", "-q"], ["add", "."], ["commit", "-qm", "first"]):
        subprocess.run([*git, *arguments], cwd=root, check=True)
    monkeypatch.setattr(against, "ROOT", root)
    return subprocess.check_output(["git", "rev-parse", "HEAD"], cwd=root, text=True).strip()


def install(commit_built: Built, _: Path) -> None:
    (commit_built.folder / "site/gsbench").mkdir(parents=True)
    (commit_built.folder / "site/gsbench/__init__.py").write_text("MILLISECONDS = 2.5")


def test_a_commit_is_measured_by_its_own_benchmarks(
    commit: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches the benchmarks or the gsbench of this tree, which an editable install puts before others."""
    monkeypatch.setattr(against, "_install", install)
    with built("HEAD", tmp_path / "log") as other:
        assert other.commit == commit
        assert other.sections() == ["loss", "step"]
        assert other.medians("loss") == {("loss", "a"): 2.5}


def test_nothing_is_left_behind_after_ctrl_c(commit: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a folder of a hundred MiB, or an entry in git's list of worktrees, for each measurement that is ended."""
    monkeypatch.setattr(against, "_install", install)
    folders = []

    def interrupted() -> None:
        with built(commit, tmp_path / "log") as other:
            assert (other.folder / "tree/benchmarks").is_dir()
            folders.append(other.folder)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert not folders[0].exists()
    assert subprocess.check_output(["git", "worktree", "list"], cwd=against.ROOT).count(b"\n") == 1


def test_a_commit_that_cannot_be_measured_is_one_line(
    commit: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a stack trace for a name that git does not know, for a build that fails, and for missing benchmarks."""
    arguments = ["loss", "--out", str(tmp_path), "--against"]
    assert command.main([*arguments, "nonsense"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "expected a commit" in error
    assert "'nonsense'" in error
    monkeypatch.setattr(against, "INSTALL", ["-c", "print('first'); print('no compiler'); raise SystemExit(1)"])
    assert command.main([*arguments, commit]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert "expected it to build, got no compiler" in error
    assert (tmp_path / "against.log").read_text() == "first\nno compiler\n"
    monkeypatch.setattr(against, "_install", lambda *_: None)  # so that it has no gsbench
    monkeypatch.setattr(against, "LIST", "import no_such_module")
    monkeypatch.setattr(command, "limits", lambda: Limits(1, 1, 1))
    assert command.main([*arguments, commit]) == 2
    assert "No module named 'no_such_module': choose" in capsys.readouterr().err.splitlines()[-1]


class Fake(Built):
    """A commit that has one of the sections, and in it one of two rows."""

    calls: list[str]

    def sections(self) -> list[str]:
        return ["first"]

    def medians(self, section: str) -> dict[tuple[str, str], float]:
        self.calls.append(section)
        return {("s", "a"): 4.0}


def test_the_table_shows_ratios_where_the_commit_has_the_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a ratio upside down or of another row, a column without cells, and sections that are not in turns."""
    calls: list[str] = []
    Fake.calls = calls

    @contextmanager
    def fake(*_: object) -> Iterator[Built]:
        yield Fake("0123456789", tmp_path)

    sections = {key: lambda key=key: iter([Row("s", name, lambda: calls.append(f"our {key}")) for name in "ab"])
                for key in ("first", "second")}  # fmt: skip
    monkeypatch.setattr(command, "SECTIONS", sections)
    monkeypatch.setattr(command, "built", fake)
    monkeypatch.setattr(command, "limits", lambda: Limits(1, 1, 1))
    monkeypatch.setattr(command, "measure", lambda call: call() or Cost(2.0, 1.0, 3.0, 2.0))
    assert command.main(["--out", str(tmp_path), "--against", "abc"]) == 0
    assert calls == ["first", "our first", "our first", "our second", "our second"]
    printed = capsys.readouterr().out
    assert printed.count("0123456 has no section second: its column is empty.") == 1
    tables = [[cell.strip() for cell in line.split("|")[1:-1]] for line in printed.splitlines() if line[:1] == "|"]
    assert {len(cells) for cells in tables} == {len(command.HEADER.split("|")) - 1}
    assert tables[0][-1] == "x 0123456"
    assert [cells[-1] for cells in tables if cells[0] in ("a", "b")] == ["0.50", "", "", ""]
    written = json.loads((tmp_path / "cpu.json").read_text())
    assert [row["against_ms"] for row in written["rows"]] == [4.0, None, None, None]
    assert written["machine"]["against"] == "0123456789"
    assert command.main(["--out", str(tmp_path), "--against", "abc", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"] == written["rows"]

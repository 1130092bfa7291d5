"""The worked example of docs/adding_a_model.md, run as a reader would run it."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from tiny_run import ROOT, environment, overrides, write_moving_square

from gsbench.measure import record


def blocks() -> dict[str, str]:
    """The example's two files by their path in the project."""
    page = (ROOT / "docs" / "adding_a_model.md").read_text()
    found = re.findall(r"^`([\w/]+\.(?:py|yaml))`:\n\n```\w+\n(.*?)^```", page, flags=re.MULTILINE | re.DOTALL)
    assert len(found) == 2
    return dict(found)


def test_the_worked_example_trains_with_and_without_agr(tmp_path: Path) -> None:
    """Catches documentation that no longer runs: a copy of the project, the page's two files, a short run of each."""
    project = tmp_path / "project"
    shutil.copytree(ROOT / "gsbench", project / "gsbench", ignore=shutil.ignore_patterns("__pycache__", "moving-matte"))
    shutil.copytree(ROOT / "conf", project / "conf")
    for path, text in blocks().items():
        (project / path).write_text(text)
    data, results = write_moving_square(tmp_path / "data"), tmp_path / "results"
    # An editable install finds gsbench by a hook that goes before PYTHONPATH; the copy is what is to be run.
    start = (
        "import runpy, sys\n"
        "sys.meta_path[:] = [finder for finder in sys.meta_path if 'Redirecting' not in type(finder).__name__]\n"
        "runpy.run_module('gsbench', run_name='__main__', alter_sys=True)"
    )
    done = subprocess.run(
        [sys.executable, "-c", start, "-m", *overrides(data, results, "model=balls", "agr=true,false")],
        capture_output=True, text=True, cwd=project, check=False,
        env={**environment(), "PYTHONPATH": os.fspath(project)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    labels = {record.read(path).model for path in record.find(results)}
    assert labels == {"balls", "balls_agr"}


def test_the_example_passes_the_linters(tmp_path: Path) -> None:
    """Catches an example that a reader's `make lint` would refuse."""
    source = tmp_path / "balls.py"
    source.write_text(next(text for path, text in blocks().items() if path.endswith(".py")))
    done = subprocess.run(
        [sys.executable, "-m", "ruff", "check", "--config", str(ROOT / "pyproject.toml"), str(source)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout

"""Build another commit in a temporary folder, and time its rows by its own benchmarks."""

import io
import json
import os
import subprocess
import sys
import tarfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from gsbench import kernels
from gsbench.errors import InputError, printable

ROOT = Path(__file__).resolve().parents[1]
INSTALL = [
    "-m",
    "pip",
    "install",
    "--quiet",
    "--disable-pip-version-check",
    "--no-deps",
    "--no-build-isolation",
    "--use-pep517",
    "--config-settings",
    "cmake.define.CUDA=off",
]
# An editable install puts a finder before PYTHONPATH, by which `import gsbench` would find this tree.
WITHOUT_EDITABLE = (
    "import runpy, sys; "
    "sys.meta_path[:] = [finder for finder in sys.meta_path if 'Redirecting' not in type(finder).__name__]; "
)
RUN = WITHOUT_EDITABLE + "runpy.run_module('benchmarks', run_name='__main__', alter_sys=True)"
LIST = WITHOUT_EDITABLE + "from benchmarks.rows import SECTIONS; print(*SECTIONS)"


@dataclass(frozen=True)
class Built:
    """A commit that is built in `folder`: its files in `tree`, its installed package in `site`."""

    commit: str
    folder: Path

    @property
    def short(self) -> str:
        return self.commit[:7]

    def sections(self) -> list[str]:
        """List the sections that its benchmarks have."""
        return self._python(LIST).split()

    def medians(self, section: str) -> dict[tuple[str, str], float]:
        """Time a section; return the median milliseconds by section and name of the row."""
        self._python(RUN, section, "--out", os.fspath(self.folder), "--name", "rows")
        rows = json.loads((self.folder / "rows.json").read_text())["rows"]
        return {(row["section"], row["name"]): row["median"] for row in rows}

    def _python(self, code: str, *arguments: str) -> str:
        paths = os.pathsep.join(os.fspath(self.folder / name) for name in ("site", "tree"))
        done = subprocess.run(
            [sys.executable, "-c", code, *arguments],
            cwd=self.folder,
            check=False,
            text=True,
            env={**os.environ, "PYTHONPATH": paths},
            capture_output=True,
        )
        if done.returncode:
            raise InputError(
                f"--against {self.short}: expected its `python -m benchmarks` to run, got "
                f"{_last_line(done.stderr)}: choose a later commit"
            )
        return done.stdout


@contextmanager
def built(commit: str, log: Path) -> Iterator[Built]:
    """Build a commit of this repository in a temporary folder, which is removed at the end, also on Ctrl-C.

    Args:
        commit: its name, as git knows it.
        log: a file for the output of a build that fails.

    Raises:
        InputError: git does not know the commit, or it cannot be built.
    """
    full = _git("rev-parse", "--verify", "--quiet", "--end-of-options", f"{commit}^{{commit}}").decode().strip()
    if not full:
        raise InputError(
            f"--against: expected a commit of the repository {ROOT}, got {printable(commit)!r:.80}: "
            "`git log` lists them"
        )
    with TemporaryDirectory(prefix="gsbench-against-") as name:
        other = Built(full, Path(name))
        with tarfile.open(fileobj=io.BytesIO(_git("archive", full))) as files:
            files.extractall(other.folder / "tree", filter="data")
        print(f"{other.short}: building it, about a minute", file=sys.stderr)
        _install(other, log)
        yield other


def _install(commit: Built, log: Path) -> None:
    # Only the instruction set that is timed; not every commit has the word `native` for it.
    levels = f"cmake.define.GSB_LEVELS={kernels.native().active()}"
    site, tree = (os.fspath(commit.folder / name) for name in ("site", "tree"))
    done = subprocess.run(
        [sys.executable, *INSTALL, "--config-settings", levels, "--target", site, tree],
        check=False,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    if done.returncode:
        log.parent.mkdir(parents=True, exist_ok=True)
        log.write_text(done.stdout)
        raise InputError(
            f"--against {commit.short}: expected it to build, got {_last_line(done.stdout)}: read {log}, "
            "or choose another commit"
        )


def _git(*arguments: str) -> bytes:
    """Return what a git command prints, or nothing if it fails."""
    try:
        return subprocess.run(["git", *arguments], cwd=ROOT, check=True, capture_output=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return b""


def _last_line(text: str) -> str:
    lines: Sequence[str] = [line.strip() for line in text.splitlines() if line.strip()]
    return printable(lines[-1])[:200] if lines else "no message"

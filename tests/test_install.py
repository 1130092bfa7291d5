"""The sdist and a wheel of it, made offline where there is no compiler: what is in them, and that they run."""

import os
import re
import shutil
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from forked import python
from tiny_run import ROOT, environment

from gsbench.version import __version__

MB = 1e6
HOOK = """
import sys
from scikit_build_core import build
hook, out, *settings = sys.argv[1:]
print(getattr(build, hook)(out, dict(setting.split("=", 1) for setting in settings)))
"""


def built(hook: str, project: Path, out: Path, *settings: str, **environment: str) -> tuple[Path, str]:
    """Call a hook of the build backend as pip does; returns the file it made and what it said."""
    done = python("-c", HOOK, hook, str(out), *settings, cwd=project, env=os.environ | environment)
    assert done.returncode == 0, done.stderr + done.stdout
    return out / done.stdout.splitlines()[-1], done.stderr + done.stdout


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built("build_sdist", ROOT, tmp_path_factory.mktemp("sdist"))[0]


def test_the_sdist_has_what_builds_and_tests_it(sdist):
    """Catches an sdist without sources or scenes, or one that records, builds and trials have bloated."""
    assert sdist.name == f"gsbench_splatting-{__version__}.tar.gz"  # as .github/workflows/wheels.yml expects it
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    for name in (
        "CMakeLists.txt",
        "conf/exp/mini.yaml",
        "gsbench/kernels/cpu/triangular.cpp",
        "tests/smoke.py",
        "gsbench/scenes/sample/suzanne/transforms_train.json",
        "constraints.txt",
        "LICENSE",
    ):
        assert name in names
    assert not [name for name in names if re.match(r"results/|build/|\.venv/|dist/", name) or name.endswith(".so")]
    assert sdist.stat().st_size < 15 * MB


@pytest.mark.skipif(not all(map(shutil.which, ("cmake", "ninja"))), reason="needs cmake and ninja")
def test_without_a_compiler_it_installs_and_says_that_it_is_slow(sdist, tmp_path):
    """Catches an install that fails for want of a compiler, a wheel without configs or scenes, and silence."""
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path / "source", filter="data")
    (source,) = (tmp_path / "source").iterdir()
    # Any cmake will do for what is not built.
    wheel, printed = built("build_wheel", source, tmp_path, "cmake.version=>=3.22", CXX="/bin/false")
    assert "the native kernels are not built, for want of a C++20 compiler" in " ".join(printed.split())
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        archive.extractall(tmp_path / "site")
    assert not [name for name in names if name.endswith((".so", ".cpp", ".cu"))]
    assert wheel.stat().st_size < 15 * MB
    # Without `site`, as an editable install would come before the wheel.
    path = os.pathsep.join([str(tmp_path / "site"), *[entry for entry in sys.path if entry.endswith("-packages")]])
    smoke = ("-S", str(ROOT / "tests/smoke.py"), "reference")
    done = python(*smoke, env=environment() | {"PYTHONPATH": path})
    assert done.returncode == 0, done.stderr
    assert "steps by reference" in done.stdout

"""What a release says in several places: its version, and the Pythons that it runs on."""

import fnmatch
import re
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.specifiers import SpecifierSet
from tiny_run import ROOT

import gsbench
from gsbench import doctor
from gsbench.errors import how_to_install

PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PYTHONS = [f"3.{n}" for n in range(30) if f"3.{n}" in SpecifierSet(PYPROJECT["project"]["requires-python"])]
DISTRIBUTION = PYPROJECT["project"]["name"].replace("-", "_")  # as files are named
MAKEFILE = (ROOT / "Makefile").read_text()


def workflow(name: str) -> dict[str, Any]:
    parsed: dict[str, Any] = yaml.safe_load((ROOT / ".github/workflows" / name).read_text())
    return parsed


def commands(jobs: dict[str, Any]) -> str:
    """What the steps of a workflow run, one after the other."""
    return "\n".join(step.get("run", "") for job in jobs.values() for step in job["steps"])


def test_the_version_and_its_day_are_one():
    """Catches a release without notes, or whose citation, metadata or pages name another version or another day."""
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    changes = (ROOT / "CHANGELOG.md").read_text()
    released = re.findall(r"^## (\d+\.\d+\.\d+) \((\d{4}-\d\d-\d\d)\)$", changes, re.MULTILINE)
    cited = str(citation["version"]), str(citation["date-released"])
    assert released[0] == cited
    assert cited[0] == gsbench.__version__
    assert "version" not in PYPROJECT["project"]
    (source,) = (entry["input"] for entry in PYPROJECT["tool"]["dynamic-metadata"] if entry["field"] == "version")
    assert f'__version__ = "{gsbench.__version__}"' in (ROOT / source).read_text()
    for page in ("CONTRIBUTING.md", "docs/install.md"):
        named = re.findall(r"(?:gsbench(?:_splatting)?[- ]|\bv)(\d+\.\d+\.\d+)", (ROOT / page).read_text())
        assert {*named} == {gsbench.__version__}, page


STRANGERS = re.compile(r"gsbench\[[a-zA-Z]|pip3? install(?: +-\S+(?: +\S+\.txt)?)* +['\"]?gsbench(?![\w.-])")
"""What installs another project's package, which has the name gsbench in PyPI."""


def test_nobody_is_told_to_install_a_strangers_package():
    """Catches a page, a message, a workflow or an image that installs gsbench by that name, and that name itself."""
    bad = ("pip install 'gsbench[view]'", "`pip install gsbench`", "pip install -c c.txt gsbench==0.3", "gsbench[dev]")
    good = (f"'{how_to_install('view')}'", "pip install gsbench_splatting-0.3.0-cp311.whl", "pip install -c c.txt .")
    assert [bool(STRANGERS.search(line)) for line in (*bad, *good)] == [True] * len(bad) + [False] * len(good)
    tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if tracked.returncode:
        pytest.skip("not a checkout: git lists no files")
    suffixes = {"", ".md", ".py", ".yml", ".yaml", ".toml", ".txt", ".def", ".ipynb", ".j2", ".sh", ".cff"}
    files = [ROOT / name for name in tracked.stdout.split("\0") if Path(name).suffix in suffixes]
    silent = ("CHANGELOG.md", Path(__file__).name)
    texts = {path: path.read_text() for path in files if path.is_file() and path.name not in silent}
    assert len(texts) > 300
    assert {path: match[0] for path, text in texts.items() if (match := STRANGERS.search(text))} == {}
    assert PYPROJECT["project"]["name"] != "gsbench"
    assert PYPROJECT["project"]["scripts"] == {"gsbench": doctor.COMMAND}


def test_every_python_is_tested():
    """Catches a Python that is allowed and not tested, or tested and refused by make."""
    jobs = workflow("tests.yml")["jobs"]
    assert jobs["test"]["strategy"]["matrix"]["python"] == PYTHONS
    low, high = re.search(r"\((3, \d+)\) <= sys.version_info < \((3, \d+)\)", MAKEFILE).groups()  # type: ignore[union-attr]
    assert PYTHONS[0] == low.replace(", ", ".")
    assert [int(PYTHONS[-1][2:]) + 1] == [int(high[3:])]
    assert PYPROJECT["tool"]["ruff"]["target-version"] == f"py{PYTHONS[0].replace('.', '')}"
    for page in ("CONTRIBUTING.md", "docs/install.md"):
        assert f"Python {PYTHONS[0]} to {PYTHONS[-1]}" in (ROOT / page).read_text()


def test_a_wheel_is_made_for_every_python_and_tried():
    """Catches wheels that leave out a Python, or that no one has installed."""
    settings = PYPROJECT["tool"]["cibuildwheel"]
    assert settings["build"] == "cp3*-manylinux_*"  # of which cibuildwheel takes those that requires-python allows
    assert "skip" not in settings
    assert settings["test-command"].startswith("python {project}/")
    assert (ROOT / settings["test-command"].partition("{project}/")[2]).is_file()


def test_the_image_is_of_a_wheel_of_this_project():
    """Catches an image of another Python or without pins, one that runs as root, and one that Apptainer cannot find."""
    folder = ROOT / "containers"
    text = re.sub(r"\\\n\s*", "", (folder / "Dockerfile").read_text())
    steps = [(word, rest) for word, rest in re.findall(r"^([A-Z]+) (.*)$", text, re.MULTILINE)]
    last_step = dict(steps)  # the last of each
    *sources, target = last_step["COPY"].split()
    (wheel,) = (entry for entry in sources if entry.endswith(".whl"))
    assert fnmatch.fnmatch(f"dist/{DISTRIBUTION}-{gsbench.__version__}-cp311-cp311-manylinux_2_28_x86_64.whl", wheel)
    assert "3.11" in PYTHONS
    assert "Python 3.11" in text  # of the base image
    kept = [line[1:] for line in (folder / "Dockerfile.dockerignore").read_text().splitlines() if line[0] == "!"]
    for source in sources:
        assert any(fnmatch.fnmatch(source.replace("*", "x"), entry) for entry in kept), source
        assert source == wheel or (ROOT / source).is_file()
    (install,) = (rest for word, rest in steps if "pip install" in rest and word == "RUN")
    assert f"--constraint {target}constraints.txt" in install
    (extras,) = re.findall(r"\$wheel\[([a-z,]+)\]", install)
    assert set(extras.split(",")) <= PYPROJECT["project"]["optional-dependencies"].keys()
    assert [word for word, _ in steps].index("USER") > steps.index(("RUN", install))
    assert last_step["USER"] not in ("root", "0")
    assert last_step["ENTRYPOINT"] == '["python", "-m", "gsbench"]'
    definition = (folder / "gsbench.def").read_text()
    (archive,) = re.findall(r"^From: (.*)$", definition, re.MULTILINE)
    assert f"docker save gsbench -o {archive}" in definition
    assert "--file containers/Dockerfile --tag gsbench " in MAKEFILE


@pytest.mark.parametrize("name", ["tests.yml", "wheels.yml"])
def test_workflows_run_what_there_is(name):
    """Catches a target of make, a script or a file of a trigger that has been renamed."""
    parsed = workflow(name)
    lines = commands(parsed["jobs"])
    targets = re.findall(r"^make ([a-z-]+)", lines, re.MULTILINE)
    assert all(re.search(rf"^{target}:", MAKEFILE, re.MULTILINE) for target in targets)
    files = re.findall(r"tests/\w+\.py|constraints\.txt", lines)
    files += (parsed[True].get("pull_request") or {}).get("paths", [])  # YAML 1.1 reads `on` as true
    assert targets or files
    assert all(any(ROOT.glob(file)) for file in files)

"""What `make` installs: everything by version and hash, nothing of it forgotten, and actions by their commit."""

import hashlib
import itertools
import re
import sys
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from forked import ended
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from tiny_run import ROOT

LOCKS = sorted((ROOT / "locks").glob("*.txt"))
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
OURS = PYPROJECT["project"]
TRACKERS = {"tensorboard", "wandb", "mlflow"}  # extras that `make` does not install
MAKEFILE = (ROOT / "Makefile").read_text()
INSTALLED = ("build", "docs", "tests", "torch_cpu")  # on this machine; torch.txt where there is a GPU, uv.txt by no one


def locked(path: Path) -> dict[str, list[Requirement]]:
    """The requirements of a lock by name; where a package has no version for every Python, there are two."""
    by_name: dict[str, list[Requirement]] = {}
    for line in path.read_text().replace("\\\n", " ").splitlines():
        if line and not line.startswith("#"):
            requirement = Requirement(line.partition(" --hash=")[0])
            by_name.setdefault(canonicalize_name(requirement.name), []).append(requirement)
    return by_name


ALL: dict[str, list[Requirement]] = {}
for lock in LOCKS:
    ALL |= locked(lock) if lock.stem != "torch_cpu" else {}


def holds(asked: Requirement) -> bool:
    """Whether every locked version of a package is one that is asked for."""
    versions = [str(package.specifier).removeprefix("==") for package in ALL.get(canonicalize_name(asked.name), [])]
    return bool(versions) and all(asked.specifier.contains(version, prereleases=True) for version in versions)


@pytest.mark.parametrize("path", LOCKS, ids=lambda path: path.stem)
def test_every_line_has_one_version_and_its_hashes(path):
    """Catches a line that pip would take from anybody."""
    lines = [line for line in path.read_text().replace("\\\n", " ").splitlines() if not line.startswith("#")]
    assert lines
    for line in lines:
        assert re.fullmatch(r"[a-z0-9._-]+==[^ ,*]+( ; [^#]+?)?( +--hash=sha256:[0-9a-f]{64})+", line), line


def test_what_gsbench_asks_for_is_locked():
    """Catches a dependency that is added to pyproject.toml or changed in constraints.txt without `make locks`."""
    extras = [extra for name, extra in OURS["optional-dependencies"].items() if name not in TRACKERS]
    asked = [*OURS["dependencies"], *PYPROJECT["build-system"]["requires"], *itertools.chain(*extras)]
    assert [package for package in asked if not holds(Requirement(package))] == []
    pins = (ROOT / "constraints.txt").read_text().splitlines()
    assert [pin for pin in pins if not pin.startswith("#") and not holds(Requirement(pin))] == []
    (cpu,) = locked(ROOT / "locks/torch_cpu.txt")["torch"]
    assert str(cpu.specifier) == f"{ALL['torch'][0].specifier}+cpu"


def test_what_comes_along_is_locked():
    """Catches a package that is missing in a new .venv, as pip is told not to look for what a package needs."""
    missing = []
    for name in {name for path in LOCKS if path.stem in INSTALLED for name in locked(path)}:
        try:
            needed = metadata.requires(name) or []
        except metadata.PackageNotFoundError:  # for another system, or a site that this .venv does not build
            continue
        for requirement in map(Requirement, needed):
            if (requirement.marker is None or requirement.marker.evaluate({"extra": ""})) and not holds(requirement):
                missing.append(f"{name} needs {requirement}")
    assert missing == []


def test_make_installs_locks_and_nothing_else():
    """Catches a package that is installed by name, a lock that nobody installs, and tools fetched to build with."""
    installs = re.findall(r"^.*pip install .*$", MAKEFILE, re.MULTILINE)
    assert all("--no-deps" in line and ("--require-hashes" in line or line.startswith("PIP := ")) for line in installs)
    assert re.search(r"^PIP := .*--no-build-isolation", MAKEFILE, re.MULTILINE)
    assert re.search(r"^LOCKED := \$\(PIP\) --require-hashes ", MAKEFILE, re.MULTILINE)
    assert len(re.findall(r"\$\(PIP\) ", MAKEFILE)) == 2  # the locks, and gsbench itself
    assert set(re.findall(r"(?:\$\(LOCKED\)|locks)/(\w+)\.txt", MAKEFILE)) == {path.stem for path in LOCKS}


def test_a_file_with_another_hash_is_refused(tmp_path):
    """Catches options of pip under which hashes are not looked at: the Makefile's own are tried on a small wheel."""
    wheel, lock = tmp_path / "trial-1-py3-none-any.whl", tmp_path / "lock.txt"
    texts = {
        "METADATA": "Metadata-Version: 2.1\nName: trial\nVersion: 1\n",
        "RECORD": "",
        "WHEEL": "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    with zipfile.ZipFile(wheel, "w") as archive:
        for name, text in texts.items():
            archive.writestr(f"trial-1.dist-info/{name}", text)
    (options,) = re.findall(r"^PIP := \$\(BIN\)/pip (.*)$", MAKEFILE, re.MULTILINE)
    pip = [sys.executable, "-m", "pip", *options.split(), "--require-hashes", "--no-index", f"--find-links={tmp_path}"]
    right = hashlib.sha256(wheel.read_bytes()).hexdigest()
    for digest, message in (("0" * 64, "DO NOT MATCH THE HASHES"), (right, "")):
        lock.write_text(f"trial==1 --hash=sha256:{digest}\n")
        done = ended(*pip, "--target", str(tmp_path / "out"), "--requirement", str(lock))
        assert bool(done.returncode) == bool(message), done.stderr
        assert message in done.stderr
        assert (tmp_path / "out").exists() != bool(message)


def test_actions_are_named_by_commit():
    """Catches an action whose tag its owner, or a thief, can move."""
    for path in (ROOT / ".github/workflows").glob("*.yml"):
        used = re.findall(r"uses: *(.*)", path.read_text())
        assert used
        assert all(re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40} # v[\d.]+", requirement) for requirement in used), used

"""Write the table of docs/licences.md from the metadata of installed packages, or print an SBOM with --sbom.

    python docs/site/licences.py
    python docs/site/licences.py --sbom > gsbench.cdx.json      # CycloneDX 1.6: what users install

The table says what is installed where it is written: run it in the .venv of `make test-all`, which has the versions of
locks/.
"""

import json
import re
import sys
import tomllib
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from gsbench.version import __version__

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "licences.md"
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT: dict[str, Any] = PYPROJECT["project"]
EXTRAS: dict[str, list[str]] = PROJECT["optional-dependencies"]
OF_DEVELOPERS = ("docs", "dev")  # nothing of these is imported by gsbench
# What no .venv of make has, as it would double its size.
NOT_INSTALLED = {"tensorboard": "Apache-2.0", "wandb": "MIT", "mlflow": "Apache-2.0"}
WITHOUT_METADATA = {"axe-playwright-python": "MIT"}
NOTES = {
    "lpips": "its linear weights come in its wheel",
    "opencv-contrib-python-headless": "its wheel brings FFmpeg under LGPL-2.1, as a library of its own",
    "sphinx": "its docutils is public domain and BSD-2-Clause, except an Emacs mode under the GPL",
    "nanobind": "linked into the kernels",
    "vl-convert-python": "brings Vega, Vega-Lite and Vega-Embed under BSD-3-Clause, © University of Washington "
    "Interactive Data Lab and contributors, which are a part of each `report.html`",
    "axe-playwright-python": "axe itself is under MPL-2.0",
    "plyfile": "under the GPL, but only tests use it, to check gsbench's own PLY code; users do not install it",
}
CUDA = re.compile(r"nvidia-|cuda-|triton$")  # what torch for CUDA brings: NVIDIA's own licence
MARKS = "<!-- written by docs/site/licences.py -->", "<!-- end -->"
SHORT = {
    "Apache Software License": "Apache-2.0",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "Python Software Foundation License": "PSF-2.0",
    "ISC License (ISCL)": "ISC",
    "GNU General Public License v3 or later (GPLv3+)": "GPL-3.0-or-later",
}


def of_users() -> dict[str, metadata.Distribution]:
    """Return what users install, as far as it is here: gsbench's requirements, of extras too, and what these bring."""
    packages: dict[str, metadata.Distribution] = {}
    extras = [requirement for extra in EXTRAS.keys() - {*OF_DEVELOPERS} for requirement in EXTRAS[extra]]
    waiting = [*PROJECT["dependencies"], *extras]
    while waiting:
        requirement = Requirement(waiting.pop())
        name = canonicalize_name(requirement.name)
        if name in packages or (requirement.marker and not requirement.marker.evaluate({"extra": ""})):
            continue
        with suppress(metadata.PackageNotFoundError):
            packages[name] = metadata.distribution(name)
            waiting += packages[name].requires or []
    return dict(sorted(packages.items()))


def direct() -> dict[str, str]:
    """Return what gsbench itself depends on, and for what: the core, an extra, or the build."""
    groups = {"core": PROJECT["dependencies"], "build": PYPROJECT["build-system"]["requires"], **EXTRAS}
    group_of: dict[str, str] = {}
    for group in (*(name for name in groups if name not in OF_DEVELOPERS), *OF_DEVELOPERS):
        for requirement in groups[group]:
            group_of.setdefault(canonicalize_name(Requirement(requirement).name), group)
    return group_of


def along() -> dict[str, metadata.Distribution]:
    """Return what users install that gsbench does not name, without what only torch for CUDA brings."""
    return {name: package for name, package in of_users().items() if name not in direct() and not CUDA.match(name)}


def licence_of(distribution: metadata.Distribution) -> str:
    """Return what the metadata say: the SPDX expression, a licence field that is a name, else the classifiers."""
    facts = distribution.metadata
    field = (facts.get("License") or "").strip()
    is_name = re.fullmatch(r"[A-Za-z0-9.+-]+( (AND|OR|WITH) [A-Za-z0-9.+-]+)*", field) and field != "UNKNOWN"
    names = [
        line.rpartition(" :: ")[2]
        for line in facts.get_all("Classifier") or []
        if line.startswith("License :: OSI Approved ::") or line == "License :: Public Domain"
    ]
    short = ", ".join(SHORT.get(name, name.removesuffix(" License")) for name in names)
    missing = WITHOUT_METADATA.get(canonicalize_name(facts["Name"]), field.partition("\n")[0])
    return facts.get("License-Expression") or (field if is_name else "") or short or missing


def tables() -> str:
    """Return the table of the page, a row for each licence, and what is to be known of single packages."""
    packages = dict.fromkeys([*direct(), *along()], "")
    for name in packages:
        try:
            packages[name] = NOT_INSTALLED.get(name) or licence_of(metadata.distribution(name))
        except metadata.PackageNotFoundError:
            sys.exit(f"licences: expected {name} to be installed, it is not: run make docs first")
    developers = {name for name, group in direct().items() if group in OF_DEVELOPERS}
    rows = ["| licence | of users | of developers only |", "| --- | --- | --- |"]
    for licence in sorted(set(packages.values())):
        names = [name for name in sorted(packages) if packages[name] == licence]
        users, others = [n for n in names if n not in developers], [n for n in names if n in developers]
        title = f"**{licence}**" if "GPL" in licence else licence
        rows.append(f"| {title} | {', '.join(users)} | {', '.join(others)} |")
    return "\n".join([*rows, "", *(f"- {name}: {note}." for name, note in NOTES.items())])


def sbom() -> dict[str, Any]:
    """Return what users install here as a bill of materials in the format CycloneDX 1.6."""

    def component(kind: str, name: str, version: str, licence: str) -> dict[str, Any]:
        facts = {"type": kind, "name": name, "version": version, "purl": f"pkg:pypi/{name}@{version}"}
        return facts | {"licenses": [{"license": {"name": licence}}]}

    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {"component": component("application", PROJECT["name"], __version__, PROJECT["license"])},
        "components": [component("library", name, dist.version, licence_of(dist)) for name, dist in of_users().items()],
    }


def main(arguments: list[str]) -> None:
    """Print an SBOM, or write the tables between the marks of the page."""
    if arguments == ["--sbom"]:
        print(json.dumps(sbom(), indent=1))
        return
    start, end = MARKS
    head, _, rest = PAGE.read_text().partition(start)
    PAGE.write_text(f"{head}{start}\n\n{tables()}\n\n{end}{rest.partition(end)[2]}")


if __name__ == "__main__":
    main(sys.argv[1:])

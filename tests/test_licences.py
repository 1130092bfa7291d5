"""The licences of what users install: listed, and none that would bind gsbench."""

import re
import tomllib
from collections.abc import Iterator
from importlib import metadata

from packaging.requirements import Requirement
from tiny_run import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
OF_DEVELOPERS = {"dev", "docs"}  # nothing of these is imported by gsbench


def name_of(requirement: str) -> str:
    return re.sub(r"[-_.]+", "-", Requirement(requirement).name).lower()


def installed(requirements: list[str], seen: set[str]) -> Iterator[metadata.Distribution]:
    """What requirements bring along, as far as it is installed here."""
    for requirement in requirements:
        marker, name = Requirement(requirement).marker, name_of(requirement)
        if name in seen or (marker and not marker.evaluate({"extra": ""})):
            continue
        seen.add(name)
        try:
            found = metadata.distribution(name)
        except metadata.PackageNotFoundError:
            continue
        yield found
        yield from installed(found.requires or [], seen)


def licence_of(distribution: metadata.Distribution) -> str:
    """What the metadata say: the expression, else the classifiers, else the first line of the licence."""
    said = distribution.metadata
    classifiers = [text for text in said.get_all("Classifier") or [] if text.startswith("License ::")]
    first = (said.get("License") or "").strip().partition("\n")[0]
    return said.get("License-Expression") or " ".join(classifiers) or first


def test_every_dependency_is_listed() -> None:
    """Catches a dependency whose licence nobody has looked at."""
    page = (ROOT / "docs" / "licences.md").read_text()
    listed = {
        name.strip() for row in re.findall(r"^\| ([a-z0-9, -]+) \|", page, re.MULTILINE) for name in row.split(",")
    }
    asked = {name_of(one) for requirements in (PROJECT["dependencies"], *EXTRAS.values()) for one in requirements}
    assert asked <= listed


def test_no_user_installs_the_gpl() -> None:
    """Catches a library whose licence would become that of every program that imports gsbench."""
    users = [*PROJECT["dependencies"], *(one for extra in EXTRAS.keys() - OF_DEVELOPERS for one in EXTRAS[extra])]
    found = {one.metadata["Name"]: licence_of(one) for one in installed(users, set())}
    assert len(found) > 20
    bound = {name: said for name, said in found.items() if re.search(r"(?<!L)GPL|General Public License", said)}
    bound = {name: said for name, said in bound.items() if "Lesser" not in said}
    assert bound == {}


def test_the_gpl_would_be_found() -> None:
    """Catches a search that finds nothing whatever the licence is: plyfile, which only tests use, is under the GPL."""
    assert re.search(r"(?<!L)GPL|General Public License", licence_of(metadata.distribution("plyfile")))

"""The licences of what users install: listed as their metadata say, and none that would bind gsbench."""

import json
import re
from importlib import metadata

import licences
import pytest
from licences import licence_of, name_of

PAGE = licences.PAGE.read_text()
# Name, version and licence of each row; the first table has a column more.
ROWS = {row[0]: (row[1], row[-1]) for row in (line.strip("| ").split(" | ") for line in PAGE.splitlines()
        if re.match(r"\| [a-z0-9-]+ \| .*\|$", line)) if row[0] not in ("dependency", "package", "---")}  # fmt: skip
GPL = re.compile(r"(?<!L)GPL|(?<!Lesser )General Public License")


def test_every_dependency_is_listed() -> None:
    """Catches a dependency whose licence nobody has looked at."""
    assert licences.direct().keys() <= ROWS.keys()
    assert {name_of(package.metadata["Name"]) for package in licences.along()} <= ROWS.keys()
    assert len(licences.along()) > 20


@pytest.mark.parametrize("name", ROWS)
def test_the_tables_say_what_the_metadata_say(name: str) -> None:
    """Catches a table that was written by hand, or before a dependency took another licence."""
    version, text = ROWS[name]
    try:
        listed = metadata.distribution(name)
    except metadata.PackageNotFoundError:
        pytest.skip("not installed here")
    licence = licence_of(listed)
    assert licence
    assert bool(GPL.search(licence)) == ("**GPL" in text)
    if listed.version.partition("+")[0] == version:  # of another version the text may differ
        assert text.replace("*", "").partition("; ")[0] == licence


def test_no_user_installs_the_gpl() -> None:
    """Catches a library whose licence would become that of every program that imports gsbench."""
    every = licences.installed(licences.of_users(), set())
    listed = {package.metadata["Name"]: licence_of(package) for package in every}
    assert len(listed) > 20
    assert {name: text for name, text in listed.items() if GPL.search(text)} == {}


def test_the_gpl_would_be_found() -> None:
    """Catches a search that finds nothing whatever the licence is: plyfile, which only tests use, is under the GPL."""
    assert GPL.search(licence_of(metadata.distribution("plyfile")))


def test_the_sbom_lists_what_users_install(capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a bill of materials that leaves out what comes along, or has what only developers install."""
    licences.main(["--sbom"])
    listed = json.loads(capsys.readouterr().out)
    named = {package["name"]: package for package in listed["components"]}
    assert listed["metadata"]["component"]["purl"].startswith("pkg:pypi/gsbench-splatting@")
    assert {"torch", "markupsafe", "viser"} <= named.keys()
    assert not {"plyfile", "pytest", "gsbench"} & named.keys()
    assert named["hydra-core"]["purl"] == f"pkg:pypi/hydra-core@{metadata.version('hydra-core')}"
    assert named["hydra-core"]["licenses"] == [{"license": {"name": "MIT"}}]

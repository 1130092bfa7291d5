"""The licences of what users install: listed as their metadata say, and none that would bind gsbench."""

import json
import re
from importlib import metadata

import licences
import pytest
from licences import licence_of

GPL = re.compile(r"(?<!L)GPL|(?<!Lesser )General Public License")
LINES = [line for line in licences.PAGE.read_text().splitlines() if line.startswith("|")]
ROWS = [[cell.strip() for cell in line.strip("|").split("|")] for line in LINES[2:]]  # licence, of users, of developers
LICENCES = {name: row[0] for row in ROWS for cell in row[1:] for name in cell.split(", ") if name}


def test_every_dependency_is_listed():
    """Catches a dependency whose licence nobody has looked at."""
    assert LICENCES.keys() == licences.direct().keys() | licences.along().keys()
    assert len(licences.along()) > 20


@pytest.mark.parametrize("name", sorted(LICENCES.keys() - licences.NOT_INSTALLED.keys()))
def test_the_table_says_what_the_metadata_say(name):
    """Catches a table that was written by hand, or before a dependency took another licence."""
    try:
        licence = licence_of(metadata.distribution(name))
    except metadata.PackageNotFoundError:
        pytest.skip("not installed here")
    assert licence
    assert LICENCES[name] == (f"**{licence}**" if GPL.search(licence) else licence)


def test_only_developers_install_the_gpl():
    """Catches a table that lists a package of users under developers, or the other way round."""
    users, developers = ({name for row in ROWS for name in row[column].split(", ")} for column in (1, 2))
    assert {"torch", "viser", "urllib3"} <= users - developers
    assert {"plyfile", "pytest", "sphinx"} <= developers - users


def test_no_user_installs_the_gpl():
    """Catches a licence that would bind every program that imports gsbench, and a search blind to plyfile's GPL."""
    texts = {name: licence_of(package) for name, package in licences.of_users().items()}
    assert len(texts) > 20
    assert {name: text for name, text in texts.items() if GPL.search(text)} == {}
    assert GPL.search(licence_of(metadata.distribution("plyfile")))


def test_the_sbom_lists_what_users_install(capsys):
    """Catches a bill of materials that leaves out what comes along, or has what only developers install."""
    licences.main(["--sbom"])
    listed = json.loads(capsys.readouterr().out)
    named = {package["name"]: package for package in listed["components"]}
    assert listed["metadata"]["component"]["purl"].startswith("pkg:pypi/gsbench-splatting@")
    assert {"torch", "markupsafe", "viser"} <= named.keys()
    assert not {"plyfile", "pytest", "gsbench"} & named.keys()
    assert named["hydra-core"]["purl"] == f"pkg:pypi/hydra-core@{metadata.version('hydra-core')}"
    assert named["hydra-core"]["licenses"] == [{"license": {"name": "MIT"}}]

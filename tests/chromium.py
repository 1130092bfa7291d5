"""Start Debian's Chromium for the tests of pages and of the viewer."""

import os
import shutil
from collections.abc import Iterator
from typing import Any

import pytest

CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
QUIET = ["--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking"]
QUIET += ["--disable-component-update", "--disable-sync"]


def launched(*flags: str) -> Iterator[Any]:
    """A browser with these flags too, for a fixture; skips where there is none."""
    if not CHROMIUM:
        pytest.skip("needs Debian's chromium: apt-get install chromium (or CHROMIUM=FILE)")
    api = pytest.importorskip("playwright.sync_api", reason="needs playwright, which is in the dev extra")
    with api.sync_playwright() as playwright:
        path = playwright.chromium.launch(executable_path=CHROMIUM, args=[*QUIET, *flags])
        yield path
        path.close()

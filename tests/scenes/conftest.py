"""The tiny data set, fresh for a test to break."""

from pathlib import Path

import pytest
from tiny_scene import write_tiny


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    return write_tiny(tmp_path / "tiny")

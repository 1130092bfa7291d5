"""The tiny data set, fresh for a test to break."""

from pathlib import Path

import pytest
from hypothesis import settings
from tiny_scene import write_tiny

settings.register_profile("without deadlines", deadline=None)  # on a busy machine a case of a millisecond takes 300
settings.load_profile("without deadlines")


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    return write_tiny(tmp_path / "tiny")

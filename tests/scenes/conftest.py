"""The tiny data sets, fresh for a test to break."""

from pathlib import Path

import pytest
from capture import small_capture
from hypothesis import HealthCheck, settings
from tiny_scene import write_tiny

# On a busy machine a case of a millisecond takes 300; a folder may be that of the case before, which is written over.
settings.register_profile("scenes", deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
settings.load_profile("scenes")


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    """A Blender scene of 8 x 6 pixels: two training views, one of val, one of test."""
    return write_tiny(tmp_path / "tiny")


@pytest.fixture
def taken(tmp_path: Path) -> Path:
    """A capture of nine images of 16 x 12, as text, with the principal point off the centre."""
    return small_capture(tmp_path)

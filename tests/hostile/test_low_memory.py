"""A process that may have too little memory ends in one line, and leaves a record where one fits."""

import resource
import subprocess
from pathlib import Path

import cv2
import pytest
from tiny_run import ROOT, command, environment, overrides, write_moving_square

from gsbench.errors import InputError
from gsbench.measure import record
from gsbench.process.memory import is_out_of_memory
from gsbench.scenes import images


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (MemoryError(), True),
        (OSError(12, "Cannot allocate memory"), True),
        (OSError(28, "No space left on device"), False),
        (ImportError("libtorch_cpu.so: failed to map segment from shared object"), True),
        (ImportError("No module named 'x'"), False),
        (RuntimeError("can't start new thread"), True),
        (RuntimeError("[enforce fail at alloc_cpu.cpp:119] DefaultCPUAllocator: can't allocate memory"), True),
        (RuntimeError("std::bad_alloc"), True),
        (RuntimeError("shapes do not match"), False),
        (InputError("model: expected a name"), False),
    ],
)
def test_what_says_that_there_is_no_memory(error: Exception, expected: bool) -> None:
    """Catches a library that says it in words of its own, which was a stack trace."""
    assert is_out_of_memory(error) == expected


def test_an_image_without_memory_is_not_a_damaged_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches `copy or render it again` for a file that is right."""

    def full(*_: object) -> None:
        error = cv2.error("Failed to allocate 7680000 bytes")
        error.code = cv2.Error.StsNoMem
        raise error

    monkeypatch.setattr(images, "photo_size", lambda *_: (1, 1))
    monkeypatch.setattr(cv2, "imdecode", full)
    with pytest.raises(MemoryError, match=r"r_0\.png: OpenCV has none"):
        images.decode_photo(b"png", "r_0.png")


@pytest.mark.slow
@pytest.mark.parametrize("megabytes", [300, 400, 700, 1000, 1279, 1280, 1300, 1400, 1600, 2000])
def test_too_little_memory_is_one_line(megabytes: int, tmp_path: Path) -> None:
    """Catches a stack trace or a signal, wherever the memory ends: as torch is loaded, the scene, in a step."""
    words = overrides(write_moving_square(tmp_path / "data"), tmp_path / "r", "model=7dgs")

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (megabytes << 20, megabytes << 20))

    done = subprocess.run(
        command(*words), capture_output=True, text=True, cwd=ROOT, env=environment(), preexec_fn=limit, check=False
    )
    assert done.returncode in (0, 1), done.stderr
    assert "Traceback" not in done.stderr
    for path in record.find(tmp_path / "r"):
        assert record.read(path).status in ("ok", "failed")
    assert done.returncode or megabytes >= 1280
    if done.returncode:
        errors = [line for line in done.stderr.splitlines() if line.startswith("gsbench: error:")]
        assert len(errors) == 1
        assert "out of memory" in errors[0]

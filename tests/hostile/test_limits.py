"""What a disk, the memory or a hostile file limits: one line that names the user's file, and nothing is lost."""

import errno
import io
import json
import os
import random
import resource
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import pytest
import torch
from forked import ended
from tiny_run import ROOT, command, environment, overrides

from gsbench.errors import InputError
from gsbench.measure import atomic, record
from gsbench.process import memory
from gsbench.process.memory import is_out_of_memory
from gsbench.report import study
from gsbench.scenes import images
from gsbench.train import checkpoint
from gsbench.train.checkpoint import Checkpoint

STATE = {"step": 3, "model": {f"m{i}": torch.arange(500.0) for i in range(20)}}
FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("seed", range(12))
def test_a_disk_that_is_full_while_a_checkpoint_is_written_is_named(seed, tmp_path, monkeypatch):
    """Catches the RuntimeError by which torch hides the disk's error, and an earlier checkpoint that is lost."""
    path = tmp_path / "checkpoint.pt"
    checkpoint.save(path, Checkpoint("a", "b", STATE))
    whole = path.read_bytes()
    room = random.Random(seed).randrange(len(whole))
    opened = Path.open

    def small(self: Path, mode: str = "r", **options: Any) -> Any:
        file = opened(self, mode, **options)
        return Limited(file, room) if mode == "x+b" else file

    with monkeypatch.context() as patched:
        patched.setattr(Path, "open", small)
        with pytest.raises(OSError, match="No space left on device") as caught:
            checkpoint.save(path, Checkpoint("a", "b", STATE | {"step": 4}))
    assert caught.value.filename == str(path)
    assert path.read_bytes() == whole
    assert os.listdir(tmp_path) == ["checkpoint.pt"]


@pytest.mark.parametrize("write", [atomic.write_atomically, atomic.create_atomically])
@pytest.mark.parametrize("methods", [("open", "unlink"), ("write_bytes", "open")])
def test_a_read_only_disk_is_named_by_the_user_s_file(write, methods, tmp_path, monkeypatch):
    """Catches the removal of the temporary file, which fails there too, and whose error named that file."""

    def refused(self: Path, *_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(self))

    with monkeypatch.context() as patched:
        for name in methods:
            patched.setattr(Path, name, refused)
        with pytest.raises(OSError, match="Read-only") as caught:
            write(tmp_path / "a.ply", b"x")
    assert caught.value.filename == str(tmp_path / "a.ply")


@pytest.mark.parametrize("has_links", [True, False])
def test_a_file_is_created_once(has_links, tmp_path, monkeypatch):
    """Catches two runs that claim one folder, on a disk with hard links or without, and a temporary file that stays."""

    def refused(*_: object) -> None:
        raise OSError(errno.EPERM, os.strerror(errno.EPERM))

    if not has_links:
        monkeypatch.setattr(os, "link", refused)
    assert [atomic.create_atomically(tmp_path / "a", data) for data in (b"x", b"y")] == [True, False]
    assert (tmp_path / "a").read_bytes() == b"x"
    assert os.listdir(tmp_path) == ["a"]


def test_a_device_is_not_replaced_by_a_file(tmp_path):
    """Catches --json /dev/full, which put a file in the place of the machine's device."""
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="pipe: expected the name of a file, got that of a device"):
        atomic.write_atomically(tmp_path / "pipe", b"x")
    assert (tmp_path / "pipe").is_fifo()
    assert os.listdir(tmp_path) == ["pipe"]


class Limited:
    """A file on a disk that has room for so many bytes."""

    def __init__(self, file: io.BufferedRandom, room: int) -> None:
        self._file, self._room = file, room

    def __enter__(self) -> "Limited":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def write(self, data: bytes) -> int:
        self._room -= len(data)
        if self._room < 0:
            raise FULL
        return self._file.write(data)


def test_a_checkpoint_that_asks_for_gradients_is_refused(tmp_path):
    """Catches a step count of the optimizer with requires_grad, on which Adam fails at its first step."""
    moments = {"means.0": {"step": torch.ones((), requires_grad=True)}}
    checkpoint.save(tmp_path / "c.pt", Checkpoint("a", "b", {"optimizer": moments}))
    with pytest.raises(InputError, match="expected tensors of values, got one that requires a gradient"):
        checkpoint.read(tmp_path / "c.pt")


CANDIDATE = {"name": "a", "psnr_val": 1.0, "seconds": 1.0}
CHOSEN = {"iteration": 1, "chosen": "a"}
ENDLESS: dict[str, Callable[[dict[str, Any], int], object]] = {
    "lengths": lambda plain, n: plain.update(length_choice={"kept": 1, "tried": [CANDIDATE] * n}),
    "candidates": lambda plain, n: plain.update(on_demand={"comparison": CHOSEN | {"candidates": [CANDIDATE] * n}}),
    "protocol": lambda plain, n: plain["protocol"].update({f"key{i}": i for i in range(n)}),
    "config": lambda plain, n: plain["provenance"]["config"].update(all=list(range(n))),
    "views": lambda plain, n: plain.update(per_view=[{"name": "a"}] * n),
}


@pytest.mark.parametrize("part", ENDLESS)
def test_a_record_with_endless_entries_is_refused(part, tmp_path):
    """Catches a record whose lists hold a report for a minute and take a gigabyte."""
    path = tmp_path / "record.json"
    record.write(study.read(Path(__file__).parents[2] / "results" / "published" / "effects")[0][0], path)
    plain = json.loads(path.read_text())
    record.read(path)
    ENDLESS[part](plain, 20_000)
    path.write_text(json.dumps(plain))
    with pytest.raises(InputError, match=r"at most 10,000 entries, got 20,000|(array|object) of length <= \d+"):
        record.read(path)


def test_a_limit_of_the_address_space_counts(monkeypatch):
    """Catches an export of 16384 x 16384 pixels under `ulimit -v` that ends in a stack trace."""
    monkeypatch.setattr(resource, "getrlimit", lambda _: (1280 << 20, 1))
    assert memory.too_little_address_space() is None
    monkeypatch.setattr(resource, "getrlimit", lambda _: (1 << 20, 1))
    expected = "limited to 1 MiB of address space (ulimit -v), and torch needs 1280 MiB to start: raise the limit"
    assert memory.too_little_address_space() == f"this process is {expected}"
    assert memory.available() == 0
    with pytest.raises(InputError, match=r"0\.0 GiB are available: lower"):
        memory.require(1 << 30, "frames", "lower --width")


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
def test_what_says_that_there_is_no_memory(error, expected):
    """Catches a library that says it in words of its own, which was a stack trace."""
    assert is_out_of_memory(error) == expected


def test_an_image_without_memory_is_not_a_damaged_one(monkeypatch):
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
def test_too_little_memory_is_one_line(megabytes, square, tmp_path):
    """Catches a stack trace or a signal, wherever the memory ends: as torch is loaded, the scene, in a step."""
    words = overrides(square, tmp_path / "r", "model=7dgs")

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (megabytes << 20, megabytes << 20))

    done = ended(*command(*words), cwd=ROOT, env=environment(), preexec_fn=limit)
    assert done.returncode in (0, 1), done.stderr
    assert "Traceback" not in done.stderr
    for path in record.find(tmp_path / "r"):
        assert record.read(path).status in ("ok", "failed")
    assert done.returncode or megabytes >= 1280
    if done.returncode:
        errors = [line for line in done.stderr.splitlines() if line.startswith("gsbench: error:")]
        assert len(errors) == 1
        assert "out of memory" in errors[0]

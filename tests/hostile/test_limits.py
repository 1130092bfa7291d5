"""What a disk, the memory or a hostile file limits: one line that names the user's file, and nothing is lost."""

import errno
import io
import json
import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from gsbench.errors import InputError
from gsbench.measure import atomic, record
from gsbench.process import memory
from gsbench.report import study
from gsbench.train import checkpoint
from gsbench.train.checkpoint import Checkpoint

STATE = {"step": 3, "model": {f"m{i}": torch.arange(500.0) for i in range(20)}}
FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("seed", range(12))
def test_a_disk_that_is_full_while_a_checkpoint_is_written_is_named(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
def test_a_read_only_disk_is_named_by_the_user_s_file(
    write: Callable[[Path, bytes], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches the removal of the temporary file, which fails there too, and whose error named that file."""

    def refused(self: Path, *_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(self))

    with monkeypatch.context() as patched:
        for name in ("open", "unlink"):
            patched.setattr(Path, name, refused)
        with pytest.raises(OSError, match="Read-only") as caught:
            write(tmp_path / "a.ply", b"x")
    assert caught.value.filename == str(tmp_path / "a.ply")


def test_a_device_is_not_replaced_by_a_file(tmp_path: Path) -> None:
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


def test_a_checkpoint_that_asks_for_gradients_is_refused(tmp_path: Path) -> None:
    """Catches a step count of the optimizer with requires_grad, on which Adam fails at its first step."""
    moments = {"means.0": {"step": torch.ones((), requires_grad=True)}}
    checkpoint.save(tmp_path / "c.pt", Checkpoint("a", "b", {"optimizer": moments}))
    with pytest.raises(InputError, match="expected tensors of values, got one that requires a gradient"):
        checkpoint.read(tmp_path / "c.pt")


def in_tried(plain: dict[str, Any], count: int) -> None:
    tried = [{"name": "a", "psnr_val": 1.0, "seconds": 1.0}] * count
    plain["length_choice"] = {"kept": 1, "tried": tried}


def in_compared(plain: dict[str, Any], count: int) -> None:
    candidates = [{"name": "a", "psnr_val": 1.0, "seconds": 1.0}] * count
    plain["on_demand"] = {"comparison": {"iteration": 1, "chosen": "a", "candidates": candidates}}


def in_protocol(plain: dict[str, Any], count: int) -> None:
    plain["protocol"] |= {f"key{i}": i for i in range(count)}


def in_config(plain: dict[str, Any], count: int) -> None:
    plain["provenance"]["config"]["all"] = list(range(count))


def in_views(plain: dict[str, Any], count: int) -> None:
    plain["per_view"] = [{"name": "a"}] * count


@pytest.mark.parametrize("harm", [in_tried, in_compared, in_protocol, in_config, in_views])
def test_a_record_with_endless_entries_is_refused(harm: Callable[[dict[str, Any], int], None], tmp_path: Path) -> None:
    """Catches a record whose lists hold a report for a minute and take a gigabyte."""
    path = tmp_path / "record.json"
    record.write(study.read(Path(__file__).parents[2] / "results" / "published" / "effects")[0][0], path)
    plain = json.loads(path.read_text())
    record.read(path)
    harm(plain, 20_000)
    path.write_text(json.dumps(plain))
    with pytest.raises(InputError, match=r"at most 10,000 entries, got 20,000|(array|object) of length <= \d+"):
        record.read(path)


def test_a_claim_names_no_temporary_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches an error on a read-only folder that names a file which the user has never seen."""

    def refused(self: Path, _: bytes) -> int:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(self))

    monkeypatch.setattr(Path, "write_bytes", refused)
    with pytest.raises(OSError, match="Read-only file system") as caught:
        atomic.create_atomically(tmp_path / "progress.json", b"")
    assert caught.value.filename == str(tmp_path / "progress.json")


def test_a_limit_of_the_address_space_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches an export of 16384 x 16384 pixels under `ulimit -v` that ends in a stack trace."""
    import resource

    monkeypatch.setattr(resource, "getrlimit", lambda _: (1, 1))
    assert memory.available() == 0
    with pytest.raises(InputError, match=r"0\.0 GiB are available: lower"):
        memory.require(1 << 30, "frames", "lower --width")

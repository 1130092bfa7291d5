"""Write checkpoints of a training atomically and with a SHA-256, and read them as untrusted input."""

import hashlib
import io
import stat
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsbench.errors import InputError, TooLargeError, one_line
from gsbench.measure.atomic import write_atomically
from gsbench.measure.record import CHECKPOINT

MAGIC = b"gsbench checkpoint 5\n"  # then the SHA-256 of the rest in hex and a line feed, then what torch.save writes
FILE_NAME = CHECKPOINT
DIGEST = 64  # hex digits
MOST_STEPS = 10**9  # no training has more


@dataclass(frozen=True)
class Checkpoint:
    """Hold the state of a training, and what is needed to render its model without the data set."""

    training: str  # hash of the settings that affect the training: gsbench.config_roles.training_hash
    data: str  # hash of the data set: Scene.fingerprint
    state: dict[str, Any]  # Trainer.state_dict
    config: dict[str, Any] = field(default_factory=dict)  # the whole resolved config as plain containers
    scene: dict[str, Any] = field(default_factory=dict)  # gsbench.run.load.SceneDescription as plain containers


def save(path: Path, content: Checkpoint) -> None:
    """Write a checkpoint atomically: another process that reads `path` gets the old file or the new file."""

    def write(file: io.BufferedRandom) -> None:
        file.write(MAGIC + b"0" * DIGEST + b"\n")  # room for the SHA-256 of what follows
        try:
            torch.save({f.name: getattr(content, f.name) for f in fields(content)}, file)
        except RuntimeError as error:  # torch's own, raised while the disk's error was handled
            raise (error.__context__ if isinstance(error.__context__, OSError) else error) from None
        file.seek(len(MAGIC) + DIGEST + 1)
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        file.seek(len(MAGIC))
        file.write(digest.encode())

    write_atomically(path, write)


def load(path: Path, training: str, data: str, device: str) -> dict[str, Any] | None:
    """Read the state of a training with these hashes of its settings and data; None if `path` has no such state.

    Raises:
        InputError: the file is not a checkpoint, or it is damaged.
    """
    if not path.exists():
        return None
    content = read(path, device)
    return content.state if (content.training, content.data) == (training, data) else None


def read(path: Path, device: str = "cpu") -> Checkpoint:
    """Read the checkpoint at `path`, which may come from any training.

    Raises:
        InputError: the file is missing, is not a checkpoint, or was changed after it was written.
    """
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise _fault(path, "something that is not a file")
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise _fault(path, "a file of another kind, or of another version of gsbench")
            digest = file.read(DIGEST + 1)
            payload = file.read()
        if digest != hashlib.sha256(payload).hexdigest().encode() + b"\n":
            raise _fault(path, "a damaged one: its SHA-256 is not the one written with it")
        with zipfile.ZipFile(io.BytesIO(payload)) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > len(payload):  # a few bytes could fill the memory; torch.save packs nothing
            raise _fault(path, f"one that is packed, of {size} bytes")
        plain = torch.load(io.BytesIO(payload), map_location=device, weights_only=True)
        check_plain(plain, len(payload))
        content = Checkpoint(**plain)
    except InputError:
        raise
    except (MemoryError, torch.OutOfMemoryError):
        raise TooLargeError(
            f"{path}: expected a checkpoint that fits into memory, its {len(payload)} bytes do not: "
            f"use a machine with more"
        ) from None
    except Exception as error:  # a pickle whose bytes are hostile can make its reader raise anything
        raise _fault(path, one_line(error)[:200]) from None
    for name, value in vars(content).items():
        expected = str if name in ("training", "data") else dict
        if not isinstance(value, expected):
            raise _fault(path, f"'{name}' as {type(value).__name__}")
    return content


def check_plain(value: object, most: int) -> None:
    """Check that a state from a file of `most` bytes has only dictionaries, lists, numbers, text and dense tensors.

    Raises:
        InputError: the state contains another type, or a sparse, quantized or too large tensor.
        RecursionError: a container contains itself.
    """
    if isinstance(value, Tensor):
        is_sparse = value.layout != torch.strided
        if is_sparse or value.device.type == "meta" or value.is_quantized:
            kind = "a sparse one" if is_sparse else f"one on '{value.device.type}'"
            raise InputError(f"checkpoint: expected dense tensors, got {kind}")
        if value.requires_grad:
            raise InputError("checkpoint: expected tensors of values, got one that requires a gradient")
        if value.numel() * value.element_size() > most:
            raise InputError(
                f"checkpoint: expected tensors of at most {most} bytes, as many as the file has, "
                f"got one of shape {list(value.shape)!s:.80}"
            )
    elif isinstance(value, dict):
        for key, inner in value.items():
            if not isinstance(key, str | int):
                raise InputError(f"checkpoint: expected names as keys, got {key!r:.80}")
            check_plain(inner, most)
    elif isinstance(value, list | tuple):
        for inner in value:
            check_plain(inner, most)
    elif not (value is None or isinstance(value, str | int | float)):
        raise InputError(f"checkpoint: expected containers, numbers, text and tensors, got {type(value).__name__}")


def tensor(state: object, name: str, shape: Sequence[int], dtype: torch.dtype) -> Tensor:
    """Return `state[name]` of a checkpoint as a contiguous tensor.

    Raises:
        InputError: it is none, or has another shape or dtype.
    """
    value = state.get(name) if isinstance(state, dict) else None
    if not isinstance(value, Tensor) or value.layout != torch.strided or value.device.type == "meta":
        raise InputError(f"checkpoint: expected '{name}' as a tensor, got {type(value).__name__}")
    if value.dtype != dtype or tuple(value.shape) != tuple(shape):
        raise InputError(
            f"checkpoint: expected '{name}' as {dtype} of shape {list(shape)}, "
            f"got {value.dtype} of shape {list(value.shape)}"
        )
    return value.contiguous()


def whole_number(name: str, value: object, most: int) -> int:
    """Return `value`, read from a checkpoint, if it is an int from 0 to `most`; otherwise raise InputError."""
    if type(value) is not int or not 0 <= value <= most:
        raise InputError(f"checkpoint: expected '{name}' from 0 to {most}, got {value!r:.80}")
    return value


def _fault(path: Path, got: str) -> InputError:
    return InputError(
        f"{path}: expected a checkpoint, got {got}; delete it, or start over with resume=false",
        docs="runs.md#how-a-run-ends",
    )

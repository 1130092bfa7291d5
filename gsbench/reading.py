"""Read files that may be damaged or malicious, check their JSON against dataclasses, and write results as JSON.

The size of files, lists and numbers is limited. This module does not import torch.
"""

import dataclasses
import json
import stat
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from gsbench.errors import InputError, did_you_mean, printable
from gsbench.process.memory import require

T = TypeVar("T")
MAX_JSON = 1 << 26  # bytes; the largest record and the largest transforms_train.json known have less than a million
LARGEST = 1e100  # squares stay finite, and charts can show the number
MOST_ENTRIES = 10_000  # of a list or an object, unless its type says less by msgspec.Meta(max_length=..)


def as_json(result: Any) -> str:
    """Return dicts, lists, dataclasses, texts, numbers and paths as JSON text; NaN and infinity become null."""

    def converted(value: Any) -> Any:  # what msgspec does not know, such as a path or a float of numpy
        return float(value) if isinstance(value, float) else str(value)

    # msgspec writes what json cannot, on one line; json breaks lines.
    return json.dumps(json.loads(msgspec.json.encode(result, enc_hook=converted)), indent=1)


def read_json(kind: type[T], path: Path, largest: int = MAX_JSON, most: int = MOST_ENTRIES) -> T:
    """Read the JSON file `path` of at most `largest` bytes as a dataclass, see `parse`."""
    return parse(kind, parse_json(read_file(path, str(path), largest), str(path)), str(path), most)


def read_file(
    path: Path,
    where: str,  # the path, and the file and field that name it, for the message
    most: int,  # bytes
) -> bytes:
    """Return the content of a regular file of at most `most` bytes.

    Pipes and devices are not read, because that may never end.

    Raises:
        InputError: the file is missing, is not a regular file, is too large, or cannot be read.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"{where}: expected a file, found {_kind(status.st_mode)}: put the file there")
        if status.st_size > most:
            raise InputError(f"{where}: expected at most {most} bytes, found {status.st_size}: is it the right file?")
        require(status.st_size, f"{where}: its bytes", "use a smaller file")
        with path.open("rb") as file:
            return file.read(status.st_size)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{where}: expected a file, found none: is the data complete?") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL byte in the path
        raise InputError(f"{where}: cannot be read: {getattr(error, 'strerror', error)}") from None


def parse_json(
    data: bytes,
    where: str,  # the path, for the message
) -> Any:
    """Parse JSON, and raise InputError if it is invalid or if an object has the same key twice."""
    try:
        return json.loads(data, object_pairs_hook=_unique)
    except (ValueError, RecursionError) as error:  # also bad UTF-8 and integers of thousands of digits
        raise InputError(f"{where}: expected JSON: {error}") from None


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Convert the (key, value) pairs of a JSON object to a dictionary; raise ValueError if a key occurs twice."""
    unique: dict[str, Any] = {}
    for key, value in pairs:
        if key in unique:
            raise ValueError(f"the key {ascii(key)[:80]} appears twice in one object")
        unique[key] = value
    return unique


def _kind(mode: int) -> str:
    """Return the name of a file type that is not a regular file: a folder, a pipe, a socket or a device."""
    kinds = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
    return kinds.get(stat.S_IFMT(mode), "a device")


def parse(kind: type[T], plain: object, file: str, most: int = MOST_ENTRIES) -> T:
    """Convert `plain`, the result of json.loads, to an instance of the dataclass `kind`.

    An integer is accepted in place of a float, and nothing else is converted. Lists and objects have at most `most`
    entries.

    Raises:
        InputError: `plain` does not match; the message is `<file>: <field>: expected ..., got ...`.
    """
    try:
        parsed = msgspec.convert(plain, kind)
        _check(plain, parsed, file, "", most)
    except msgspec.ValidationError as error:
        message, _, place = str(error).partition(" - at `$")
        text = f"{message[:1].lower()}{message[1:]}".replace("`", "")
        raise InputError(f"{file}: {place.strip('.`') or 'the file'}: {printable(text)[:300]}") from None
    except RecursionError:
        raise InputError(f"{file}: expected fewer objects within objects") from None
    except UnicodeEncodeError:  # msgspec compares keys and choices as UTF-8, which has no lone surrogate
        raise InputError(f"{file}: expected Unicode text, got half of a surrogate pair") from None
    return parsed


def _check(plain: Any, parsed: Any, file: str, place: str, most: int) -> None:
    """Check what types do not say: that no key is left over, and that numbers and texts can be written and shown."""
    prefix = f"{file}: {place or 'the file'}"
    if isinstance(plain, dict | list) and len(plain) > most:
        raise InputError(f"{prefix}: expected at most {most:,} entries, got {len(plain):,}")
    if isinstance(plain, dict):
        fields = {field.name for field in dataclasses.fields(parsed)} if dataclasses.is_dataclass(parsed) else None
        for key, value in plain.items():
            _check(key, key, file, place, most)  # as a text
            if fields is not None and key not in fields:
                raise InputError(f"{prefix}: unknown key {key[:80]!a}. {did_you_mean(key, fields)}")
            inner = parsed[key] if fields is None else getattr(parsed, key)
            _check(value, inner, file, f"{place}.{key}".lstrip("."), most)
    elif isinstance(plain, list):
        for i, (value, inner) in enumerate(zip(plain, parsed, strict=True)):
            _check(value, inner, file, f"{place}[{i}]", most)
    elif isinstance(plain, str) and not plain.isascii():
        try:
            plain.encode()
        except UnicodeEncodeError:  # a lone surrogate, which JSON can escape
            raise InputError(f"{prefix}: expected Unicode text, got {plain[:80]!a}") from None
    elif isinstance(plain, float) and not abs(plain) <= LARGEST:
        raise InputError(f"{prefix}: expected a finite number of at most {LARGEST:g}, got {plain}")
    elif isinstance(plain, int) and abs(plain) >= 2**63:  # tables cannot store larger integers
        raise InputError(f"{prefix}: expected an integer below 2^63, got one of {len(str(plain))} digits")

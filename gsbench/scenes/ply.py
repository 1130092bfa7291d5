"""Read the vertices of an ascii or binary PLY file into a structured numpy array; the file is checked.

A damaged file raises `InputError`, and a compressed one with the command that opens it.
"""

import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsbench.errors import InputError
from gsbench.process.memory import require
from gsbench.reading import read_file

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ENCODINGS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}  # with the byte order of numpy
MAX_FILE = 1 << 32  # bytes; 17 million Gaussians of 3DGS
_ASCII_VALUE = 100  # bytes of memory that a value needs while it is parsed
_HEADER_LIMIT = 65536  # bytes; a 3DGS header of 62 properties takes 1,600
_HEADER_END = re.compile(rb"\nend_header[ \t]*\r?\n")
_COMPRESSED = {  # by the first bytes, or by the suffix
    b"NGSP": "SPZ",
    b"\x1f\x8b": "gzip, as SPZ",
    b"PK\x03\x04": "ZIP, as SOG",
    ".spz": "SPZ",
    ".sog": "SOG",
    ".splat": "SPLAT",
    ".ksplat": "KSPLAT",
}
SUFFIXES = (".ply", *(mark for mark in _COMPRESSED if isinstance(mark, str)))  # of files of Gaussians
_PICKLE, _HEAD = b"data.pkl", 256  # name of the first file in a checkpoint of PyTorch, and where it stands


class _Element(NamedTuple):
    """An element of a PLY: the number of its rows, and their type with a field for each property."""

    rows: int
    dtype: np.dtype[np.void]

    @property
    def values(self) -> int:
        """The number of values of all rows."""
        return self.rows * len(self.dtype.names or ())

    @property
    def size(self) -> int:
        """The bytes of all rows in a binary file."""
        return self.rows * self.dtype.itemsize


def read_vertices(path: Path) -> NDArray[np.void]:
    """Return the vertices of a PLY file as a structured array [P] with a field for each property.

    The vertices and the elements before them must have scalar properties only, as in files of COLMAP and 3DGS. Other
    elements are ignored.
    """
    data = read_file(path, str(path), MAX_FILE)
    end = _HEADER_END.search(data, 0, _HEADER_LIMIT)
    if not data.startswith(b"ply"):
        _check_readable(path, data)
    if not data.startswith(b"ply") or end is None:
        raise InputError(
            f"{path}: expected a PLY: 'ply' first and 'end_header' within {_HEADER_LIMIT} bytes, the file begins with "
            f"{data[:16]!r}: export or copy it again"
        )
    lines = data[: end.start()].decode("ascii", "replace").splitlines()
    encoding, before, vertices, is_last = _read_header(lines, path)
    if encoding == "ascii":
        skipped = sum(element.values for element in before)
        return _read_ascii(data[end.end() :], skipped, vertices, path, is_last=is_last)
    start = end.end() + sum(element.size for element in before)
    available = max(len(data) - start, 0)
    if vertices.size > available:
        raise InputError(
            f"{path}: element vertex: expected {vertices.rows} x {vertices.dtype.itemsize} bytes, found "
            f"{available}: truncated, copy it again"
        )
    if is_last and data[start + vertices.size :].strip():
        raise _too_long(path, vertices)
    return np.frombuffer(data, vertices.dtype, vertices.rows, start)


def _too_long(path: Path, vertices: _Element) -> InputError:
    return InputError(
        f"{path}: element vertex: expected the file to end after the {vertices.rows} rows that its header names, it "
        f"goes on: is the number right?"
    )


def _read_header(lines: list[str], path: Path) -> tuple[str, list[_Element], _Element, bool]:
    """Return the encoding of a PLY, the elements before the vertices, the vertices, and whether they are the last."""
    words = [line.split() for line in lines[1:]]
    words = [line for line in words if line and line[0] not in ("comment", "obj_info")]
    match words:
        case [["format", encoding, _], *rest] if encoding in _ENCODINGS:
            pass
        case _:
            raise InputError(f"{path}: format: expected one of {', '.join(_ENCODINGS)}, got {words[:1]!r:.80}")
    before: list[_Element] = []
    while rest:
        match rest:
            case [["element", name, count], *rest] if re.fullmatch("[0-9]{1,18}", count):
                fields, rest = _read_properties(name, rest, _ENCODINGS[encoding], path)
            case _:
                raise InputError(
                    f"{path}: expected 'element vertex <count>', or another element first, got {rest[:1]!r:.80}"
                )
        element = _Element(int(count), np.dtype(list(fields.items())))
        if name == "vertex":
            if not element.values:
                raise InputError(f"{path}: element vertex: expected points, got {count} of {len(fields)} properties")
            return encoding, before, element, not rest
        before.append(element)
    raise InputError(f"{path}: expected an 'element vertex <count>', found none")


def _read_properties(
    element: str, lines: list[list[str]], byte_order: str, path: Path
) -> tuple[dict[str, str], list[list[str]]]:
    """Return the numpy types of an element's properties by their names, and the lines of the header behind them."""
    fields: dict[str, str] = {}
    for i, line in enumerate(lines):
        match line:
            case ["element", *_]:
                return fields, lines[i:]
            case ["property", kind, name] if kind in _TYPES and name not in fields:
                fields[name] = byte_order + _TYPES[kind]
            case _:
                raise InputError(
                    f"{path}: element {element:.80}: expected distinct scalar properties, as far as the "
                    f"vertices, got {line!r:.80}"
                )
    return fields, []


def _read_ascii(body: bytes, skipped: int, vertices: _Element, path: Path, *, is_last: bool) -> NDArray[np.void]:
    """Parse the vertices of an ascii PLY, which `skipped` values of other elements precede."""
    count, dtype = vertices
    names, expected = dtype.names or (), skipped + vertices.values
    # A value needs at least two bytes, the last but one, so a wrong count is noticed before memory is allocated.
    values = []
    if 2 * expected <= len(body) + 1:
        require(_ASCII_VALUE * expected, f"{path}: {expected} values in ascii", "write a binary PLY")
        values = body.split(maxsplit=expected)
        if is_last and len(values) > expected:
            raise _too_long(path, vertices)
        values = values[skipped:expected]
    if len(values) < vertices.values:
        raise InputError(
            f"{path}: element vertex: expected {count} x {len(names)} values, the file is truncated: copy it again"
        )
    try:
        table = np.array([float(value) for value in values]).reshape(count, len(names))
    except ValueError as error:
        raise InputError(f"{path}: element vertex: expected numbers, some values are not") from error
    rows = np.empty(count, dtype)
    for name, column in zip(names, table.T, strict=True):
        kind = dtype[name]
        if kind.kind in "iu":
            limits = np.iinfo(kind)
            if not ((column >= limits.min) & (column <= limits.max)).all():
                raise InputError(f"{path}: {name}: expected values of {limits.min}..{limits.max}, some are outside")
        with np.errstate(over="ignore"):  # becomes infinite, and is refused where the property is read
            rows[name] = column
    return rows


def _check_readable(path: Path, data: bytes) -> None:
    """Raise InputError for a checkpoint of PyTorch, and for a file whose bytes or suffix are of a compressed format."""
    if data.startswith(b"PK\x03\x04") and _PICKLE in data[:_HEAD]:
        raise refused(
            path,
            "expected a PLY of 3DGS, this file is a checkpoint of PyTorch: export a PLY with the program that wrote it",
        )
    for mark, form in _COMPRESSED.items():
        is_of_form = data.startswith(mark) if isinstance(mark, bytes) else path.suffix.lower() == mark
        if is_of_form:
            raise compressed(path, form)


def columns(vertices: NDArray[np.void], names: Sequence[str], path: Path, largest: float) -> NDArray[np.float64]:
    """Return some properties of vertices as [P, len(names)]; raise InputError if one is missing or too large."""
    for name in names:
        if name not in (vertices.dtype.names or ()):
            raise InputError(f"{path}: {name}: expected this vertex property, found {vertices.dtype.names!r:.120}")
    table = np.stack([vertices[name].astype(np.float64) for name in names], axis=1)
    bad = ~(np.abs(table) <= largest)  # NaN too
    if bad.any():
        named = ", ".join(name for name, column in zip(names, bad.T, strict=True) if column.any())
        raise InputError(
            f"{path}: {named:.80}: expected finite numbers, {int(bad.any(axis=1).sum())} of {len(bad)} "
            f"vertices have others, or larger ones than {largest:.3g}: remove them"
        )
    return table


def compressed(path: Path, form: str) -> InputError:
    """Return the error of a compressed file, with the command that opens it."""
    convert = f"npx -y @playcanvas/splat-transform@3.7.0 {shlex.quote(str(path))} trained.ply"
    return refused(path, f"expected a PLY of 3DGS, this file is compressed ({form}): {convert}")


def refused(path: Path, message: str) -> InputError:
    """Return the error of a file that is no PLY of 3DGS."""
    return InputError(f"{path}: {message}", docs="viewing.md#start-from-a-ply")

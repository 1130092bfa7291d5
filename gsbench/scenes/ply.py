"""Read the vertices of an ascii or binary PLY file into a structured numpy array; the file is checked."""

import re
from pathlib import Path

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


def read_vertices(path: Path) -> NDArray[np.void]:
    """Return the vertices of a PLY file as a structured array [P] with a field for each property.

    The vertex element must be the first element and have scalar properties only, as in files of COLMAP and 3DGS. Other
    elements are ignored.

    Raises:
        InputError: the file is not such a PLY, or has fewer values than its header states.
    """
    data = read_file(path, str(path), MAX_FILE)
    end = _HEADER_END.search(data, 0, _HEADER_LIMIT)
    if not data.startswith(b"ply") or end is None:
        raise InputError(f"{path}: expected a PLY: 'ply' first and 'end_header' within {_HEADER_LIMIT} bytes")
    lines = data[: end.start()].decode("ascii", "replace").splitlines()
    encoding, count, dtype = _read_header(lines, path)
    if encoding == "ascii":
        return _read_ascii(data[end.end() :], count, dtype, path)
    found = len(data) - end.end()
    if count * dtype.itemsize > found:
        raise InputError(f"{path}: element vertex: expected {count} x {dtype.itemsize} bytes, found {found}: truncated")
    return np.frombuffer(data, dtype, count, end.end())


def _read_header(lines: list[str], path: Path) -> tuple[str, int, np.dtype[np.void]]:
    """Return the encoding, the vertex count and the vertex type of a PLY header."""
    words = [line.split() for line in lines[1:]]
    words = [line for line in words if line and line[0] not in ("comment", "obj_info")]
    match words:
        case [["format", encoding, _], *rest] if encoding in _ENCODINGS:
            pass
        case _:
            raise InputError(f"{path}: format: expected one of {', '.join(_ENCODINGS)}, got {words[:1]!r:.80}")
    match rest:
        case [["element", "vertex", count], *rest] if re.fullmatch("[0-9]{1,18}", count):
            pass
        case _:
            raise InputError(f"{path}: expected 'element vertex <count>' first, got {rest[:1]!r:.80}")
    fields: dict[str, str] = {}
    for line in rest:
        match line:
            case ["element", *_]:
                break
            case ["property", kind, name] if kind in _TYPES and name not in fields:
                fields[name] = _ENCODINGS[encoding] + _TYPES[kind]
            case _:
                raise InputError(f"{path}: element vertex: expected distinct scalar properties, got {line!r:.80}")
    if not fields or int(count) == 0:
        raise InputError(f"{path}: element vertex: expected points, got {count} of {len(fields)} properties")
    return encoding, int(count), np.dtype(list(fields.items()))


def _read_ascii(body: bytes, count: int, dtype: np.dtype[np.void], path: Path) -> NDArray[np.void]:
    """Parse the rows of an ascii PLY; raise InputError for a number that the type of its property cannot represent."""
    names = dtype.names or ()
    expected = count * len(names)
    # A value needs at least two bytes, so a wrong count in the header is found before memory is allocated.
    values = []
    if 2 * expected <= len(body) + 1:
        require(_ASCII_VALUE * expected, f"{path}: {expected} values in ascii", "write a binary PLY")
        values = body.split(maxsplit=expected)[:expected]
    if len(values) < expected:
        raise InputError(f"{path}: element vertex: expected {count} x {len(names)} values, the file is truncated")
    try:
        table = np.array([float(value) for value in values]).reshape(count, len(names))
    except ValueError as error:
        raise InputError(f"{path}: element vertex: expected numbers, some values are not") from error
    vertices = np.empty(count, dtype)
    for name, column in zip(names, table.T, strict=True):
        kind = dtype[name]
        if kind.kind in "iu":
            limits = np.iinfo(kind)
            if not ((column >= limits.min) & (column <= limits.max)).all():
                raise InputError(f"{path}: {name}: expected values of {limits.min}..{limits.max}, some are outside")
        with np.errstate(over="ignore"):  # becomes infinite, and is refused where the property is read
            vertices[name] = column
    return vertices

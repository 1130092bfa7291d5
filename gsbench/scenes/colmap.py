"""Read the points of a COLMAP sparse model from points3D.bin or points3D.txt; the files are checked."""

import struct
from pathlib import Path

import numpy as np
import torch

from gsbench.errors import InputError
from gsbench.reading import read_file
from gsbench.scenes.scene import Points

_MAX_FILE = 1 << 32  # bytes
_POINT = struct.Struct("<Q3d3BdQ")  # id, position, colour, error, length of the track (COLMAP, "Output format")
_TRACK = 8  # bytes of an element of a track: the number of the image and that of the keypoint


def read_points(folder: Path) -> Points:
    """Read positions and colours of the points of a COLMAP model, whose folder is for example sparse/0.

    Raises:
        InputError: the folder has neither points3D.bin nor points3D.txt, or the file is damaged or has no points.
    """
    for name, parse in (("points3D.bin", _parse_binary), ("points3D.txt", _parse_text)):
        path = folder / name
        if path.exists():
            rows = parse(read_file(path, str(path), _MAX_FILE), path)
            break
    else:
        raise InputError(f"{folder}: expected points3D.bin or points3D.txt of COLMAP, found neither")
    values = np.array(rows, np.float64).reshape(-1, 6)
    if not len(values):
        raise InputError(f"{path}: expected at least one point")
    if not (np.abs(values[:, :3]) <= np.finfo(np.float32).max).all():
        raise InputError(f"{path}: expected finite positions, some are not")
    if values[:, 3:].min() < 0 or values[:, 3:].max() > 255:
        raise InputError(f"{path}: expected colours from 0 to 255, some are outside")
    tensor = torch.from_numpy(values.astype(np.float32))
    return Points(tensor[:, :3].contiguous(), tensor[:, 3:] / 255)


def _parse_binary(data: bytes, path: Path) -> list[tuple[float, ...]]:
    """Parse points3D.bin and return (x, y, z, r, g, b) of each point.

    The file has the number of points, then the points, whose lengths differ because each has a track of keypoints.
    """
    rows: list[tuple[float, ...]] = []
    count = struct.unpack_from("<Q", data)[0] if len(data) >= 8 else -1
    at = 8
    for _ in range(min(count, len(data) // _POINT.size)):
        if at + _POINT.size > len(data):
            break
        _, x, y, z, red, green, blue, _, track = _POINT.unpack_from(data, at)
        rows.append((x, y, z, red, green, blue))
        at += _POINT.size + _TRACK * track
    if len(rows) != count or at != len(data):
        raise InputError(f"{path}: expected {count} points of COLMAP, got {len(rows)} in {len(data)} bytes: truncated?")
    return rows


def _parse_text(data: bytes, path: Path) -> list[tuple[float, ...]]:
    """Parse points3D.txt and return (x, y, z, r, g, b) of each point.

    A line of the file has an id, x, y, z, r, g, b, an error and a track of keypoints.
    """
    rows = []
    for number, line in enumerate(data.decode("ascii", "replace").splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            rows.append(tuple(float(word) for word in words[1:7]))
            if len(rows[-1]) < 6:
                raise ValueError
        except ValueError:
            raise InputError(f"{path}: line {number}: expected an id, x y z and a colour, got {line[:60]!a}") from None
    return rows

"""Hostile PLY files: points or trained Gaussians that are finite, or an InputError of one line."""

import random
import struct
from pathlib import Path

import torch
from mutations import damage_bytes, replace_file
from workers import Case, Pool, generator, sample

from gsbench.scenes.gaussian_ply import read_trained
from gsbench.scenes.points import read_ply

COUNTS = ("0", "1", "2", "3", "4", "-1", "003", "1e3", "1000000000000", "9" * 18, "9" * 30, "x", "")
KINDS = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}
LINES = (
    "property list uchar int vertex_indices", "property float x", "property float nx", "property half nx", "property",
    "element face 1000000000000", "element vertex 3", "comment " + "x" * 70_000, "comment \xff\x80", "obj_info a",
    "format ascii 1.0", "end_header", "",
)  # fmt: skip
NUMBERS = ("nan", "inf", "-inf", "1e39", "1e400", "-1", "256", "0x10", "1_0", "9" * 400, "\xff", "1 1", "")
POINTS = 3


def draw(seed: int, folder: Path) -> Case:
    """Draw a point cloud, damaged in its header, its values, its bytes or as a file."""
    r = generator("ply", seed)
    encoding = r.choice(("ascii", "binary_little_endian", "binary_big_endian"))
    names = ["x", "y", "z", *r.choice((("red", "green", "blue"), ("f_dc_0", "f_dc_1", "f_dc_2")))]
    kinds = ["float"] * 3 + [r.choice(("uchar", "float", *KINDS))] * 3
    trained = names[3] == "f_dc_0" and r.random() < 0.7
    if trained:
        rest = [f"f_rest_{i}" for i in range(r.choice((0, 0, 9, 8)))]
        names += [*rest, "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
        kinds += [r.choice(("float", "float", *KINDS))] * (len(names) - 6)
    header = ["ply", f"format {encoding} 1.0", "comment made by hand", f"element vertex {POINTS}",
              *(f"property {kind} {name}" for kind, name in zip(kinds, names, strict=True)), "end_header"]  # fmt: skip
    texts = [r.choice("01") for _ in names * POINTS]
    done = [encoding, f"colours of {kinds[5]}"]
    damage = r.choice(("none", "header", "header", "header", "values", "bytes", "file"))
    if damage == "header":
        done.append(_damage_header(r, header))
    if damage == "values":
        at = r.randrange(len(texts))
        texts[at] = r.choice(NUMBERS)
        done.append(f"value {at} is {texts[at]!r:.20}")
    data = "\n".join([*header, ""]).encode("latin-1") + _body(encoding, kinds * POINTS, texts)
    if damage == "bytes":
        data, what = damage_bytes(r, data)
        done.append(what)
    path = folder / "points.ply"
    path.write_bytes(data)
    if damage == "file":
        done.append(replace_file(r, path))

    def call_trained() -> None:
        gaussians = read_trained(path)
        numbers = [value for value in vars(gaussians).values() if isinstance(value, torch.Tensor)]
        assert len(numbers) == 6
        assert all(value.isfinite().all() and len(value) == len(gaussians) for value in numbers)

    def call() -> None:
        points = read_ply(path)
        assert points.means.shape == points.colors.shape == (len(points.means), 3)
        assert points.means.isfinite().all()
        assert ((points.colors >= 0) & (points.colors <= 1)).all()

    return Case("; ".join(done), call_trained if trained else call)


def _damage_header(r: random.Random, header: list[str]) -> str:
    """Change one line of a header, in place; return what was done."""
    at = r.randrange(len(header))
    kind = r.choice(("remove", "double", "replace", "insert", "count", "kind", "ending"))
    if kind == "remove":
        return f"without '{header.pop(at)}'"
    if kind == "double":
        header.insert(at, header[at])
        return f"'{header[at]}' twice"
    if kind == "count":
        header[3] = f"element vertex {r.choice(COUNTS)}"
        return f"{header[3]:.50}"
    if kind == "kind":
        header[4] = f"property {r.choice(('int64', 'list', '', *KINDS))} x"
        return header[4]
    if kind == "ending":
        header[:] = [f"{line}\r" for line in header]
        return "lines end in CR LF"
    if kind == "insert":
        header.insert(at, "")
    header[at] = r.choice(LINES)
    return f"line {at} is '{header[at]:.40}'"


def _body(encoding: str, kinds: list[str], texts: list[str]) -> bytes:
    """Write the vertices; in binary a number that its type cannot hold becomes all ones."""
    if encoding == "ascii":
        return " ".join(texts).encode("latin-1")
    order = "<" if encoding == "binary_little_endian" else ">"
    body = b""
    for kind, text in zip(kinds, texts, strict=True):
        try:
            body += struct.pack(order + KINDS[kind], float(text) if kind in ("float", "double") else int(text))
        except (ValueError, OverflowError, struct.error):
            body += b"\xff" * struct.calcsize(KINDS[kind])
    return body


@sample(40, 300)
def test_any_ply_is_points_or_an_input_error(count: int, pool: Pool) -> None:
    """Catches an exception from numpy, an array of 10^12 points, a read that does not end, and points that are NaN."""
    pool.check(__name__, count)

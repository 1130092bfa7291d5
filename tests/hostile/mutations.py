"""Damage JSON, bytes and files at random, as cases of every kind do."""

import copy
import json
import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

NUMBERS = (
    *(0, -1, 1, 0.5, 1e-300, 1e-30, 1e30, 1e39, 1e308, -1e308),
    *(2**31, 2**63, 10**400, float("nan"), float("inf"), -float("inf")),
)
TEXTS = ("", " ", "\0", "a\nb", "../..", "/etc/passwd", "\ud800", "\u202e", "ü", "nan", "x" * 5000, "-", ".", "~")
OTHERS = (None, True, False, [], {}, [[]], {"": None}, [1, [2, [3, [4]]]], [0] * 5000)


def damage_file(r: random.Random, path: Path) -> str:
    """Damage a file, a JSON in its values and keys too, or put something else in its place; return what was done."""
    kind = r.choice(("values", "a key twice", "bytes", "file") if path.suffix == ".json" else ("bytes", "file"))
    if kind == "file":
        return replace_file(r, path)
    data = path.read_bytes()
    if kind == "values":
        content = json.loads(data)
        what = damage_json(r, content)
        data = json.dumps(content).encode()
    else:
        data, what = damage_bytes(r, data) if kind == "bytes" else double_a_key(r, data)
    path.write_bytes(data)
    return f"{path.name}: {what}"


def hostile_value(r: random.Random) -> Any:
    """Choose a JSON value that is none of those expected, or hardly."""
    return copy.deepcopy(r.choice(r.choice((NUMBERS, TEXTS, OTHERS))))


def damage_json(r: random.Random, content: Any) -> str:
    """Change one value, key or list somewhere in `content`, in place; return what was done."""
    parent, key, name = _place(r, content)
    kind = r.choice(("replace", "replace", "replace", "remove", "double", "rename"))
    if kind == "remove":
        del parent[key]
        return f"{name} removed"
    if kind == "double" and isinstance(parent, list):
        parent.insert(key, copy.deepcopy(parent[key]))
        return f"{name} twice"
    if kind == "rename" and isinstance(parent, dict):
        parent[r.choice(TEXTS)] = parent.pop(key)
        return f"{name} renamed"
    parent[key] = value = hostile_value(r)
    return f"{name} = {value!r:.60}"


def _place(r: random.Random, content: Any) -> tuple[Any, Any, str]:
    """Choose a value below `content`, as often near the root as far from it: what holds it, its key, its name."""
    parent, key, name, inside = content, None, "", content
    while isinstance(inside, dict | list) and inside and (key is None or r.random() < 0.7):
        parent, key = inside, r.choice(list(inside) if isinstance(inside, dict) else range(len(inside)))
        inside, name = parent[key], f"{name}[{key!r}]"
    return parent, key, name


def double_a_key(r: random.Random, text: bytes) -> tuple[bytes, str]:
    """Write the first key of a JSON object a second time, with another value."""
    at = text.index(b"{") + 1
    key = text[at : text.index(b":", at)].strip()
    value = json.dumps(r.choice((None, 1, []))).encode()
    return text[:at] + key + b": " + value + b", " + text[at:], "a key twice"


def damage_bytes(r: random.Random, data: bytes) -> tuple[bytes, str]:
    """Change some bytes, cut, repeat, insert or replace; return what was done, too."""
    at = r.randrange(len(data) + 1)
    deep = r.choice((b"[", b'{"a":', b"[{"))
    changes: list[tuple[str, Callable[[], bytes]]] = [
        ("cut", lambda: data[:at]),
        ("nothing left", lambda: b""),
        ("a byte changed", lambda: data[:at] + bytes([r.randrange(256)]) + data[at + 1 :]),
        ("bytes removed", lambda: data[:at] + data[at + r.randrange(1, 40) :]),
        ("bytes inserted", lambda: data[:at] + r.randbytes(r.randrange(1, 40)) + data[at:]),
        ("a part twice", lambda: data[:at] + data[max(0, at - 30) :]),
        ("not UTF-8", lambda: data[:at] + b"\xff\xfe\x80" + data[at:]),
        ("UTF-16", lambda: data.decode("latin-1").encode("utf-16")),
        ("a byte order mark", lambda: b"\xef\xbb\xbf" + data),
        ("NUL", lambda: data[:at] + b"\0" + data[at:]),
        ("deep nesting", lambda: data[:at] + deep * r.choice((500, 100_000)) + data[at:]),
        ("a long integer", lambda: data[:at] + b"9" * 5000 + data[at:]),
        ("something after it", lambda: data + data),
        ("noise", lambda: r.randbytes(200)),
    ]
    what, change = r.choice(changes)
    return change(), f"{what} at {at}"


def replace_file(r: random.Random, path: Path) -> str:
    """Put something in the place of a file that is no file to be read; return what it is."""
    if path.exists():
        path.unlink()
    outside = path.parent / "elsewhere"
    changes: dict[str, Callable[[], object]] = {
        "nothing": lambda: None,
        "a folder": path.mkdir,
        "a pipe": lambda: os.mkfifo(path),
        "a link to /dev/zero": lambda: path.symlink_to("/dev/zero"),
        "a link to /dev/stdin": lambda: path.symlink_to("/dev/stdin"),
        "a link to itself": lambda: path.symlink_to(path),
        "a link to nothing": lambda: path.symlink_to(outside),
        "a link to /proc": lambda: path.symlink_to("/proc/self/mem"),
        "10 GB of zeros": lambda: _sparse(path, 10 * 10**9),
        "100 MB of zeros": lambda: _sparse(path, 10**8),
        "an empty file": path.touch,
    }
    what = r.choice(list(changes))
    changes[what]()
    return f"{path.name} is {what}"


def _sparse(path: Path, size: int) -> None:
    """Write a file of zeros that takes no room on the disk."""
    with path.open("wb") as file:
        file.truncate(size)

"""Find the files of a data set inside the scene's folder, and compute a hash of all of them."""

import hashlib
import math
import os
import re
import unicodedata
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import fields
from pathlib import Path
from typing import TypeVar

from gsbench.errors import InputError
from gsbench.reading import MAX_JSON, parse, parse_json, read_file

T = TypeVar("T")

_SUFFIXES = (".png", ".jpg", ".jpeg")  # of images, in any case; the first is preferred
_MOST_KEYS = 8  # named in a sentence
_DRIVE = re.compile(r"[A-Za-z]:[\\/]|\\\\")  # with which absolute paths begin on Windows


def find_inside(
    root: Path,  # the scene's folder, resolved
    name: str,  # a path relative to `root`, as the data set writes it
    where: str,
) -> Path:
    """Return the path of a file; raise InputError if `name` leaves the scene's folder `root`.

    `name` can leave the folder through ".." or as an absolute path. Links inside of the folder are followed, because
    only its user can have made them; "a/.." is "." even if a is a link.
    """
    if not name.isprintable():  # a NUL byte, a lone surrogate, a line break that would break the message
        raise InputError(f"{where}: expected a path inside {root}, got {name!r}, which is not printable: rename it")
    path = Path(os.path.normpath(root / name))
    if _DRIVE.match(name) or (os.path.isabs(name) and not path.is_relative_to(root)):
        raise InputError(
            f"{where}: expected a path inside {root}, got {name!r}, which is absolute: write it relative to that folder"
        )
    if not path.is_relative_to(root):
        raise InputError(
            f"{where}: expected a path inside {root}, got {name!r}, which leaves it: move the file into the folder, or "
            "make a link to it there"
        )
    return path


def read_keys(kind: type[T], source: Path) -> tuple[T, str, set[str]]:
    """Return a dataclass `kind` with the keys of a JSON file, the file's SHA-256, and its keys that `kind` lacks."""
    data = read_file(source, str(source), MAX_JSON)
    content = parse_json(data, str(source))
    known = [field.name for field in fields(kind)]  # type: ignore[arg-type]  # of a dataclass
    if not isinstance(content, dict):
        raise InputError(f"{source}: expected a JSON object with {', '.join(known)}, got a {type(content).__name__}")
    kept = parse(kind, {key: content[key] for key in known if key in content}, str(source))
    return kept, digest(data), {*content} - {*known}


def unread(source: str, keys: Collection[str]) -> list[str]:
    """Return a sentence on keys of a file that are not read, if there are any."""
    shown = ", ".join(f"{key[:40]!a}" for key in sorted(keys)[:_MOST_KEYS]) + (", .." if len(keys) > _MOST_KEYS else "")
    return [f"{source}: keys that are not read: {shown}"] if keys else []


def without_suffix(name: str) -> str:
    """Return the name of an image without the suffix of a PNG or JPEG, if it has one; other suffixes stay."""
    stem, suffix = os.path.splitext(name)
    return stem if suffix.lower() in _SUFFIXES else name


class ImageFinder:
    """Finds the images of a scene by the names that a file of the data set gives to them."""

    def __init__(self, root: Path) -> None:
        """Store the scene's folder, which is resolved; no folder is read yet."""
        self._root = root
        self._listed: dict[Path, dict[str, list[str]]] = {}  # folder -> name without suffix -> names of images
        self._replaced: Counter[str] = Counter()  # ".jpg for .png" -> images

    def find(
        self,
        name: str,  # a path relative to the scene's folder, with or without suffix, with / or Windows' backslashes
        where: str,
    ) -> Path:
        """Return the path of the image: `name` itself if it is a file, otherwise one with another suffix (.jpg, .PNG).

        Without either, the path of the PNG or of what `name` says is returned, so that the error of reading names it.
        """
        path = find_inside(self._root, name, where)
        if not os.path.isfile(path) and "\\" in name:
            path = find_inside(self._root, name.replace("\\", "/"), where)
        if os.path.isfile(path):
            return path
        if not path.parent.is_dir():  # its name may have umlauts, too
            spelt = (find_inside(self._root, unicodedata.normalize(form, name), where) for form in ("NFC", "NFD"))
            path = next((other for other in spelt if other.parent.is_dir()), path)
        stem = without_suffix(path.name)
        suffix = path.name[len(stem) :]
        names = self._images(path.parent).get(unicodedata.normalize("NFC", stem))
        if not names:
            return path if suffix else path.with_name(f"{path.name}{_SUFFIXES[0]}")
        # The suffix in another case comes before other suffixes.
        best = min(names, key=lambda other: (other.lower() != path.name.lower(), _order(other), other))
        read = os.path.splitext(best)[1]
        if read != suffix and (suffix or len(names) > 1):
            self._replaced[f"{read} for {suffix or 'a name of several files'}"] += 1
        return path.with_name(best)

    def notes(self) -> list[str]:
        """Return a sentence on images whose suffix the data set does not say, or says otherwise, if there are any."""
        if not self._replaced:
            return []
        return [f"images of another suffix are read: {', '.join(f'{n} {of}' for of, n in self._replaced.items())}"]

    def _images(self, folder: Path) -> dict[str, list[str]]:
        """Return the names of the images in a folder by their names without suffix; the folder is listed once.

        macOS writes an umlaut as two characters (NFD), other systems as one (NFC), which is the key here.
        """
        if folder not in self._listed:
            by_stem = self._listed.setdefault(folder, {})
            try:
                names = sorted(os.listdir(folder))
            except (OSError, ValueError):  # the error of reading the image names the path
                names = []
            for name in names:
                if (stem := without_suffix(name)) != name:
                    by_stem.setdefault(unicodedata.normalize("NFC", stem), []).append(name)
        return self._listed[folder]


def _order(name: str) -> int:
    """Return the place of an image's suffix in the order of preference."""
    return _SUFFIXES.index(os.path.splitext(name)[1].lower())


def number(text: str, largest: float, message: str) -> float:  # with at most `largest` as absolute value
    """Convert a text to a number; raise InputError with a message and the text if it is none or too large."""
    try:
        value = float(text) if "_" not in text else math.nan  # Python reads 1_0 as 10
    except ValueError:
        value = math.nan
    if not abs(value) <= largest:
        raise InputError(f"{message}, got {text[:40]!a}")
    return value


def digest(data: bytes) -> str:
    """Return the SHA-256 of `data` in hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()


def fingerprint(digests: Mapping[str, str]) -> str:  # file name relative to the scene's folder -> its sha256
    """Return one SHA-256 for a set of files: the hash of the output of `sha256sum` for the files, sorted by name.

    Names are relative to the scene's folder, so moving the folder keeps the hash. To compute the hash of a Blender
    scene, run in its folder: ``LC_ALL=C; sha256sum $(printf '%s\\n' transforms_*.json */*.png | sort) | sha256sum``.
    """
    lines = "".join(f"{digests[name]}  {name}\n" for name in sorted(digests))
    return digest(lines.encode("utf-8", "surrogateescape"))

"""Unpack a downloaded zip archive, and refuse members that would be written outside of its folder."""

import lzma
import secrets
import shutil
import stat
import struct
import zipfile
import zlib
from pathlib import Path, PurePosixPath

from gsbench.errors import InputError, one_line

MOST_FILES = 1_000_000
# Exceptions of zipfile for damaged or encrypted archives; RecursionError (folders 1000 deep) is a RuntimeError.
DAMAGED = (
    zipfile.BadZipFile,
    EOFError,
    NotImplementedError,
    RuntimeError,
    zlib.error,
    lzma.LZMAError,
    struct.error,
    ValueError,
    IndexError,
)


def unpack(archive: Path, folder: Path) -> None:
    """Unpack a zip archive into a new folder, which appears only after everything is unpacked.

    Raises:
        InputError: the file is not a zip archive or is damaged, a member leads out of the folder, it has more than
            MOST_FILES files, or the disk has too little space.
    """
    part = folder.with_name(f".{folder.name}.{secrets.token_hex(4)}.part")
    try:
        with zipfile.ZipFile(archive) as opened:
            members = opened.infolist()
            for member in members:
                check(member, archive)
            size, free = sum(member.file_size for member in members), shutil.disk_usage(folder.parent).free
            if size > free or len(members) > MOST_FILES:
                raise InputError(
                    f"{archive}: expected at most {MOST_FILES} files and {free} bytes, which are free in "
                    f"{folder.parent}, got {len(members)} and {size}"
                )
            opened.extractall(part)
        part.replace(folder)
    except InputError:
        raise
    except DAMAGED as error:
        raise InputError(f"{archive}: expected a zip, which can be unpacked: {one_line(error)}") from None
    finally:
        shutil.rmtree(part, ignore_errors=True)


def check(member: zipfile.ZipInfo, archive: Path) -> None:
    """Raise InputError if a zip member has no name, leads out of the folder, or is a link or a device."""
    name = member.filename
    path = PurePosixPath(name.replace("\\", "/"))
    if path.is_absolute() or ".." in path.parts or ":" in name or not name.isprintable():
        raise InputError(f"{archive}: refused, as it would write outside of its folder: {name!a:.200}")
    if not path.parts and not name.endswith("/"):  # "./" is the folder itself
        raise InputError(f"{archive}: refused, as a file in it has no name: {name!a:.200}")
    kind = stat.S_IFMT(member.external_attr >> 16)
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        raise InputError(f"{archive}: refused, as it holds a link or a device: {name!a:.200}")


def scenes_in(folder: Path) -> dict[Path, list[str]]:
    """Return the folders below `folder` that contain scenes, with the names of these scenes."""
    folders: dict[Path, list[str]] = {}
    for marker in sorted(folder.rglob("transforms_train.json")):
        folders.setdefault(marker.parent.parent, []).append(marker.parent.name)
    return folders

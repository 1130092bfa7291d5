"""Tell the PLY of 3DGS from compressed files and from PLYs of other methods, and say what opens those."""

import re
import shlex
from collections.abc import Sequence
from pathlib import Path

from gsbench.errors import InputError

FILTER = "filter_3D"  # Mip-Splatting: standard deviation of the 3D smoothing filter, world units
_METHODS = {  # columns without which the Gaussians of a method look different
    "Spacetime Gaussians (STG)": r"trbf_\w+|motion_\d+|omega_\d+|f_t_\d+",
    "Beta Splatting": r"betas?(_\d+)?|sb_params_\d+",
    "4DGS": r"t|scale_t|rot_r_\d+",
    "Scaffold-GS": r"f_offset_?\d+|f_anchor_feat_?\d+",
}
_PACKED = re.compile(r"packed_\w+")  # SuperSplat
_COMPRESSED = {  # by the first bytes, or by the suffix
    b"NGSP": "SPZ", b"\x1f\x8b": "gzip, as SPZ", b"PK\x03\x04": "ZIP, as SOG",
    ".spz": "SPZ", ".sog": "SOG", ".splat": "SPLAT", ".ksplat": "KSPLAT",
}  # fmt: skip
_PICKLE, _HEAD = b"data.pkl", 256  # name of the first file in a checkpoint of PyTorch, and where it stands
_HARMLESS = re.compile(  # normals, colours beside f_dc_*, identities, features of segmentations
    r"n[xyz]|red|green|blue|alpha|confidence|(\w+_)?(ids?|idx|index|labels?|class|segment|cluster|instance|object)(_\d+)?|"
    r"(obj|object|ins|instance|sem|semantics?|language|clip|dino|identity)_\w+|semantics?"
)


def check_readable(path: Path, data: bytes) -> None:
    """Raise InputError if the bytes of a file that is no PLY, or its suffix, are of a compressed format."""
    if data.startswith(b"PK\x03\x04") and _PICKLE in data[:_HEAD]:
        raise _refused(path, "expected a PLY of 3DGS, this file is a checkpoint of PyTorch: export a PLY with the "
                             "program that wrote it")  # fmt: skip
    for mark, form in _COMPRESSED.items():
        if data.startswith(mark) if isinstance(mark, bytes) else path.suffix.lower() == mark:
            raise _compressed(path, form)


def check_columns(names: Sequence[str], needed: Sequence[str], path: Path) -> list[str]:
    """Return the columns of a file that change no image and that gsbench leaves out.

    Args:
        names: the columns of the file.
        needed: the columns of 3DGS without `f_rest_*`.
        path: the file, for messages.

    Raises:
        InputError: a needed column is missing, or a column is of another method or is not known, so that the Gaussians
            might look different without it.
    """
    if any(map(_PACKED.fullmatch, names)):
        raise _compressed(path, "SuperSplat's columns packed_*")
    for method, pattern in _METHODS.items():
        if columns := [name for name in names if re.fullmatch(pattern, name)]:
            raise _refused(path, f"expected Gaussians of 3DGS, the columns {shortened(columns):.200} are of {method} "
                                 f"and change the look: give a PLY of 3D Gaussians, for instance those of one time, "
                                 f"or remove the columns")  # fmt: skip
    missing = [name for name in needed if name not in names]
    if missing == ["scale_2"]:
        raise _refused(path, "expected scale_0..2, found two scales, of surfels (2DGS): add a column scale_2 of -16, "
                             "which makes them flat Gaussians")  # fmt: skip
    if missing:
        raise _refused(path, f"expected trained Gaussians, x y z f_dc_0..2 opacity scale_0..2 rot_0..3 and f_rest_*, "
                             f"found no '{missing[0]}': is it a cloud of points?")  # fmt: skip
    others = [name for name in names if name not in (*needed, FILTER) and not name.startswith("f_rest_")]
    if unknown := [name for name in others if not _HARMLESS.fullmatch(name)]:
        raise _refused(path, f"expected the columns of 3DGS, found {shortened(unknown):.200} too, which gsbench does "
                             f"not know: remove them if they do not change the look")  # fmt: skip
    return others


def shortened(names: Sequence[str]) -> str:
    """List names; those that differ by a number alone become one, such as ``motion_0..8``."""
    groups: dict[str, list[str]] = {}
    for name in names:
        stem = name.rstrip("0123456789")
        groups.setdefault(stem, []).append(name.removeprefix(stem))
    return ", ".join(stem + (f"{ends[0]}..{ends[-1]}" if len(ends) > 1 else ends[0]) for stem, ends in groups.items())


def _compressed(path: Path, form: str) -> InputError:
    convert = f"npx -y @playcanvas/splat-transform@3.7.0 {shlex.quote(str(path))} trained.ply"
    return _refused(path, f"expected a PLY of 3DGS, this file is compressed ({form}): {convert}")


def _refused(path: Path, message: str) -> InputError:
    return InputError(f"{path}: {message}", docs="viewing.md#start-from-a-ply")

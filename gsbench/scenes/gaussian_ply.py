"""Read and write trained 3D Gaussians in the PLY format of 3DGS, which other trainers and viewers use too.

Columns: `x y z [nx ny nz] f_dc_0..2 f_rest_* opacity scale_0..2 rot_0..3`. Scales are logarithms, the opacity is a
logit, and the rotation is a quaternion wxyz. The columns `f_rest_*` are the SH coefficients above degree 0, first all
of the red channel, then green, then blue. A file that would look different without a part raises `InputError`.
"""

import math
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.headers import ALPHA_MAX, ALPHA_MIN
from gsbench.process.memory import require
from gsbench.scenes.ply import columns, compressed, read_vertices, refused
from gsbench.scenes.scene import Camera

MAX_DEGREE = 3  # largest SH degree of gsbench's models; a file may have degree 4
_FILE_DEGREES = {3 * ((degree + 1) ** 2 - 1): degree for degree in range(MAX_DEGREE + 2)}  # by the number of f_rest_*
_COLUMNS = {
    "means": ("x", "y", "z"),
    "dc": ("f_dc_0", "f_dc_1", "f_dc_2"),
    "logits": ("opacity",),
    "log_scales": ("scale_0", "scale_1", "scale_2"),
    "quats": ("rot_0", "rot_1", "rot_2", "rot_3"),
}
_LARGEST = 1e30  # largest accepted number; its square in double and its sums in single precision are finite
_LARGEST_LOG_SCALE = 40.0  # 1e17 world units, whose square is finite in single precision
_LARGEST_LOGIT = math.log(ALPHA_MAX / (1 - ALPHA_MAX))
_VALUE = 40  # bytes that a number of a Gaussian needs while it is read: in the file, in double and in single precision
FILTER = "filter_3D"  # Mip-Splatting: standard deviation of the 3D smoothing filter, world units
_METHODS = {  # columns without which the Gaussians of a method look different
    "Spacetime Gaussians (STG)": r"trbf_\w+|motion_\d+|omega_\d+|f_t_\d+",
    "Beta Splatting": r"betas?(_\d+)?|sb_params_\d+",
    "4DGS": r"t|scale_t|rot_r_\d+",
    "Scaffold-GS": r"f_offset_?\d+|f_anchor_feat_?\d+",
}
_PACKED = re.compile(r"packed_\w+")  # SuperSplat
_HARMLESS = re.compile(  # normals, colours beside f_dc_*, identities, features of segmentations
    r"n[xyz]|red|green|blue|alpha|confidence|(\w+_)?(ids?|idx|index|labels?|class|segment|cluster|instance|object)(_\d+)?|"
    r"(obj|object|ins|instance|sem|semantics?|language|clip|dino|identity)_\w+|semantics?"
)


@dataclass(frozen=True)
class TrainedGaussians:
    """Hold N trained 3D Gaussians as raw parameters (log scales, logits of opacities), float32 on the CPU."""

    means: Tensor  # [N, 3] world units
    log_scales: Tensor  # [N, 3] ln of standard deviations in world units
    quats: Tensor  # [N, 4] wxyz, not zero, not necessarily normalised
    logits: Tensor  # [N] logits of opacities
    dc: Tensor  # [N, 3] SH coefficients of degree 0: colour = 0.5 + Y_00 dc
    rest: Tensor  # [N, K - 1, 3] SH coefficients above degree 0, in the order of 3DGS
    from_profiles: bool = False  # whether they stand for Beta profiles that look like them; a PLY does not say it

    def __len__(self) -> int:
        return len(self.means)


def read_trained(path: Path) -> TrainedGaussians:
    """Read trained 3D Gaussians from an ascii or binary PLY file of 3DGS with SH degree 0 to 4.

    An opacity of exactly 0 or 1, which converters of compressed files write as an infinite logit, becomes 0.001 or
    0.999, the largest alpha that is blended. The 3D filter of Mip-Splatting becomes a part of scales and opacities.
    Lines on stderr say both, and name what is not read: columns, and a deformation network beside the file.
    """
    vertices = read_vertices(path)
    names = vertices.dtype.names or ()
    left_out = _check_columns(names, path)
    if left_out:
        print(f"{path}: columns that change no image are left out: {_shortened(left_out)}", file=sys.stderr)
    if networks := _deformations(path):
        print(f"{path}: {networks[0]} is not read: the Gaussians are those before it moves them", file=sys.stderr)
    count = sum(name.startswith("f_rest_") for name in names)
    if count not in _FILE_DEGREES:
        expected = ", ".join(map(str, _FILE_DEGREES))
        raise InputError(f"{path}: f_rest_*: expected {expected} columns, for degree 0 to 4, found {count}")
    rest = tuple(f"f_rest_{i}" for i in range(count))
    if missing := [name for name in rest if name not in names]:
        raise InputError(f"{path}: f_rest_*: expected the numbers 0 to {count - 1}, found no '{missing[0]}'")
    needed = _VALUE * len(vertices) * (sum(map(len, _COLUMNS.values())) + count)
    require(needed, f"{path}: {len(vertices)} Gaussians", "use a smaller file")
    vertices = _with_finite_logits(vertices, path)
    read = {name: _table(vertices, group, path) for name, group in _COLUMNS.items()}
    zeros = int((read["quats"].square().sum(1) == 0).sum())
    if zeros:
        raise InputError(f"{path}: rot_0..3: expected quaternions, {zeros} of {len(vertices)} are zero: remove them")
    by_channel = _table(vertices, rest, path) if rest else torch.zeros(len(vertices), 0)
    read["logits"] = read["logits"][:, 0]
    doubts = []
    if 0 <= read["logits"].min() < read["logits"].max() <= 1:
        doubts += ["all values of opacity lie in [0, 1]: are they opacities?"]
    if read["log_scales"].min() > 0:
        doubts += ["all values of scale_0..2 are positive: are they sizes?"]
    if doubts:
        print(
            f"{path}: {' '.join(doubts)} A PLY of 3DGS has logits of opacities, and logarithms of scales",
            file=sys.stderr,
        )
    if FILTER in names:
        _fuse(read, _table(vertices, (FILTER,), path), path)
    higher = by_channel.view(len(vertices), 3, count // 3).mT.contiguous()  # [N, K - 1, 3]
    return TrainedGaussians(read["means"], read["log_scales"], read["quats"], read["logits"], read["dc"], higher)


def ply_of(trained: TrainedGaussians) -> bytes:
    """Return trained 3D Gaussians as the bytes of a binary PLY file of 3DGS with SH degree 3."""
    N, K = len(trained), (MAX_DEGREE + 1) ** 2
    if trained.rest.shape[1] > K - 1:
        raise InputError(f"PLY: expected harmonics up to degree {MAX_DEGREE}, got {trained.rest.shape[1]} above 0")
    for name in (*_COLUMNS, "rest"):
        if not getattr(trained, name).isfinite().all():
            raise InputError(f"PLY: expected finite {name}, some are not: has the training diverged?")
    rest = torch.zeros(N, K - 1, 3)
    rest[:, : trained.rest.shape[1]] = trained.rest
    columns = [
        trained.means,
        torch.zeros(N, 3),  # normals
        trained.dc,
        rest.mT.flatten(1),  # by channel
        trained.logits[:, None],
        trained.log_scales,
        trained.quats,
    ]
    names = [
        *_COLUMNS["means"],
        "nx",
        "ny",
        "nz",
        *_COLUMNS["dc"],
        *(f"f_rest_{i}" for i in range(3 * (K - 1))),
        *_COLUMNS["logits"],
        *_COLUMNS["log_scales"],
        *_COLUMNS["quats"],
    ]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {N}",
        *(f"property float {name}" for name in names),
        "end_header\n",
    ]
    return "\n".join(header).encode() + torch.cat(columns, 1).numpy().astype("<f4").tobytes()


def share_seen(
    trained: TrainedGaussians,
    cameras: Sequence[Camera],
    enough: float,  # share at which the search ends
) -> float:
    """Return the share of Gaussians that at least one camera sees; at least `enough`, once it is reached.

    A camera sees a Gaussian of opacity 1/255 or more if a ball of three of its largest standard deviations reaches into
    the camera's pyramid of view, is at least one pixel wide, and has its mean beyond the near plane. What stands in
    front of it does not count.
    """
    unseen = (torch.sigmoid(trained.logits) >= ALPHA_MIN).nonzero()[:, 0]  # indices of those that could be seen
    transparent, N = len(trained) - len(unseen), len(trained)
    means, radii = trained.means.double(), 3 * trained.log_scales.double().amax(1).exp()
    for camera in cameras:
        if 1 - (transparent + len(unseen)) / N >= enough:
            break
        K, viewmat = camera.K.double(), camera.viewmat.double()
        # For a pixel (u, v) of depth z, K (x, y, z) = (u z, v z, z): inside are 0 <= u <= width and 0 <= v <= height.
        sides = torch.stack([K[0], camera.width * K[2] - K[0], K[1], camera.height * K[2] - K[1]])
        sides = sides / sides.norm(dim=1, keepdim=True)  # [4, 3] unit normals into the pyramid
        centers, radius = means[unseen] @ viewmat[:3, :3].T + viewmat[:3, 3], radii[unseen]
        outside = (centers @ sides.T < -radius[:, None]).any(1) | (centers[:, 2] <= camera.near)
        unseen = unseen[outside | (2 * radius * K[0, 0] < centers[:, 2])]  # or narrower than a pixel
    return 1 - (transparent + len(unseen)) / N


def _deformations(path: Path) -> list[Path]:
    """Return the files of a deformation network of a trained PLY, where 4DGaussians and Deformable 3DGS write them."""
    root = path.absolute().parents[min(2, len(path.absolute().parents) - 1)]  # ROOT/point_cloud/iteration_N/FILE.ply
    return [*sorted(path.parent.glob("deformation*.pth")), *sorted(root.glob("deform/iteration_*/deform.pth"))]


def _with_finite_logits(vertices: NDArray[np.void], path: Path) -> NDArray[np.void]:
    """Return vertices with logits of the opacities 0.001 and 0.999 in place of infinite ones; say how many."""
    infinite = np.isinf(vertices["opacity"])
    if infinite.any():
        vertices = vertices.copy()  # of a file, which is read only
        vertices["opacity"][infinite] = np.copysign(_LARGEST_LOGIT, vertices["opacity"][infinite])
        print(
            f"{path}: {int(infinite.sum())} of {len(vertices)} opacities are exactly 0 or 1, taken for "
            f"{1 - ALPHA_MAX:.3f} or {ALPHA_MAX:.3f}",
            file=sys.stderr,
        )
    return vertices


def _fuse(
    read: dict[str, Tensor],  # log_scales [N, 3] and logits [N], which are overwritten
    filters: Tensor,  # [N, 1] standard deviations, world units
    path: Path,
) -> None:
    """Make the 3D filter of Mip-Splatting a part of scales and opacities, as its export for viewers does; say so.

    With the squared scales S and the squared filter f^2: S' = S + f^2, and opacity' = opacity sqrt(det S / det S').
    """
    if not (filters >= 0).all():
        raise InputError(f"{path}: {FILTER}: expected sizes of at least 0, some are negative: export the file anew")
    scales, logits = read["log_scales"].double(), read["logits"].double()
    wider = torch.logaddexp(2 * scales, 2 * filters.double().log()) / 2
    lower = (scales - wider).sum(1)  # ln r, where r = sqrt(det S / det S') <= 1
    # logit(r opacity) = logit + ln r - ln(1 + (1 - r) exp(logit))
    correction = torch.logaddexp(torch.zeros_like(logits), logits + (-torch.expm1(lower)).log())
    read["log_scales"], read["logits"] = wider.float(), (logits + lower - correction).float()
    print(
        f"{path}: {FILTER} of Mip-Splatting is now a part of scales and opacities; its filter of images is "
        f"raster.antialias=true",
        file=sys.stderr,
    )


def _table(vertices: NDArray[np.void], names: tuple[str, ...], path: Path) -> Tensor:  # [N, len(names)] float32
    if integers := [name for name in names if vertices.dtype[name].kind in "iu"]:
        raise refused(
            path,
            f"{_shortened(integers)}: expected float or double, got {vertices.dtype[integers[0]].name}, as of "
            f"quantised Gaussians: export a PLY of 3DGS by the program that wrote them",
        )
    largest = _LARGEST_LOG_SCALE if names == _COLUMNS["log_scales"] else _LARGEST
    return torch.from_numpy(columns(vertices, names, path, largest).astype(np.float32))


def _check_columns(names: Sequence[str], path: Path) -> list[str]:
    """Check that a file has the columns of 3DGS; return those that change no image and that gsbench leaves out."""
    needed = [name for group in _COLUMNS.values() for name in group]
    if any(map(_PACKED.fullmatch, names)):
        raise compressed(path, "SuperSplat's columns packed_*")
    for method, pattern in _METHODS.items():
        if others := [name for name in names if re.fullmatch(pattern, name)]:
            raise refused(
                path,
                f"expected Gaussians of 3DGS, the columns {_shortened(others):.200} are of {method} "
                f"and change the look: give a PLY of 3D Gaussians, for instance those of one time, "
                f"or remove the columns",
            )
    missing = [name for name in needed if name not in names]
    if missing == ["scale_2"]:
        raise refused(
            path,
            "expected scale_0..2, found two scales, of surfels (2DGS): add a column scale_2 of -16, "
            "which makes them flat Gaussians",
        )
    if missing:
        raise refused(
            path,
            f"expected trained Gaussians, x y z f_dc_0..2 opacity scale_0..2 rot_0..3 and f_rest_*, "
            f"found no '{missing[0]}': is it a cloud of points?",
        )
    others = [name for name in names if name not in (*needed, FILTER) and not name.startswith("f_rest_")]
    if unknown := [name for name in others if not _HARMLESS.fullmatch(name)]:
        raise refused(
            path,
            f"expected the columns of 3DGS, found {_shortened(unknown):.200} too, which gsbench does "
            f"not know: remove them if they do not change the look",
        )
    return others


def _shortened(names: Sequence[str]) -> str:
    """List names; those that differ by a number alone become one, such as ``motion_0..8``."""
    groups: dict[str, list[str]] = {}
    for name in names:
        stem = name.rstrip("0123456789")
        groups.setdefault(stem, []).append(name.removeprefix(stem))
    return ", ".join(stem + (f"{ends[0]}..{ends[-1]}" if len(ends) > 1 else ends[0]) for stem, ends in groups.items())

"""Rasterize 3D Gaussians by kernels: project them, list the intersections of each tile, and blend them into images."""

from collections.abc import Hashable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels import recording
from gsbench.kernels.headers import TILE
from gsbench.kernels.library import Slots, allocate, library_of
from gsbench.kernels.operation import (
    MOST_KNOWN,
    Gradient,
    Input,
    Operation,
    Output,
    Results,
    Tensors,
    address,
    has_leading,
    in_rows,
)
from gsbench.process.memory import require

Numbers = tuple[Any, ...]  # the arguments of an operation that are not tensors
TILE_PIXELS = TILE * TILE
PAIRS = "lists of each tile's Gaussians"  # what needs memory, where it does not suffice
MAX_PAIRS = (1 << 31) - 1  # splats and tile intersections (pairs of tile and splat) are numbered by int32
MARGIN = 1.25  # memory for tile intersections on a GPU, as a multiple of what an image needs
ROOM = 2.0  # the same of a recording, as a multiple of what its first image needs
GEOMETRY = 6  # numbers per splat: x, y, p, q, r, opacity; of a Beta profile its exponent too
NEAR, FAR = 0.01, 1e10  # default range of depths; a Gaussian whose mean is outside is culled
EPS2D = 0.3  # default number that is added to the diagonal of projected covariances, pixels^2
LOWER = "use a smaller image, fewer cameras at once or fewer Gaussians"  # where memory does not suffice


class Viewport(NamedTuple):
    """The arguments of `rasterize` that are not tensors: image size, near and far plane, blur and antialiasing."""

    width: int
    height: int
    near: float
    far: float
    eps2d: float
    antialias: bool


class RasterInputs(NamedTuple):
    """The tensors that `rasterize` takes, of one dtype on one device; `gsbench.raster.rasterize` explains them."""

    means: Tensor  # [N, 3] for all cameras, or [C, N, 3]; so are factors, opacities and exponents
    factors: Tensor  # [N, 3, 3] F of the covariances F F^T
    opacities: Tensor  # [N]
    colors: Tensor  # [N, D] for all cameras, or [C, N, D]
    viewmats: Tensor  # [C, 4, 4]
    Ks: Tensor  # [C, 3, 3]
    background: Tensor  # [D]
    beta_exponents: Tensor | None = None  # [N] of Beta profiles; None: Gaussians


class Splats(NamedTuple):
    """Gaussians projected to the image planes of C cameras."""

    means2d: Tensor  # [C, N, 2] pixels
    roots: Tensor  # [C, N, 4]: p, q, r of the inverse 2D covariance's triangular root (math/projection.h); the opacity
    depths: Tensor  # [C, N]
    half_sizes: Tensor  # [C, N, 2] pixels, beyond which alpha < 1/255; 0: not drawn; without a gradient
    beta_exponents: Tensor | None = None  # [N] or [C, N] of Beta profiles; None: Gaussians


class Bins(NamedTuple):
    """The projected Gaussians that touch each image tile, sorted front to back."""

    offsets: Tensor  # [C * tiles + 1] int32: tile t's list is ids[offsets[t] : offsets[t + 1]]
    ids: Tensor  # [pairs] int32


def count_tiles(width: int, height: int) -> int:
    """Return the number of tiles in an image."""
    return -(-width // TILE) * -(-height // TILE)


def _sets_of_gaussians(tensors: dict[str, Tensor], _: dict[str, Any]) -> dict[str, int]:
    """Return whether each camera sees Gaussians of its own."""
    dims = {"means": 2, "factors": 3, "opacities": 1, "shapes": 1}  # of one set
    return {"gaussian_per_camera": int(has_leading("project", tensors, dims))}


_project = Operation(
    "project",
    inputs={
        "means": Input("?C N 3"),
        "factors": Input("?C N 3 3"),
        "opacities": Input("?C N"),
        "viewmats": Input("C 4 4", Gradient.ON_REQUEST),
        "Ks": Input("C 3 3", Gradient.REFUSED),
        "shapes": Input("?C N", Gradient.NONE, left_out_with="shapes"),
    },
    outputs={
        "means2d": Output("C N 2"),
        "roots": Output("C N 4"),
        "depths": Output("C N"),
        "half_sizes": Output("C N 2", gradient=False),
    },
    numbers={"width": int, "height": int, "near": float, "far": float, "eps2d": float, "antialias": bool},
    derive=_sets_of_gaussians,
    memory="projected Gaussians",
)


def project(inputs: RasterInputs, viewport: Viewport) -> Splats:
    """Project 3D Gaussians to the image planes of all cameras (EWA splatting, eq. 29).

    The result is differentiable with respect to all inputs except Ks and exponents, on which only the sizes depend.
    """
    means, factors, opacities, _, viewmats, Ks, _, beta_exponents = inputs
    splats = Splats(*_project(means, factors, opacities, viewmats, Ks, beta_exponents, *viewport))
    return splats._replace(beta_exponents=beta_exponents)


def _sizes_of_images(tensors: dict[str, Tensor], numbers: dict[str, Any]) -> dict[str, int]:
    """Return the numbers of channels, of lists of tiles, and of numbers that a backward kernel adds for each splat."""
    colors = tensors["colors"]
    C, D, sets = tensors["means2d"].shape[0], colors.shape[-1], colors.shape[0] if colors.dim() == 3 else 1
    if sets not in (1, C):
        raise InputError(f"blend: expected one set of colours, or one a camera, got {sets} for {C} cameras")
    tiles = C * count_tiles(numbers["width"], numbers["height"])
    return {
        "color_per_camera": int(C > 1 and sets == C),
        "shape_per_camera": int("shapes" in tensors and tensors["shapes"].dim() == 2),
        "lists": tiles + 1,
        "D": D,
        "sums": GEOMETRY + ("shapes" in tensors) + D,
        "state": tiles // C * TILE_PIXELS,  # of an image, for whole tiles
    }


_blend = Operation(
    "blend",
    inputs={
        "means2d": Input("C N 2"),
        "roots": Input("C N 4"),
        "half_sizes": Input("C N 2", Gradient.NONE),
        "colors": Input("?sets N D"),
        "background": Input("D", Gradient.ON_REQUEST),
        "offsets": Input("lists", Gradient.NONE, (torch.int32,)),
        "ids": Input("pairs", Gradient.NONE, (torch.int32,), is_list=True),
        "shapes": Input("?C N", left_out_with="shapes"),
    },
    outputs={
        "image": Output("C height width D"),
        "alpha": Output("C height width 1"),
        "transmittance": Output("C state", gradient=False),
        "stop": Output("C state", gradient=False),
    },
    numbers={"width": int, "height": int},
    derive=_sizes_of_images,
    scratch="C N sums",
    memory="images",
)


def blend(splats: Splats, colors: Tensor, background: Tensor, bins: Bins, viewport: Viewport) -> tuple[Tensor, Tensor]:
    """Blend the Gaussians of each tile front to back (3DGS eq. 3); return image [C, H, W, D] and alpha [C, H, W, 1].

    Colours are [N, D] if all cameras see the same ones, otherwise [C, N, D]. The background is [D].
    """
    means2d, roots, _, half_sizes, beta_exponents = splats
    image, alpha, *_ = _blend(means2d, roots, half_sizes, colors, background, *bins, beta_exponents, *viewport[:2])
    return image, alpha


def flag_values(inputs: RasterInputs) -> Tensor:
    """Return a tensor [1] int64 that is not zero if any value is not finite or out of range."""
    means, colors = inputs.means, inputs.colors
    flags = torch.zeros(1, dtype=torch.int64, device=means.device)
    N, C, D = inputs.opacities.numel(), len(inputs.viewmats), colors.shape[-1]
    sizes = {"N": N, "C": C, "all_colors": colors.numel(), "D": D}
    names = ("means", "factors", "opacities", "colors", "viewmats", "Ks", "background", "shapes")  # of the kernel
    present = {name: x for name, x in zip(names, inputs, strict=True) if x is not None}
    rows = in_rows(list(present.values()))
    slots = sizes | {"shapes": 0, "out.flags": address(flags)} | dict(zip(present, map(address, rows), strict=True))
    library_of(means.device.type).call("flag_values", slots, means)
    return flags


@torch.no_grad()
def bin_tiles(splats: Splats, viewport: Viewport) -> Bins:
    """List on a CPU the projected Gaussians that touch each tile, sorted by depth, and by index if depths are equal.

    Raises:
        InputError: there are more tile intersections than int32 can count or than fit into memory.
    """
    like, (C, N) = splats.depths, splats.depths.shape
    library = library_of(like.device.type)
    slots: Slots = {"N": N, "C": C, "width": viewport.width, "height": viewport.height}
    slots |= {name: address(getattr(splats, name)) for name in ("means2d", "depths", "half_sizes")}
    offsets = like.new_empty(C * count_tiles(viewport.width, viewport.height) + 1, dtype=torch.int32)
    total = like.new_empty(1, dtype=torch.int64)
    library.call("count_tiles", slots | {"out.offsets": address(offsets), "out.pairs": address(total)}, like)
    # The condition is for repetitions, when `room` is known.
    pairs = _checked_count(recording.read(total, lambda values: values[0] <= room)[0])
    room = pairs if recording.current() is None else int(ROOM * pairs)  # repetitions use the same memory
    require(4 * room, f"the lists of {pairs} pairs of a tile and a Gaussian", LOWER)
    ids = like.new_empty(room, dtype=torch.int32)
    library.call("fill_tiles", slots | {"out.offsets": address(offsets), "out.ids": address(ids)}, like)
    return Bins(offsets, ids[:pairs])


class Drawing(NamedTuple):
    """Images that a GPU draws by one call, which is not recorded for the backward pass yet."""

    projection: tuple[Tensors, Numbers, Results]
    blending: tuple[Tensors, Numbers, Results]
    needed: Tensor  # [2] int64: the number of tile intersections; not zero if an input is invalid

    @property
    def image(self) -> Tensor:
        """The images [C, H, W, D], without a gradient."""
        return self.blending[2][0][0]

    def record(self) -> tuple[Splats, Tensor, Tensor]:
        """Record the call for the backward pass; return the splats, and image and alpha as `blend` does."""
        splats = Splats(*_project.record(*self.projection))  # `blending` has their exponents
        (_, _, _, *further), numbers, results = self.blending  # the first three again, but with gradients
        image, alpha, *_ = _blend.record([splats.means2d, splats.roots, splats.half_sizes, *further], numbers, results)
        return splats, image, alpha


def enqueue(inputs: RasterInputs, viewport: Viewport, room: int) -> Drawing:
    """Draw images on a GPU by one call, without waiting for the GPU.

    Memory is allocated for `room` tile intersections. If the images need more, or a value is out of range, each image
    has a NaN.
    """
    means, factors, opacities, colors, viewmats, Ks, background, beta_exponents = inputs
    library, size = library_of(means.device.type), viewport[:2]
    projection = _project.split((means, factors, opacities, viewmats, Ks, beta_exponents, *viewport))
    splats, slots = projected = _project.allocate_results(*projection)
    means2d, roots, depths, half_sizes = splats  # depths [C, N]
    offsets = allocate("lists of tiles", means, (len(depths) * count_tiles(*size) + 1,), torch.int32)
    ids = allocate(PAIRS, means, (room,), torch.int32)
    blending = _blend.split((means2d, roots, half_sizes, colors, background, offsets, ids, beta_exponents, *size))
    blended = _blend.allocate_results(*blending)
    needed = allocate("a count of tile intersections", means, (2,), torch.int64)
    scratch_bytes = library.extension.draw_scratch(depths.numel(), room)
    scratch = allocate(PAIRS, means, (scratch_bytes,), torch.uint8)
    out = {"offsets": offsets, "ids": ids, "needed": needed, "scratch": scratch}
    # `draw` has the arguments of projection and blending, and its own.
    slots = slots | blended[1] | {f"out.{key}": address(x) for key, x in out.items()}
    library.call("draw", slots | {"out.room": room, "out.scratch_bytes": scratch_bytes}, means)
    del out  # used until here, because compiled code frees a tensor after its last use, and the call has its address
    return Drawing((*projection, projected), (*blending, blended), needed)


_rooms: dict[Hashable, int] = {}  # for how many tile intersections the last call had memory, by its sizes


def draw_on_gpu(inputs: RasterInputs, viewport: Viewport) -> tuple[Drawing, int, int]:
    """Draw images on a GPU, with memory for all tile intersections. The CPU waits for the images.

    A repetition does not wait: an image has a NaN if it needs more memory than the recording has.

    Also return the number of tile intersections, and a number that is not zero if an input is invalid.

    Raises:
        InputError: there are more tile intersections than int32 can count.
    """
    if recording.current() is None:
        return _draw_unrecorded(inputs, viewport)
    with recording.paused():  # a repetition has one call, with memory for more than this image needs
        _, pairs, flagged = _draw_unrecorded(inputs, viewport)
    return enqueue(inputs, viewport, int(ROOM * pairs)), pairs, flagged


def _draw_unrecorded(inputs: RasterInputs, viewport: Viewport) -> tuple[Drawing, int, int]:
    """Draw as `draw_on_gpu`: with the memory of the last call, and again with more if this was too little."""
    splats = len(inputs.viewmats) * inputs.means.shape[-2]
    sizes = inputs.means.device, splats, viewport.width, viewport.height
    while True:
        room = _rooms.setdefault(sizes, splats)
        drawing = enqueue(inputs, viewport, room)
        pairs, flagged = drawing.needed.tolist()
        if not pairs <= room <= 2 * pairs:  # too little, or more than twice as much as needed
            if len(_rooms) >= MOST_KNOWN:
                _rooms.clear()
            _rooms[sizes] = room_for(pairs)
        if pairs <= room:
            return drawing, pairs, flagged
        del drawing  # so that the next one can have its memory


def room_for(pairs: int) -> int:
    """Return for how many tile intersections to allocate memory where `pairs` are expected: MARGIN times as many.

    Raises:
        InputError: there are more than int32 can count.
    """
    return min(int(MARGIN * _checked_count(pairs)) + 1, MAX_PAIRS)


@torch.no_grad()
def add_density(
    drawn: Tensor,  # [C, N] bool: which Gaussians are not culled
    g_means2d: Tensor,  # [C, N, 2] gradient of the 2D means, per pixel
    scale: tuple[float, float],  # of its x and y
    gradient: Tensor,  # [N] the sum of its norms, added to
    times_visible: Tensor,  # [N] the number of cameras in which a Gaussian is drawn, added to
    unseen: Tensor | None,  # [N] int32: cameras since a Gaussian was last drawn, updated
    skip: Tensor,  # []: nothing is added unless it is 0
) -> None:
    """Add up on a GPU, in one kernel, what density control needs of a view; in torch it is ten operations."""
    drawn, g_means2d = in_rows([drawn, g_means2d])
    slots = {
        "N": drawn.shape[1],
        "C": drawn.shape[0],
        "drawn": address(drawn),
        "g_means2d": address(g_means2d),
        "scale_x": scale[0],
        "scale_y": scale[1],
        "skip": address(skip),
        "out.gradient": address(gradient),
        "out.times_visible": address(times_visible),
        "out.unseen": address(unseen),
    }
    library_of(drawn.device.type).call("add_density", slots, drawn)


def _checked_count(pairs: int) -> int:
    """Return the number of tile intersections; raise InputError if int32 cannot count them."""
    if pairs > MAX_PAIRS:
        raise InputError(
            f"{pairs} pairs of a tile and a Gaussian are more than {MAX_PAIRS}: "
            "draw fewer cameras at once, a smaller image, or fewer large Gaussians"
        )
    return pairs

"""Define the data types Camera, View (camera, time and image), Points and Scene (train, val and test views)."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.raster import NEAR

UP = (0.0, 0.0, 1.0)  # in Blender's layout: D-NeRF, 7DGS-PBR, the embedded scenes
STANDARD = 4.0  # the distance of cameras from what they look at, in the coordinates of a training; D-NeRF's
HELD_OUT = 8  # every eighth view in the order of time is a test view, where a capture has no split
_LEAN = 0.01  # weight w of the mean up vector in `up_of`: decides where cameras without roll leave a choice


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with OpenCV axes (x right, y down, z forward) and pixel centres at +0.5."""

    viewmat: Tensor  # [4, 4] world to camera, rigid
    K: Tensor  # [3, 3] intrinsics in pixels
    width: int
    height: int
    near: float = NEAR  # depth, in world units; Gaussians whose mean is nearer are not drawn
    center: Tensor = field(init=False, compare=False, repr=False)  # [3] the position in world space

    def __post_init__(self) -> None:
        """Compute the position, which every rendering needs, once."""
        object.__setattr__(self, "center", -self.viewmat[:3, :3].T @ self.viewmat[:3, 3])

    def clone(self) -> "Camera":
        """Return the same camera in memory of its own, which `overwrite` may change."""
        return replace(self, viewmat=self.viewmat.clone(), K=self.K.clone())

    def overwrite(self, other: "Camera") -> None:
        """Write the values of another camera, with the same size and near plane, to the memory of this one."""
        self.viewmat.copy_(other.viewmat)
        self.K.copy_(other.K)
        self.center.copy_(other.center)

    def to(self, device: str) -> "Camera":
        """Return a copy of the camera whose tensors are on `device`."""
        return replace(self, viewmat=self.viewmat.to(device), K=self.K.to(device))


@dataclass(frozen=True)
class View:
    """An image with the camera and the time at which it was taken."""

    name: str  # name in the data set, such as "train/r_000"
    camera: Camera
    time: float | None  # in [0, 1]; None if the data set has no times
    pixels: Tensor  # [H, W, 3] floats in [0, 1] or 8 bits, or [H, W, 4] 8 bits with straight alpha
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # `image` composites pixels with alpha over this colour
    composited_alpha: Tensor | None = None  # [H, W] 8 bits: alpha of an image that was composited when it was loaded
    regions: Tensor | None = None  # [H, W] 8 bits: the number of the object seen in each pixel, 0 = none; None: unknown
    is_on_disk: bool = False  # whether `pixels` maps a file: they stay on the CPU, and are read at each access

    @property
    def alpha(self) -> Tensor | None:
        """The alpha channel of the image file, [H, W] 8 bits; None if the image has none."""
        return self.pixels[..., 3] if self.pixels.shape[-1] == 4 else self.composited_alpha

    @property
    def image(self) -> Tensor:
        """The image composited over the background, [H, W, 3] floats in [0, 1].

        An image that is stored in 8 bits is converted at each access.
        """
        values = to_floats(self.pixels.to(self.camera.K.device))
        if values.shape[-1] == 3:
            return values
        alpha = values[..., 3:]
        image = values[..., :3] * alpha
        if any(self.background):  # zeros would change nothing
            image.add_(values.new_tensor(self.background) * (1 - alpha)).clamp_(0, 1)
        return image

    @property
    def target(self) -> Tensor:
        """The image that a training loss takes, [H, W, 3]: `pixels` as stored if without alpha, otherwise `image`."""
        return self.pixels.to(self.camera.K.device) if self.pixels.shape[-1] == 3 else self.image

    def to(self, device: str) -> "View":
        """Return a copy of the view whose tensors are on `device`, but for pixels that map a file."""
        alpha, regions = (x if x is None else x.to(device) for x in (self.composited_alpha, self.regions))
        camera, pixels = self.camera.to(device), self.pixels if self.is_on_disk else self.pixels.to(device)
        return replace(self, camera=camera, pixels=pixels, composited_alpha=alpha, regions=regions)


@dataclass(frozen=True)
class Points:
    """The points at which Gaussians start, given by the data set or drawn at random."""

    means: Tensor  # [P, 3]
    colors: Tensor  # [P, 3] in [0, 1]
    times: Tensor | None = None  # [P] in [0, 1], at which a model with time may start its Gaussians; None: not known


@dataclass(frozen=True)
class Placement:
    """Where a scene lies: a position x in the user's coordinates is `(x - center) / unit` in those of the training."""

    center: tuple[float, float, float] = (0.0, 0.0, 0.0)  # in the user's coordinates
    unit: float = 1.0  # in the user's units

    @property
    def is_identity(self) -> bool:
        """Whether the scene is trained where its files place it."""
        return self == Placement()

    @property
    def float_step(self) -> float:
        """Return the distance of neighbouring float32 numbers at the centre, in units of the cameras' distance."""
        return 2**-23 * max(map(abs, self.center)) / (self.unit * STANDARD)

    def to_standard(self, positions: Tensor) -> Tensor:  # [.., 3] in the user's coordinates -> [.., 3] float32
        """Convert positions to the coordinates of the training; the difference is taken in double precision."""
        return ((positions.double() - positions.new_tensor(self.center, dtype=torch.float64)) / self.unit).float()

    def to_user(self, positions: Tensor) -> Tensor:  # [.., 3] in the coordinates of the training -> [.., 3] float64
        """Convert positions to the user's coordinates."""
        return positions.double() * self.unit + positions.new_tensor(self.center, dtype=torch.float64)

    def near_to_standard(self, near: float | None) -> float:
        """Convert a near plane from the user's units to those of the training; None is the rasterizer's default."""
        return NEAR if near is None else near / self.unit

    def viewmat_to_standard(
        self,
        viewmat: Tensor,  # [4, 4] float64, world to camera in the user's coordinates
    ) -> Tensor:  # [4, 4] float32
        """Convert a world-to-camera matrix: its rotation stays, and the camera moves as positions do."""
        # R (unit x + center) + t = unit (R x + (t + R center) / unit)
        moved = viewmat.double().clone()
        moved[:3, 3] += moved[:3, :3] @ moved.new_tensor(self.center)
        moved[:3, 3] /= self.unit
        return moved.float()


@dataclass(frozen=True)
class Scene:
    """A data set of one scene: training, validation and test views, background colour, extent and initial points."""

    name: str
    train: list[View]
    val: list[View]
    test: list[View]
    background: tuple[float, float, float]  # the colour over which every image is composited
    extent: float  # 1.1 x the radius of the training cameras around their mean (3DGS, getNerfppNorm)
    points: Points | None  # None: the data set has no points
    fingerprint: str  # SHA-256 of the files, by which record.json identifies the data
    repaired: tuple[str, ...] = ()  # names of damaged images that were replaced by the frame before
    notes: tuple[str, ...] = ()  # what was decided where the files leave a choice, and what of them was not read
    up: tuple[float, float, float] = UP  # unit vector; orbits and the viewer turn about it, training does not read it
    placement: Placement = Placement()  # from the user's coordinates to those of `train`, `points` and `extent`

    @property
    def has_time(self) -> bool:
        """Whether every training view has a time."""
        return all(view.time is not None for view in self.train)

    def with_near(self, near: float) -> "Scene":  # in the user's units
        """Return a copy of the scene in which the near plane of all cameras is `near`."""
        depth = self.placement.near_to_standard(near)
        return self._with_views(lambda view: replace(view, camera=replace(view.camera, near=depth)))

    def with_val(self, every: int) -> "Scene":
        """Return a copy of the scene in which every n-th training view is a validation view, from the n-th on.

        The extent stays, so that learning rates do. Test views are not used.
        """
        if self.val:
            raise InputError(f"scene.val_every: expected no views of val, {self.name} has {len(self.val)}")
        train, val = hold_out(self.train, every)
        if not train or not val:
            raise InputError(
                f"scene.val_every: expected views for train and for val, "
                f"got every {every} of {len(self.train)} training views of {self.name}"
            )
        return replace(self, train=train, val=val)

    def to(self, device: str) -> "Scene":
        """Return a copy of the scene whose views are on `device`."""
        return self._with_views(lambda view: view.to(device))

    def _with_views(self, change: Callable[[View], View]) -> "Scene":
        train, val, test = ([change(view) for view in views] for views in (self.train, self.val, self.test))
        return replace(self, train=train, val=val, test=test)


def hold_out(views: list[View], every: int) -> tuple[list[View], list[View]]:
    """Return two lists: the views that stay, and every n-th view, from the n-th on."""
    return [view for i, view in enumerate(views, 1) if i % every], views[every - 1 :: every]


def to_floats(pixels: Tensor) -> Tensor:  # [..] floats in [0, 1] or 8 bits
    """Return the values of an image in [0, 1]; those of 8 bits are divided by 255."""
    if pixels.is_floating_point():
        return pixels
    # The divisor is a tensor, because a GPU would multiply by the rounded 1/255 instead of dividing by a number.
    return pixels.float().div_(torch.full((), 255.0, device=pixels.device))


def scene_extent(viewmats: Tensor) -> float:  # [C, 4, 4] the training cameras
    """Return the extent of a scene: 1.1 x the largest distance of a camera from the mean camera position.

    3DGS computes the extent in the same way (`getNerfppNorm`). Learning rates of positions and the threshold between
    clone and split are multiples of the extent.
    """
    rotations, translations = viewmats[:, :3, :3].double(), viewmats[:, :3, 3].double()
    centers = -torch.einsum("cji,cj->ci", rotations, translations)  # [C, 3] -R^T t
    return 1.1 * float((centers - centers.mean(dim=0)).norm(dim=1).max())


def up_of(viewmats: Tensor) -> tuple[float, float, float]:  # [C, 4, 4] the training cameras
    """Estimate which way is up from the cameras, for data whose world axes are arbitrary, as COLMAP's are.

    The mean of the cameras' up vectors leans towards the scene if the cameras look down and stand on one side of it.
    Cameras without roll have level x axes r_i, so the result is the unit vector u along (mean r_i r_i^T + w I)^-1 m,
    where m is the mean up vector and w is small. Before it is normalised, u minimises mean (r_i u)^2 + w |u|^2 - 2 m u:
    it is level to all r_i, and in the plane that they leave free along m.
    """
    rotations = viewmats[:, :3, :3].double()
    right, mean_up = rotations[:, 0], -rotations[:, 1].mean(0)  # [C, 3] and [3], as rows are camera axes and y is down
    matrix = right.T @ right / len(right) + _LEAN * torch.eye(3, dtype=torch.float64)
    if float(mean_up.norm()) < _LEAN:  # the up vectors cancel, so that they say nothing
        return UP
    up = torch.linalg.solve(matrix, mean_up)
    x, y, z = (up / up.norm()).tolist()
    return x, y, z

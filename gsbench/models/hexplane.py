"""Define 4DGaussians: 3D Gaussians that a field, stored in planes over position and time, moves, turns and resizes.

Wu et al., "4D Gaussian Splatting for Real-Time Dynamic Scene Rendering", CVPR 2024, arXiv 2310.08528, with the
constants of the authors' code. The planes are those of HexPlane (Cao and Johnson, CVPR 2023).
"""

import math
from collections.abc import Sequence
from functools import reduce
from itertools import accumulate, starmap
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gsbench.kernels.backends import CPU
from gsbench.kernels.fields import field, plane_penalty, sample_planes
from gsbench.kernels.tape import collect_gradients
from gsbench.kernels.tensors import check_number, check_whole
from gsbench.models.base import Raw
from gsbench.models.camera_time import CameraTime
from gsbench.models.gaussians3d import Gaussians3DModel
from gsbench.models.networks import Linear
from gsbench.models.registry import register
from gsbench.scenes.scene import Points

GEOMETRY = (("means",), ("scales",), ("quats",))  # the raw parameters that each head of the network changes
SPACE, TIME = ("xy", "xz", "yz"), ("xt", "yt", "zt")  # the axes of a level's planes
APPEARANCE = (("opacities",), ("sh0", "shN"))
THINNEST = 1e-3  # least width of the box of the planes, in parts of its largest: all initial points may lie in a plane


@register("hexplane")
class HexPlaneModel(Gaussians3DModel):
    """4DGaussians: canonical 3D Gaussians, as in 3DGS, and a field that changes their raw parameters at a time t,

        (dp, ds, dr) = network(planes(mu_p, t))        mean = mu_p + dp
        cov = R S S^T R^T with R of the quaternion q + dr and S = diag(exp(s + ds))

    and with `appearance` also opacities and colours. AGR changes raw parameters too, so both act in `refined`, before
    the slice. Density control sees the canonical Gaussians, which alone are drawn during the warm-up.
    """

    observes: ClassVar[tuple[str, ...]] = ("time",)
    warm_up = 3 / 23  # the authors': 3,000 of 23,000
    planes: "Planes"  # of an initialised model, as the network
    network: "Network"

    def __init__(
        self,
        *,
        channels: int = 32,  # numbers in a node of a plane
        levels: int = 2,  # sets of six planes; each has twice the nodes along x, y and z of the set before
        resolution: int = 64,  # nodes along x, y and z in the first level
        time_resolution: int = 25,  # nodes along t in every level
        width: int = 64,  # of the hidden layers
        appearance: bool = False,  # whether the field also changes opacities and colours
        space_smoothness: float = 1e-4,  # weights in the loss, see `Planes.penalty`
        time_smoothness: float = 1e-2,
        time_sparsity: float = 1e-4,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        check_whole(channels, "channels", 1, 1024)
        check_whole(levels, "levels", 1, 8)
        check_whole(resolution, "resolution", 3, 1024)
        check_whole(time_resolution, "time_resolution", 3, 4096)
        check_whole(width, "width", 1, 4096)
        check_number(space_smoothness, "space_smoothness", 0)
        check_number(time_smoothness, "time_smoothness", 0)
        check_number(time_sparsity, "time_sparsity", 0)
        self.channels, self.width = channels, width
        self.heads = GEOMETRY + APPEARANCE * appearance
        self.levels, self.nodes = levels, (resolution, resolution, resolution, time_resolution)
        self.weights = space_smoothness, time_smoothness, time_sparsity

    def initialise(self, points: Points, extent: float, generator: torch.Generator) -> None:
        """Start as 3DGS does, with a field of random weights: at the end of the warm-up, the Gaussians jump."""
        super().initialise(points, extent, generator)
        self.planes = Planes(points.means, self.nodes, self.levels, self.channels, generator)
        self.outputs = {name: self.splats[name][0].numel() for head in self.heads for name in head}
        outputs = [sum(self.outputs[name] for name in head) for head in self.heads]
        self.network = Network(self.levels * self.channels, self.width, outputs, generator)

    def refined(self, query: CameraTime) -> Raw:
        """Return the raw parameters after AGR and, from the end of the warm-up on, the field have changed them."""
        raw = super().refined(query)
        if self.active.warms_up:
            return raw
        assert query.time is not None
        changes: list[Tensor] = []  # of each raw parameter, [N, its numbers]
        for outputs, names in zip(self.changes(raw["means"], query.time), self.heads, strict=True):
            changes += outputs.split([self.outputs[name] for name in names], -1)
        by_name = zip(self.outputs, changes, strict=True)
        changed = collect_gradients(*(raw[name] + change.view_as(raw[name]) for name, change in by_name))
        return raw | dict(zip(self.outputs, changed, strict=True))

    def changes(self, means: Tensor, time: Tensor) -> list[Tensor]:  # [N, 3] [] -> [heads] of [N, outputs]
        """Return what the field adds to the raw parameters of Gaussians at these means, as each head says."""
        widths = self.network.outputs
        if not CPU.serves(means):
            return list(self.network(self.planes(means, time)).split(widths, -1))
        planes = self.planes
        products, *weights = self.shared or self._timeless(means)
        arguments = products, means, planes.high, planes.low, time, planes.of_time, *weights, self.network.ends
        outputs = field(*arguments, *planes.size)[0].flatten()  # head by head, each [N, width]
        by_head = outputs.split([len(means) * width for width in widths])
        return [part.view(len(means), width) for part, width in zip(by_head, widths, strict=True)]

    def shared_by_views(self) -> list[Tensor]:
        means = self.splats["means"]
        if self.active.warms_up or self.refines or not CPU.serves(means):
            return []
        return self._timeless(means)

    def _timeless(self, means: Tensor) -> list[Tensor]:
        """Return what the kernel of the field reads and time does not change."""
        return [self.planes.products(means), *self.network.stacked()]

    def penalty(self) -> Tensor | None:
        return None if self.active.warms_up else self.planes.penalty(*self.weights)

    def groups(self) -> dict[str, list[nn.Parameter]]:
        field = {"planes": list(self.planes.parameters()), "network": list(self.network.parameters())}
        return super().groups() | field


class Planes(nn.Module):
    """Planes of features over pairs of the axes x, y, z, t (section 4.2); their box is that of the initial points.

    The features of a level are the product of samples of its six planes. Space planes start at random, planes with t
    at 1, where time changes nothing.
    """

    low: Tensor  # [3] the corners of the box, world units
    high: Tensor  # [3]

    def __init__(
        self,
        points: Tensor,  # [N, 3] positions of the initial points, world units
        nodes: tuple[int, int, int, int],  # along x, y, z and t in the first level
        levels: int,  # each has twice as many along x, y and z as the level before
        channels: int,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        low, high = points.aminmax(dim=0)
        self.register_buffer("high", high)
        self.register_buffer("low", torch.minimum(low, high - THINNEST * (high - low).max()))
        self.size = channels, levels, *nodes
        along = [
            dict(zip("xyzt", (*(n * 2**level for n in nodes[:3]), nodes[3]), strict=True)) for level in range(levels)
        ]
        # The rows and columns of each level's planes: the second axis runs over rows.
        self.shapes = [{axes: (n[axes[1]], n[axes[0]]) for axes in SPACE + TIME} for n in along]
        space, time = (sum(math.prod(shape[axes]) for shape in self.shapes for axes in kind) for kind in (SPACE, TIME))
        # The nodes of all planes, level by level, plane by plane and row by row
        self.of_space = nn.Parameter(torch.empty(space, channels).uniform_(0.1, 0.5, generator=generator))
        self.of_time = nn.Parameter(torch.ones(time, channels))

    def levels(self) -> list[dict[str, Tensor]]:
        """Return the planes of each level by their axes, [rows, columns, C]; they share the memory of the nodes."""
        levels: list[dict[str, Tensor]] = [{} for _ in self.shapes]
        for kind, nodes in ((SPACE, self.of_space), (TIME, self.of_time)):
            # In the order of the nodes; `level` is the dictionary that gets the plane
            named = [
                (level, axes, shape[axes]) for level, shape in zip(levels, self.shapes, strict=True) for axes in kind
            ]
            planes = nodes.split([math.prod(shape) for _, _, shape in named])
            for (level, axes, shape), plane in zip(named, planes, strict=True):
                level[axes] = plane.unflatten(0, shape)
        return levels

    def forward(
        self,
        positions: Tensor,  # [N, 3] world units
        time: Tensor,  # [] in [0, 1]
    ) -> Tensor:
        """Return the features of all levels, [N, levels C].

        From the lowest to the highest corner of the box, coordinates fall from 1 to -1. Time is used as it is, so only
        the second half of the nodes along t is read, as in the authors' code.
        """
        # NaN would end the process in the gradient of grid_sample.
        coordinates = ((positions - self.high) * 2 / (self.low - self.high) - 1).nan_to_num()
        at = dict(zip("xyzt", (*coordinates.unbind(-1), time.expand(len(coordinates))), strict=True))

        def sample(axes: str, plane: Tensor) -> Tensor:
            grid = torch.stack([at[axis] for axis in axes], -1)[None, None]  # [1, 1, N, 2] column and row in [-1, 1]
            plane = plane.movedim(-1, 0)[None]
            return F.grid_sample(plane, grid, padding_mode="border", align_corners=True)[0, :, 0].T  # [N, C]

        return torch.cat([reduce(torch.mul, starmap(sample, level.items())) for level in self.levels()], -1)

    def products(self, positions: Tensor) -> Tensor:  # [N, 3] -> [N, levels C]
        """Return the products of the samples of the planes without t, by a kernel of the CPU."""
        return sample_planes(positions, self.high, self.low, self.of_space, *self.size[:-1])[0]

    def penalty(self, space_smoothness: float, time_smoothness: float, time_sparsity: float) -> Tensor:
        """Return the sum over planes of three weighted terms, [].

        For all planes, it is the mean square of second differences along the rows (y, z or t), not along the columns,
        as in the authors' code. For those with t, it is also the mean distance from 1.
        """
        if CPU.serves(self.of_space):
            weights = space_smoothness, time_smoothness, time_sparsity
            return plane_penalty(self.of_space, self.of_time, *self.size, *weights)[0]
        terms = []
        for level in self.levels():
            for axes, plane in level.items():
                roughness = plane.diff(n=2, dim=0).square().mean()
                terms.append(roughness * (time_smoothness if axes in TIME else space_smoothness))
                if axes in TIME:
                    terms.append(time_sparsity * (1 - plane).abs().mean())
        return torch.stack(terms).sum()


class Network(nn.Module):
    """The network of 4DGaussians (section 4.3): a layer, then heads of two more layers each."""

    ends: Tensor  # [heads] int32: the number of outputs up to the end of each head

    def __init__(
        self,
        inputs: int,
        width: int,  # of the hidden layers
        outputs: Sequence[int],  # of each head
        generator: torch.Generator,
    ) -> None:
        super().__init__()

        def layer(inputs: int, outputs: int, *, relu: bool = False) -> Linear:
            linear = Linear(inputs, outputs, generator, relu=relu)
            nn.init.xavier_uniform_(linear.weight, generator=generator)
            return linear

        self.first = layer(inputs, width, relu=True)
        self.heads = nn.ModuleList(
            nn.Sequential(layer(width, width, relu=True), layer(width, last)) for last in outputs
        )
        self.outputs = list(outputs)
        ends = torch.tensor(list(accumulate(outputs)), dtype=torch.int32)
        self.register_buffer("ends", ends, persistent=False)

    def forward(self, features: Tensor) -> Tensor:  # [N, inputs] -> [N, sum of outputs]
        """Return the outputs of all heads, side by side."""
        hidden = self.first(features)
        return torch.cat([head(hidden) for head in self.heads], -1)

    def stacked(self) -> list[Tensor]:
        """Return the weights and biases of the first layer, of all heads' hidden layers and of all last ones."""
        weights, biases, last_weights, last_biases = zip(*(head.parameters() for head in self.heads), strict=True)
        hidden = torch.stack(weights), torch.stack(biases)
        return [self.first.weight, self.first.bias, *hidden, torch.cat(last_weights), torch.cat(last_biases)]

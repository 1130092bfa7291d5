"""Define SC-GS: 3D Gaussians that follow a few hundred nodes, which one network of position and time moves and turns.

Huang et al., "SC-GS: Sparse-Controlled Gaussian Splatting for Editable Dynamic Scenes", CVPR 2024, arXiv 2312.14937,
with the constants of the authors' code.
"""

import math
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from gsbench.kernels.tensors import check_number, check_whole
from gsbench.models.base import Raw
from gsbench.models.camera_time import CameraTime
from gsbench.models.deformable import OUTPUTS, DeformableModel
from gsbench.models.factors import rotation, sizes
from gsbench.models.gaussian_batch import Conditioned
from gsbench.models.portable_math import exp, linear, sigmoid
from gsbench.models.registry import register
from gsbench.scenes.scene import Points
from gsbench.schedule import ActiveComponents

NEAREST = 3  # nodes that a Gaussian follows
FEATURES = 8  # numbers of a Gaussian and of a node that say, beside their positions, who follows whom
DEVIATIONS = (1e-5, 1e-8, 1e-5, 1e-4)  # of the initial weights of the last layer, for each output
TIMES = 8  # times at which the penalty compares the nodes


@register("scgs")
class ScgsModel(DeformableModel):
    """SC-GS: canonical 3D Gaussians, as in 3DGS, that follow the motion of their three nearest nodes n_k at a time t,

        (t_k, ds_k, dr_k, l_k) = phi(stop(n_k), t)        R_k of the quaternion (1, 0, 0, 0) + l_k
        mean = sum w_k (R_k (mu_p - n_k) + n_k + t_k)     (linear blend skinning)
        cov = R S S^T R^T with R of the quaternion q + sum w_k dr_k and S = diag(exp(s) + sum w_k ds_k)

    with the field phi of Deformable-3DGS and the weights w_k of `Nodes`. Density control sees the canonical Gaussians,
    which alone are drawn during the warm-up. At its end, the nodes are placed among them.
    """

    warm_up = 0.125  # the authors', who find the nodes in 10,000 of 80,000 steps
    nodes: "Nodes"  # of an initialised model

    def __init__(
        self,
        *,
        nodes: int = 512,
        rigidity: float = 1e-4,  # weight in the loss, see `stretch`
        **options: Any,
    ) -> None:
        super().__init__(**options)
        check_whole(nodes, "nodes", 1 + NEAREST, 1 << 16)
        check_number(rigidity, "rigidity", 0)
        self.number, self.rigidity = nodes, rigidity
        self.new_field = partial(self.new_field, outputs=(*OUTPUTS, 4))

    def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
        features = torch.full((len(distances), FEATURES), -1e-2)
        return super().initial_geometry(points, distances, generator) | {"features": features}

    @torch.no_grad()
    def initialise(self, points: Points, extent: float, generator: torch.Generator) -> None:
        """Start as 3DGS does, with a field that at first moves next to nothing."""
        super().initialise(points, extent, generator)
        for x in self.field.hidden.parameters():
            if x.dim() == 2:  # weights; the others are biases
                nn.init.kaiming_uniform_(x, nonlinearity="relu", generator=generator)
            else:
                x.zero_()
        deviations = torch.tensor(DEVIATIONS).repeat_interleave(torch.tensor(self.field.outputs))
        self.field.head.weight.normal_(generator=generator).mul_(deviations[:, None])
        self.field.head.bias.zero_()
        self.nodes = Nodes(self.number)
        self.nodes.place(points.means)

    def set_active(self, active: ActiveComponents) -> None:
        """Also place the nodes at the end of the warm-up."""
        if self.active.warms_up and not active.warms_up:
            self.nodes.place(self.splats["means"].detach())
        super().set_active(active)

    def condition(self, raw: Raw, query: CameraTime) -> Conditioned:
        """Blend the motion of the M nodes for each Gaussian; in the warm-up nothing moves."""
        if self.active.warms_up:
            return self.static(raw)
        assert query.time is not None
        n = self.nodes.positions
        t, ds, dr, turn = self.field(n.detach(), query.time)
        R = rotation(turn + turn.new_tensor([1, 0, 0, 0]))  # [M, 3, 3]
        # R (mu_p - n) + n + t = R mu_p + (n + t - R n)
        moves = torch.cat([R.flatten(1), n + t - (R @ n[..., None])[..., 0], ds, dr], -1)
        near, weights = self.nodes.nearest(raw["means"].detach(), raw["features"])
        blended = (of_nodes(moves.T, near) * weights).sum(-1).T  # [N, 9 + 3 + 3 + 4]
        R, shift, ds, dr = blended.split([9, 3, 3, 4], -1)
        means = (R.unflatten(-1, (3, 3)) @ raw["means"][..., None])[..., 0] + shift
        factors = rotation(raw["quats"] + dr) * (sizes(raw["scales"]) + ds)[:, None, :]
        return Conditioned(means, factors, torch.ones_like(raw["opacities"]))

    def penalty(self) -> Tensor | None:
        """Return how far the nodes are from moving as rigidly as possible, with its weight."""
        if self.active.warms_up or self.rigidity == 0:
            return None
        n = self.nodes.positions
        times = torch.linspace(0, 1, TIMES).to(n).repeat_interleave(len(n))
        paths = n + self.field(n.detach().repeat(TIMES, 1), times)[0].unflatten(0, (TIMES, -1))  # [TIMES, M, 3]
        with torch.no_grad():
            near, weights = self.nodes.nearest(n, self.nodes.features, 1 + NEAREST)  # a node itself is the nearest
        return self.rigidity * stretch(paths, near, weights)

    def groups(self) -> dict[str, list[nn.Parameter]]:
        return super().groups() | {"nodes": list(self.nodes.parameters())}


class Nodes(nn.Module):
    """The nodes of SC-GS: positions n, features h, radii rho and logits a, of which Gaussians follow the nearest."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.positions = nn.Parameter(torch.zeros(count, 3))  # until `place`, as log_radii
        self.features = nn.Parameter(torch.full((count, FEATURES), 1e-2))
        self.log_radii = nn.Parameter(torch.zeros(count))
        self.logits = nn.Parameter(torch.zeros(count))

    @torch.no_grad()
    def place(self, points: Tensor) -> None:  # [N, 3] world units
        """Place each node at the point that is farthest from the nodes before it; the first is at the first point.

        If there are fewer points than nodes, the other nodes are at the first point too.
        """
        squares = points.new_full((len(points),), math.inf)
        for node in self.positions:
            node.copy_(points[squares.argmax()])
            squares = torch.minimum(squares, (points - node).square().sum(-1))
        low, high = self.positions.aminmax()
        self.log_radii.fill_(math.log(0.1 * float(high - low) + 1e-7))

    def nearest(
        self,
        positions: Tensor,  # [N, 3] world units
        features: Tensor,  # [N, 8]
        count: int = NEAREST,
    ) -> tuple[Tensor, Tensor]:
        """Return the nearest nodes of points, [N, count], and their weights, [N, count], whose sum is 1.

        With x = (p, y) of a point and x_k = (n_k, h_k) of a node, w_k is proportional to
        exp(-|x - x_k|^2 / (2 rho_k^2)) sigma(a_k) + 1e-7.
        """
        x, places = torch.cat([positions, features], -1), torch.cat([self.positions, self.features], -1)
        with torch.no_grad():  # |x - x_k|^2 is |x|^2 - 2 (x x_k - |x_k|^2 / 2)
            near = linear(x, places, -places.square().sum(-1) / 2).topk(count).indices
        of_near = of_nodes(torch.cat([places.T, self.log_radii[None], self.logits[None]]), near)
        squares = (x.T[..., None] - of_near[:-2]).square().sum(0)  # [N, count]
        log_radii, logits = of_near[-2], of_near[-1]
        weights = exp(-squares / (2 * exp(2 * log_radii))) * sigmoid(logits) + 1e-7
        return near, weights / weights.sum(-1, keepdim=True)


def of_nodes(columns: Tensor, near: Tensor) -> Tensor:  # [C, M] by node, [N, K] nodes -> [C, N, K]
    """Return the columns of nodes. On a CPU the gradient of `gather` adds equal indices in a fixed order."""
    return columns.gather(1, near.flatten().expand(len(columns), -1)).unflatten(1, near.shape)


def stretch(
    paths: Tensor,  # [T, M, 3] positions of the nodes at T times, world units
    near: Tensor,  # [M, K] neighbours of each node
    weights: Tensor,  # [M, K]
) -> Tensor:
    """Return the ARAP energy (as rigid as possible; Sorkine and Alexa 2007) of nodes between successive times, a mean.

    That of a node is sum_k w_k |e_k' - R e_k|^2, with the vectors e_k and e_k' from the node to its neighbours at the
    two times, and the rotation R that makes it least.
    """
    columns = paths.transpose(1, 2).flatten(0, 1)  # [3 T, M]
    edges = (of_nodes(columns, near) - columns[..., None]).unflatten(0, (len(paths), 3)).transpose(1, 2)  # [T, M, 3, K]
    before, after = edges[:-1], edges[1:]
    # The rotation is that of Kabsch: R^T = U diag(1, 1, det U V^T) V^T. At the least energy, the gradient by R is zero.
    with torch.no_grad():
        U, _, V = torch.linalg.svd(((weights[:, None] * before) @ after.mT).double())
        V = V * torch.stack([torch.ones_like(U[..., 0, 0])] * 2 + [torch.linalg.det(U @ V)], -1)[..., None]
        R = (U @ V).mT.to(paths)
    return (weights * (after - R @ before).square().sum(-2)).sum(-1).mean()

"""Define Deformable-3DGS: 3D Gaussians that one network of position and time moves, turns and resizes.

Yang et al., "Deformable 3D Gaussians for High-Fidelity Monocular Dynamic Scene Reconstruction", CVPR 2024,
arXiv 2309.13101, with the constants of the authors' code.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gsbench.kernels.tape import collect_gradients
from gsbench.kernels.tensors import check_whole
from gsbench.models.base import Raw
from gsbench.models.camera_time import CameraTime
from gsbench.models.factors import rotation, sizes
from gsbench.models.gaussian_batch import Conditioned
from gsbench.models.gaussians3d import Gaussians3DModel
from gsbench.models.networks import HiddenLayers, Linear, encode
from gsbench.models.registry import register
from gsbench.scenes.scene import Points

TIME_FEATURES = 30  # outputs of the time network
OUTPUTS = (3, 3, 4)  # numbers in dp, ds and dr


@register("deformable")
@register("deformable_narrow")  # other options in its YAML, records under this name
class DeformableModel(Gaussians3DModel):
    """Deformable-3DGS: canonical 3D Gaussians, as in 3DGS, and a field phi that deforms them at a time t,

        (dp, ds, dr) = phi(stop(mu_p), t)        mean = mu_p + dp
        cov = R S S^T R^T with R of the quaternion q / |q| + dr and S = diag(exp(s) + ds)

    No gradient flows through the position that the field reads. A scale exp(s) + ds may become negative, as in the
    authors' code: its magnitude is the size, because the covariance has its square, and 0 makes a flat Gaussian.
    Density control sees the canonical Gaussians, which alone are drawn during the warm-up.
    """

    observes: ClassVar[tuple[str, ...]] = ("time",)
    warm_up = 0.075  # the authors': 3,000 of 40,000
    field: "DeformationField"  # of an initialised model

    def __init__(
        self,
        *,
        width: int = 256,  # of the hidden layers
        depth: int = 8,  # the number of hidden layers
        octaves: int = 10,  # of the encoding of positions
        time_octaves: int = 6,  # of the encoding of times
        time_network: bool = True,  # for synthetic scenes; the authors' real scenes have none, and 10 octaves of time
        **options: Any,
    ) -> None:
        super().__init__(**options)
        check_whole(width, "width", 1, 4096)
        check_whole(depth, "depth", 1, 64)
        check_whole(octaves, "octaves", 0, 32)
        check_whole(time_octaves, "time_octaves", 0, 32)
        self.new_field = partial(DeformationField, width, depth, octaves, time_octaves, time_network)

    def initialise(self, points: Points, extent: float, generator: torch.Generator) -> None:
        """Start as 3DGS does, with a field of random weights: at the end of the warm-up, the Gaussians jump."""
        super().initialise(points, extent, generator)
        self.field = self.new_field(generator)

    def condition(self, raw: Raw, query: CameraTime) -> Conditioned:
        if self.active.warms_up:
            return self.static(raw)
        assert query.time is not None
        dp, ds, dr = self.field(raw["means"].detach(), query.time)
        R = rotation(F.normalize(raw["quats"], dim=-1) + dr)
        S = sizes(raw["scales"]) + ds
        return Conditioned(raw["means"] + dp, R * S[:, None, :], torch.ones_like(raw["opacities"]))

    def groups(self) -> dict[str, list[nn.Parameter]]:
        return super().groups() | {"field": list(self.field.parameters())}


class DeformationField(nn.Module):
    """The network phi of Deformable-3DGS (section 3.2).

    Its input is the encoded position and features of the time: those of a network of two layers, or the encoded time.
    Positions are in world units, as the authors have them: gsbench brings scenes to the size of D-NeRF's when it loads
    them.
    """

    def __init__(
        self,
        width: int,  # the first five are options of `DeformableModel`
        depth: int,
        octaves: int,
        time_octaves: int,
        time_network: bool,
        generator: torch.Generator,
        outputs: Sequence[int] = OUTPUTS,  # numbers in each result of `forward`
    ) -> None:
        super().__init__()
        self.octaves, self.time_octaves, self.outputs = octaves, time_octaves, outputs
        features = 1 + 2 * time_octaves
        self.of_time: nn.Module = nn.Identity()
        if time_network:
            first, last = Linear(features, width, generator, relu=True), Linear(width, TIME_FEATURES, generator)
            self.of_time, features = nn.Sequential(first, last), TIME_FEATURES
        inputs = 3 * (1 + 2 * octaves) + features
        self.hidden = HiddenLayers(inputs, width, depth, generator)
        self.head = Linear(width, sum(outputs), generator)

    def forward(
        self,
        positions: Tensor,  # [N, 3] world units
        time: Tensor,  # [] or [N] in [0, 1]
    ) -> tuple[Tensor, ...]:
        """Return shifts [N, 3], changes of scales [N, 3] (both world units) and of quaternions [N, 4].

        With other `outputs`, return parts of these widths.
        """
        features = self.of_time(encode(time.reshape(-1, 1), self.time_octaves))
        inputs = torch.cat([encode(positions, self.octaves), features.expand(len(positions), -1)], -1)
        # The outputs are read by several kernels; `collect_gradients` lets autograd run through the network only once.
        return collect_gradients(self.head(self.hidden(inputs)))[0].split(self.outputs, -1)

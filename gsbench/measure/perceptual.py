"""Compute LPIPS 0.1, the distance between the features of two images in a pretrained network (Zhang et al. 2018).

LPIPS multiplies squared differences of the features of a backbone (AlexNet or VGG16) by the learned weights of linear
layers. With the same backbone weights, results are bit-equal to those of the lpips package. That package is not
imported, because it needs torchvision and does not verify weights; only its linear layers are read from its files. The
backbone's weights come from a file whose SHA-256 is checked.
"""

import hashlib
import importlib.util
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from gsbench.errors import InputError, did_you_mean


class BackboneMissing(Exception):  # noqa: N818  # not an error: the column stays empty, and this is its reason
    """The weights of an LPIPS network are not on this machine; the message says which file is missing."""


def _alexnet() -> nn.Sequential:
    """Return the convolutional layers of torchvision's AlexNet, up to the last ReLU."""
    relu, pool = nn.ReLU(), nn.MaxPool2d(3, stride=2)
    return nn.Sequential(
        *(nn.Conv2d(3, 64, 11, stride=4, padding=2), relu, pool),
        *(nn.Conv2d(64, 192, 5, padding=2), relu, pool),
        *(nn.Conv2d(192, 384, 3, padding=1), relu),
        *(nn.Conv2d(384, 256, 3, padding=1), relu),
        *(nn.Conv2d(256, 256, 3, padding=1), relu),
    )


def _vgg16() -> nn.Sequential:
    """Return the convolutional layers of torchvision's VGG16, up to the last ReLU."""
    layers: list[nn.Module] = []
    last = 3
    for channels, count in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)):
        layers += [nn.MaxPool2d(2)] if layers else []
        for _ in range(count):
            layers += [nn.Conv2d(last, channels, 3, padding=1), nn.ReLU()]
            last = channels
    return nn.Sequential(*layers)


@dataclass(frozen=True)
class Backbone:
    """A pretrained network of LPIPS: its layers, the indices of the compared layers, and the SHA-256 of its weights."""

    trunk: Callable[[], nn.Sequential]
    taps: tuple[int, ...]  # the indices of the ReLU layers whose outputs are compared
    least_side: int  # pixels; the pooling layers reduce a smaller image to nothing
    file: str  # torchvision's file name, which ends in the first 8 digits of the weights' SHA-256
    linear_sha256: str  # the SHA-256 of the linear layers of lpips v0.1
    other_sha256: tuple[str, ...] = ()  # the SHA-256 of other files with the same weights

    @property
    def trunk_sha256(self) -> tuple[str, ...]:
        """Return the SHA-256 (or its first digits) of each weight file that is accepted for this backbone."""
        return (Path(self.file).stem.rsplit("-", 1)[1], *self.other_sha256)


BACKBONES = {
    "alex": Backbone(
        trunk=_alexnet,
        taps=(1, 4, 7, 9, 11),
        least_side=31,
        file="alexnet-owt-7be5be79.pth",
        linear_sha256="df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
        # the same weights without the classifier, as float32 arrays: alexnet_features_torchvision_f32.npz
        other_sha256=("e762b28a0489ca1b9a809bcf1fc6d82b9310cd77ff6c495d057dc8811994eab4",),
    ),
    "vgg": Backbone(
        trunk=_vgg16,
        taps=(3, 8, 15, 22, 29),
        least_side=16,
        file="vgg16-397923af.pth",
        linear_sha256="a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868",
    ),
}


class Perceptual(nn.Module):
    """LPIPS with one backbone, whose weights are named as `0.weight`, and five linear layers of [1, C, 1, 1]."""

    shift: Tensor
    scale: Tensor

    def __init__(self, backbone: Backbone, trunk: Mapping[str, Tensor], linear: list[Tensor]) -> None:
        super().__init__()
        self.trunk = backbone.trunk()
        self.trunk.load_state_dict(trunk)
        self.taps = backbone.taps
        self.linear = nn.ParameterList(linear)
        # ImageNet's means and standard deviations, of images in [-1, 1]
        self.register_buffer("shift", torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1))
        self.register_buffer("scale", torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1))
        self.requires_grad_(False)

    def features(self, images: Tensor) -> list[Tensor]:  # [B, 3, H, W] in [-1, 1]
        """Return the features of the compared layers, normalised to unit length at each pixel."""
        tapped = []
        x = (images - self.shift) / self.scale
        for i, layer in enumerate(self.trunk):
            x = layer(x)
            if i in self.taps:
                tapped.append(x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10))  # as in the lpips package
        return tapped

    def forward(self, a: Tensor, b: Tensor) -> Tensor:  # [B, 3, H, W] in [-1, 1], each
        """Return the LPIPS distances [B] of B image pairs (Zhang et al. 2018, eq. 1)."""
        distance = torch.zeros(len(a), 1, 1, 1, device=a.device)
        for fa, fb, weight in zip(self.features(a), self.features(b), self.linear, strict=True):
            distance = distance + F.conv2d((fa - fb) ** 2, weight).mean((2, 3), keepdim=True)
        return distance.flatten()


@cache
def load(backbone: str = "alex", weights: Path | None = None, device: str = "cpu") -> Perceptual:
    """Load an LPIPS network; a second call with the same arguments returns the same network.

    The backbone's weights come from the file `weights`, or else from torchvision's file in
    `$TORCH_HOME/hub/checkpoints`.

    Raises:
        BackboneMissing: `weights` is None and torchvision's file does not exist, or the lpips package is not installed.
        InputError: the backbone is unknown, the file `weights` does not exist, or a file has the wrong SHA-256.
    """
    if backbone not in BACKBONES:
        raise InputError(f"lpips: unknown backbone '{backbone}'. {did_you_mean(backbone, BACKBONES)}")
    chosen = BACKBONES[backbone]
    package = importlib.util.find_spec("lpips")
    if package is None or package.origin is None:
        raise BackboneMissing("needs the lpips package, which holds the linear weights")
    linear_path = Path(package.origin).parent / "weights" / "v0.1" / f"{backbone}.pth"
    path = weights or _trunk(backbone)
    if not path.is_file():
        if weights is not None:
            raise InputError(
                f"{path}: expected the weights of LPIPS' {backbone} trunk, found no such file", docs="data.md#fetching"
            )
        raise BackboneMissing(f"needs weights: `python -m gsbench.fetch lpips-{backbone}`")
    trunk = {
        key.removeprefix("features."): value
        for key, value in _read_weights(path, chosen.trunk_sha256).items()
        if key.startswith("features.")  # not torchvision's classifier
    }
    linear = _read_weights(linear_path, (chosen.linear_sha256,))
    return Perceptual(chosen, trunk, [linear[f"lin{i}.model.1.weight"] for i in range(len(chosen.taps))]).to(device)


def is_here(backbone: str, weights: Path | None = None) -> bool:
    """Return whether the weights of a backbone are on this machine, without checking their SHA-256."""
    return importlib.util.find_spec("lpips") is not None and (weights or _trunk(backbone)).is_file()


def _trunk(backbone: str) -> Path:
    """Return the path at which torchvision stores the weights of a backbone."""
    return Path(torch.hub.get_dir()) / "checkpoints" / BACKBONES[backbone].file


def _read_weights(path: Path, accepted: tuple[str, ...]) -> dict[str, Tensor]:
    """Read the tensors of a .pth or .npz file.

    Raises:
        InputError: the SHA-256 of the file does not begin with one of `accepted`.
    """
    data = path.read_bytes()
    sha256 = hashlib.sha256(data).hexdigest()
    if not sha256.startswith(accepted):
        raise InputError(
            f"{path}: expected SHA-256 {' or '.join(a[:8] + '...' for a in accepted)}, got {sha256[:8]}...; "
            "the file is damaged or other weights: fetch it again"
        )
    if path.suffix == ".npz":
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            return {key: torch.from_numpy(arrays[key]) for key in arrays}
    tensors: dict[str, Tensor] = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    return tensors

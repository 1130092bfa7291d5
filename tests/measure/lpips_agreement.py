"""Run by test_quality.py in a process of its own: the real lpips package against ours on one random trunk.

``import lpips`` imports torchvision for the layers of its trunks, and torchvision's wheel fails on CPU builds of torch.
There, a stand-in gives lpips the same layers, copied from torchvision's layout; all the rest is lpips' own code.
"""

import sys
import types

import torch
from torch import nn

from gsbench.measure.perceptual import BACKBONES, Perceptual


def alexnet(pretrained: bool) -> types.SimpleNamespace:
    assert not pretrained
    features = nn.Sequential(
        nn.Conv2d(3, 64, kernel_size=11, stride=4, padding=2),
        nn.ReLU(inplace=True),
        nn.MaxPool2d(kernel_size=3, stride=2),
        nn.Conv2d(64, 192, kernel_size=5, padding=2),
        nn.ReLU(inplace=True),
        nn.MaxPool2d(kernel_size=3, stride=2),
        nn.Conv2d(192, 384, kernel_size=3, padding=1),
        nn.ReLU(inplace=True),
        nn.Conv2d(384, 256, kernel_size=3, padding=1),
        nn.ReLU(inplace=True),
        nn.Conv2d(256, 256, kernel_size=3, padding=1),
        nn.ReLU(inplace=True),
        nn.MaxPool2d(kernel_size=3, stride=2),
    )
    return types.SimpleNamespace(features=features)


def vgg16(pretrained: bool) -> types.SimpleNamespace:
    assert not pretrained
    layers: list[nn.Module] = []
    last = 3
    for v in [64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512, "M", 512, 512, 512, "M"]:
        if v == "M":
            layers.append(nn.MaxPool2d(kernel_size=2, stride=2))
        else:
            layers += [nn.Conv2d(last, v, kernel_size=3, padding=1), nn.ReLU(inplace=True)]
            last = v
    return types.SimpleNamespace(features=nn.Sequential(*layers))


def import_lpips() -> types.ModuleType:
    """The real lpips, on the real torchvision where that imports."""
    try:
        import torchvision  # noqa: F401
    except (ImportError, RuntimeError):
        for name in [name for name in sys.modules if name.split(".")[0] == "torchvision"]:
            del sys.modules[name]
        stand_in = types.ModuleType("torchvision")
        stand_in.models = types.ModuleType("torchvision.models")
        stand_in.models.alexnet, stand_in.models.vgg16 = alexnet, vgg16
        sys.modules |= {"torchvision": stand_in, "torchvision.models": stand_in.models}
    import lpips

    return lpips


def compare(lpips: types.ModuleType, backbone: str) -> None:
    """Equal to the last bit, on images whose sides the strides do not divide, too."""
    published = lpips.LPIPS(net=backbone, pnet_rand=True, verbose=False)
    # their keys are net.slice2.3.weight, where 3 is the layer's number in the trunk
    trunk = {".".join(key.split(".")[-2:]): value for key, value in published.net.state_dict().items()}
    linear = [getattr(published, f"lin{i}").model[1].weight.detach() for i in range(5)]
    ours = Perceptual(BACKBONES[backbone], trunk, linear)
    for shape in ((2, 3, 64, 64), (1, 3, 37, 53)):
        a, b = torch.rand(shape) * 2 - 1, torch.rand(shape) * 2 - 1
        with torch.no_grad():
            expected = published(a, b).flatten()
            assert (expected > 1e-6).all()
            assert torch.equal(ours(a, b), expected), (backbone, shape, ours(a, b), expected)


if __name__ == "__main__":
    torch.manual_seed(0)
    package = import_lpips()
    for name in ("alex", "vgg"):
        compare(package, name)
    print("agree")

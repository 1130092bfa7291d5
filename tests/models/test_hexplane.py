"""4DGaussians: its equations by vectors of an independent numpy program, its warm-up, its penalty, bits and rows."""

import math
from typing import Any

import torch
from small import CAMERA, DIGITS, doubles, layer_of_the_vectors, lively, seeded
from tiny_training import trainer
from torch import Tensor
from torch.nn.functional import normalize

from gsbench.models import CameraTime
from gsbench.models.appearance import sh_colors
from gsbench.models.factors import sizes
from gsbench.models.hexplane import Network, Planes
from gsbench.schedule import ActiveComponents
from gsbench.view.slice_ply import harmonics_at

FULL = ActiveComponents(3, False, False)
QUERY = CameraTime.at(CAMERA, 0.25)


POSITION, TIME = doubles(0.2, 0.5, 1)[None], doubles(0.25)[0]
FEATURES = doubles(0.00920011, 0.01193819, 0.01502319, 0.01906886)
CHANGES = doubles(
    *(0.15831827, 0.14810943, 0.13868341, 0.07187866, 0.07128625, 0.07138002),
    *(0.09128860, 0.07279905, 0.04956811, 0.02206824, -0.00492522),
)


def planes_of_the_vectors(levels: int = 2) -> Planes:
    """Planes of two levels and channels with 0.3 + 0.05 i + 0.02 c + 0.03 r - 0.01 k + 0.002 r k (1 + l)."""
    planes = Planes(
        torch.stack([doubles(1, 0, 1.5), doubles(-1, 2, -0.5)]), (3, 4, 5, 4), levels, 2, seeded(0)
    ).double()
    for number, level in enumerate(planes.levels()):
        for i, axes in enumerate(("xy", "xz", "xt", "yz", "yt", "zt")):
            r, k, c = torch.meshgrid(*[torch.arange(n).double() for n in level[axes].shape], indexing="ij")
            level[axes].data.copy_(0.3 + 0.05 * i + 0.02 * c + 0.03 * r - 0.01 * k + 0.002 * r * k * (1 + number))
    return planes


def network_of_the_vectors(*further: int) -> Network:
    network: Any = Network(4, 8, [3, 3, 4, 1, *further], seeded(0)).double()
    for number, layer in enumerate([network.first, *(head[i] for head in network.heads for i in (0, 1))]):
        layer.weight.data, layer.bias.data = layer_of_the_vectors(number, *layer.weight.shape)
    return network


def test_the_features_of_planes():
    """Catches rows for columns, another order of axes, levels or corners, a time in [-1, 1], and a sum of planes."""
    planes = planes_of_the_vectors()
    torch.testing.assert_close(planes(POSITION, TIME).detach()[0], FEATURES, **DIGITS)


def test_the_network():
    """Catches a lost or further layer or ReLU, heads in another order, and a hidden layer of another head."""
    network = network_of_the_vectors()
    torch.testing.assert_close(network(FEATURES[None]).detach()[0], CHANGES, rtol=0, atol=1e-8)
    features = torch.randn(20, 4, generator=seeded(0)).double()  # those of the vectors pass every ReLU

    def layer(x: Tensor, of: Any) -> Tensor:
        return x @ of.weight.mT + of.bias

    hidden = layer(features, network.first).relu()
    heads: Any = network.heads
    expected = torch.cat([layer(layer(hidden, first).relu(), last) for first, last in heads], -1)
    torch.testing.assert_close(network(features), expected)


def test_a_changed_gaussian():
    """Catches scales changed after the exp, a quaternion normalised before the sum, and colours that do not change."""
    model: Any = lively("hexplane", 4, appearance=True)
    model.set_active(FULL)
    model.select(torch.arange(1))
    model.planes, model.network = planes_of_the_vectors(), network_of_the_vectors(48)
    model.splats["opacities"].data = doubles(-1.2)
    model.splats["means"].data = POSITION
    model.splats["scales"].data = doubles(0.01, 0.02, 0.03).log()[None]
    model.splats["quats"].data = doubles(0.9, 0.1, -0.2, 0.3)[None]
    changed = model.refined(QUERY)
    torch.testing.assert_close(changed["means"].detach(), POSITION + CHANGES[:3], **DIGITS)
    torch.testing.assert_close(
        sizes(changed["scales"]).detach()[0], doubles(0.01074525, 0.02147777, 0.03221968), **DIGITS
    )
    quaternion = doubles(0.92888720, 0.16192139, -0.14096223, 0.30179411)
    torch.testing.assert_close(normalize(changed["quats"], dim=-1).detach()[0], quaternion, **DIGITS)
    sliced = model.slice(QUERY)
    assert torch.equal(sliced.means, changed["means"])
    torch.testing.assert_close(sliced.factors, model.factors(changed))
    torch.testing.assert_close(sliced.opacities.detach(), doubles(0.23060021), **DIGITS)
    harmonics = torch.cat([changed["sh0"], changed["shN"]], 1)
    before = torch.cat([model.splats["sh0"], model.splats["shN"]], 1)
    of_field = model.network(model.planes(POSITION, TIME))[:, 11:]
    torch.testing.assert_close(harmonics - before, of_field.unflatten(1, (16, 3)))
    torch.testing.assert_close(sliced.colors, sh_colors(harmonics, normalize(sliced.means - CAMERA, dim=-1), 3))
    assert torch.equal(harmonics_at(model, QUERY), harmonics)


def test_the_penalty():
    """Catches differences of another order or direction, space for time, and a mean over the planes or levels."""
    planes = planes_of_the_vectors(levels=1)
    for plane in planes.levels()[0].values():
        plane.data[1, 1] += 0.1
    terms = [planes.penalty(*weights).detach() for weights in torch.eye(3).tolist()]
    torch.testing.assert_close(torch.stack(terms), doubles(0.01805556, 0.01958333, 1.39691667), **DIGITS)
    both = planes_of_the_vectors()
    of_time = [plane for level in both.levels() for axes, plane in level.items() if "t" in axes]
    torch.testing.assert_close(both.penalty(0, 0, 1), sum((1 - plane).abs().mean() for plane in of_time))


def test_the_field_has_the_gradients_of_its_values():
    """Catches a lost or wrong derivative on the way from any number of the field, or a position, to the changes."""
    model: Any = lively("hexplane", 5, channels=2, resolution=3, width=3, appearance=True, sh_degree=1)
    fields = model.planes, model.network
    values = [
        x.detach().requires_grad_() for x in (model.splats["means"], *(p for f in fields for p in f.parameters()))
    ]
    names = [[name for name, _ in field.named_parameters()] for field in fields]
    assert names[0] == ["of_space", "of_time"]

    def changes(positions: Tensor, *values: Tensor) -> Tensor:
        planes = dict(zip(names[0], values, strict=False))
        network = dict(zip(names[1], values[len(names[0]) :], strict=True))
        features = torch.func.functional_call(fields[0], planes, (positions, TIME))
        return torch.func.functional_call(fields[1], network, (features,))

    assert torch.autograd.gradcheck(changes, values, fast_mode=True)


def test_points_in_a_plane_make_no_nan():
    """Catches a division by the box's width of zero, a gradient that is infinite there, and a crash at NaN."""
    points = torch.rand(20, 3, generator=seeded(0)) * torch.tensor([1.0, 1.0, 0.0])
    planes = Planes(points, (4, 4, 4, 4), 1, 2, seeded(1))
    positions = torch.cat([points, points + 1, torch.full((1, 3), math.nan)]).requires_grad_()
    planes.products(positions).sum().backward()
    assert positions.grad is not None
    assert positions.grad.isfinite().all()


def test_a_step_adds_the_gradient_of_the_penalty_once():
    """Catches a penalty of each view, whose sum grows with the batch, and a repeated step that adds it twice."""
    gradients = []
    for weights in ([0.0] * 3, [3.0, 5.0, 7.0]):
        fitted = trainer("hexplane", "train.batch_size=3")
        model: Any = fitted.model
        model.weights = weights
        model.set_active(FULL)
        for _ in range(4):
            fitted.gradients(fitted.scene.train[:3])
        gradients.append([plane.grad.clone() for plane in model.planes.parameters()])
    alone = torch.autograd.grad(model.penalty(), list(model.planes.parameters()))
    for without, added, expected in zip(*gradients, alone, strict=True):
        torch.testing.assert_close(added, without + expected)


def test_views_of_a_step_share_what_time_does_not_change(monkeypatch):
    """Catches samples in space that each view takes anew, and gradients of them that are lost or counted twice."""
    gradients = []
    for share, expected in ((True, 1), (False, 3)):
        fitted = trainer("hexplane", "train.batch_size=3")
        model: Any = fitted.model
        model.set_active(FULL)
        samples, calls = model.planes.products, []
        monkeypatch.setattr(model.planes, "products", lambda x, of=samples, to=calls: (to.append(1), of(x))[1])
        if not share:
            monkeypatch.setattr(model, "shared_by_views", list)
        fitted.gradients(fitted.scene.train[:3])
        assert len(calls) == expected
        gradients.append([x.grad.clone() for x in model.parameters()])
    torch.testing.assert_close(*gradients)

"""Deformable-3DGS: its equations by vectors of an independent numpy program, its warm-up, its bits and its rows."""

from typing import Any

import pytest
import torch
from small import CAMERA, DIGITS, covariances, doubles, layer_of_the_vectors, lively, seeded
from tiny_training import trainer
from torch import Tensor

from gsbench.models import CameraTime
from gsbench.models.deformable import DeformationField, encode
from gsbench.models.render import render
from gsbench.schedule import ActiveComponents

WARM, FULL = (ActiveComponents(3, False, False, warms_up=warms_up) for warms_up in (True, False))
QUERY = CameraTime.at(CAMERA, 0.45)
POSITION, TIME = torch.tensor([[0.3, -0.7, 1.1]], dtype=torch.float64), torch.tensor(0.37, dtype=torch.float64)


def test_the_encoding():
    """Catches a factor of pi, another order of sine and cosine or of octaves and coordinates, and a lost input."""
    e, moment = encode(POSITION, 10)[0], encode(TIME.reshape(1, 1), 6)[0]
    assert len(e) == 63
    torch.testing.assert_close(e.sum(), doubles(1.65865932)[0], **DIGITS)
    first = doubles(0.3, -0.7, 1.1, 0.29552021, -0.64421769, 0.89120736, 0.95533649, 0.76484219, 0.45359612)
    torch.testing.assert_close(e[:9], first, **DIGITS)
    last = doubles(0.33163868, -0.25557025, -0.75451514, -0.94340648, 0.96679049, -0.65628264)
    torch.testing.assert_close(e[57:], last, **DIGITS)
    low = (0.37, 0.36161543, 0.93232735, 0.67428791, 0.73846856, 0.99588084, 0.09067162)
    high = (0.18059627, -0.98355731, -0.35525356, 0.93476998, -0.66416072, 0.74758982)
    torch.testing.assert_close(moment, doubles(*low, *high), **DIGITS)


def test_the_field():
    """Catches a layer that is lost or applied twice, a second input at another layer or in another order, a lost or
    further ReLU, and outputs in another order."""
    field = DeformationField(16, 8, 10, 6, True, seeded(0)).double()
    numbered = dict(enumerate(field.hidden.layers)) | {20: field.of_time[0], 21: field.of_time[1]}
    for number, layer in numbered.items():
        layer.weight.data, layer.bias.data = layer_of_the_vectors(number, *layer.weight.shape)
    for number, rows in ((10, slice(0, 3)), (11, slice(3, 6)), (12, slice(6, 10))):  # three layers of the vectors
        field.head.weight.data[rows], field.head.bias.data[rows] = layer_of_the_vectors(
            number, rows.stop - rows.start, 16
        )
    assert numbered[5].weight.shape == (16, 63 + 30 + 16)
    dp, ds, dr = (x.detach()[0] for x in field(POSITION, TIME))
    torch.testing.assert_close(dp, doubles(0.03395743, 0.06298777, 0.09373157), **DIGITS)
    torch.testing.assert_close(ds, doubles(0.13548246, 0.16466952, 0.19070848), **DIGITS)
    torch.testing.assert_close(dr, doubles(0.21849707, 0.23231325, 0.23959552, 0.24012182), **DIGITS)


class Constant(torch.nn.Module):
    """A field that says the same of every Gaussian at all times."""

    def __init__(self, dp: Tensor, ds: Tensor, dr: Tensor) -> None:
        super().__init__()
        self.outputs = dp, ds, dr

    def forward(self, positions: Tensor, time: Tensor) -> list[Tensor]:
        return [x.expand(len(positions), -1) for x in self.outputs]


def deformed(scales: Tensor, ds: Tensor) -> Any:
    """A Gaussian with the quaternion and the changes of the vectors, and other scales."""
    model: Any = lively("deformable", 4)
    model.select(torch.arange(1))
    model.splats["scales"].data = scales.log()[None]
    model.splats["quats"].data = 3 * doubles(0.9, 0.1, -0.2, 0.3)[None]
    model.field = Constant(doubles(0.1, 0.2, 0.3), ds, doubles(0.05, 0.02, -0.03, 0.04))
    return model


def test_a_deformed_gaussian():
    """Catches scales that change before the exp, and a quaternion that is normalised only before or after the sum."""
    model = deformed(doubles(0.05, 0.1, 0.2), doubles(0.01, -0.02, 0.03))
    sliced = model.slice(QUERY)
    xx, xy, xz, yy, yz, zz = 0.01004320, 0.00432286, -0.01425650, 0.01137400, -0.01512290, 0.04148279
    expected = torch.stack([doubles(xx, xy, xz), doubles(xy, yy, yz), doubles(xz, yz, zz)])
    torch.testing.assert_close(covariances(sliced)[0], expected, **DIGITS)
    torch.testing.assert_close(sliced.means - model.splats["means"], doubles(0.1, 0.2, 0.3)[None])
    torch.testing.assert_close(sliced.opacities, torch.sigmoid(model.splats["opacities"]))


def test_a_scale_may_be_negative_or_zero():
    """Catches a scale that is clipped at 0, where it would learn no more, and NaN in an image or a gradient at 0."""
    positive, negative, flat = (deformed(doubles(1, 0.1, 0.2), doubles(x, 0, 0)) for x in (-0.9, -1.1, -1.0))
    assert not flat.slice(QUERY).factors[:, :, 0].any()
    torch.testing.assert_close(covariances(positive.slice(QUERY)), covariances(negative.slice(QUERY)))
    camera = trainer("deformable").scene.train[0].camera
    for model in (negative.float(), flat.float()):
        model.splats["means"].data.zero_()
        model.field.outputs = tuple(x.float().requires_grad_() for x in model.field.outputs)
        render(model, camera, 0.45, torch.zeros(3)).sum().backward()
        gradients = [x.grad for x in (*model.splats.values(), *model.field.outputs)]
        assert all(x is not None and x.isfinite().all() for x in gradients)
    assert negative.field.outputs[1].grad.all()


@pytest.mark.parametrize(("depth", "time_network"), [(1, True), (3, False)])
def test_the_field_has_the_gradients_of_its_values(depth, time_network):
    """Catches a lost or wrong derivative on the way from any weight to the outputs (central differences), a time
    network that is never left out, and a gradient of a mean through the field."""
    model: Any = lively("deformable", 5, width=3, depth=depth, octaves=2, time_octaves=1, time_network=time_network)
    model.set_active(FULL)
    names = [name for name, _ in model.field.named_parameters()]
    assert len(names) == 2 * (2 * time_network + depth + 1)

    def sliced(*values: Tensor) -> list[Tensor]:
        field = dict(zip(names, values, strict=True))
        positions = model.splats["means"].detach()
        return list(torch.func.functional_call(model.field, field, (positions, torch.tensor(0.45).double())))

    assert torch.autograd.gradcheck(sliced, [x.detach().requires_grad_() for x in model.field.parameters()])
    model.slice(QUERY).means.sum().backward()
    torch.testing.assert_close(model.splats["means"].grad, torch.ones(5, 3).double())  # none through the field
    assert all(x.grad.any() for x in model.field.parameters())

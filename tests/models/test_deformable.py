"""Deformable-3DGS: its equations by vectors of an independent numpy program, its warm-up, its bits and its rows."""

import copy
import math
from typing import Any

import pytest
import torch
from interrupted import assert_resumes, assert_same_bits
from small import CAMERA, covariances, fresh, lively, raw, same, seeded
from tiny_training import train, trainer
from torch import Tensor

from gsbench.models import CameraTime
from gsbench.models.deformable import DeformationField, encode
from gsbench.models.gaussian_batch import tensors_of
from gsbench.models.render import render
from gsbench.schedule import ActiveComponents
from gsbench.train.checkpoint import without_times

WARM, FULL = (ActiveComponents(3, False, False, warms_up=warms_up) for warms_up in (True, False))
QUERY = CameraTime.at(CAMERA, 0.45)
DIGITS = {"rtol": 0, "atol": 5.001e-9}  # of the vectors, which have eight digits
POSITION, TIME = torch.tensor([[0.3, -0.7, 1.1]], dtype=torch.float64), torch.tensor(0.37, dtype=torch.float64)


def doubles(*numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


# ---- the equations


def test_the_encoding() -> None:
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


def weights_of(layer: int, rows: int, columns: int) -> tuple[Tensor, Tensor]:
    """The weights [rows, columns] and the bias [rows] that the vectors have in a layer, by its number."""
    i, j = torch.arange(rows, dtype=torch.float64), torch.arange(columns, dtype=torch.float64)
    weight = torch.sin(0.37 * layer + 0.11 * i[:, None] + 0.23 * j) / math.sqrt(columns)
    return weight, 0.05 * torch.cos(layer + 0.3 * i)


def test_the_field() -> None:
    """Catches a layer that is lost or applied twice, a second input at another layer or in another order, a lost or
    further ReLU, and outputs in another order."""
    field = DeformationField(16, 8, 10, 6, True, seeded(0)).double()
    numbered = dict(enumerate(field.hidden.layers)) | {20: field.of_time[0], 21: field.of_time[1]}
    for number, layer in numbered.items():
        for parameter, values in zip((layer.weight, layer.bias), weights_of(number, *layer.weight.shape), strict=True):
            parameter.data.copy_(values)  # of equal shape
    for number, rows in ((10, slice(0, 3)), (11, slice(3, 6)), (12, slice(6, 10))):  # three layers of the vectors
        field.head.weight.data[rows], field.head.bias.data[rows] = weights_of(number, rows.stop - rows.start, 16)
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


def test_a_deformed_gaussian() -> None:
    """Catches scales that change before the exp, and a quaternion that is normalised only before or after the sum."""
    model = deformed(doubles(0.05, 0.1, 0.2), doubles(0.01, -0.02, 0.03))
    sliced = model.slice(QUERY)
    xx, xy, xz, yy, yz, zz = 0.01004320, 0.00432286, -0.01425650, 0.01137400, -0.01512290, 0.04148279
    expected = torch.stack([doubles(xx, xy, xz), doubles(xy, yy, yz), doubles(xz, yz, zz)])
    torch.testing.assert_close(covariances(sliced)[0], expected, **DIGITS)
    torch.testing.assert_close(sliced.means - model.splats["means"], doubles(0.1, 0.2, 0.3)[None])
    torch.testing.assert_close(sliced.opacities, torch.sigmoid(model.splats["opacities"]))


def test_a_scale_may_be_negative_or_zero() -> None:
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


# ---- gradients


@pytest.mark.parametrize(("depth", "time_network"), [(1, True), (3, False)])
def test_the_field_has_the_gradients_of_its_values(depth: int, time_network: bool) -> None:
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


# ---- the warm-up


def test_the_field_waits_for_the_end_of_the_warm_up() -> None:
    """Catches a field that acts or learns in the warm-up, or never, and a warm-up of another share than 3,000 of 40,000
    steps."""
    fitted = trainer("deformable", "train.iterations=40")
    model: Any = fitted.model
    before, camera = copy.deepcopy(model.field.state_dict()), fitted.scene.train[0].camera

    def image(time: float) -> Tensor:
        return render(model, camera, time, torch.zeros(3)).detach()

    train(fitted, until=3)
    assert same(before, model.field.state_dict())
    assert model.active.warms_up
    assert torch.equal(image(0.1), image(0.9))
    train(fitted, until=4)
    assert not model.active.warms_up
    assert not any(torch.equal(x, y) for x, y in zip(before.values(), model.field.state_dict().values(), strict=True))
    assert not torch.equal(image(0.1), image(0.9))


# ---- checkpoints, rows, bits


def test_a_training_goes_on_from_its_checkpoint() -> None:
    """Catches weights or moments of the field that a checkpoint lacks: the image of a loaded model is another one."""
    whole, _ = assert_resumes(lambda: trainer("deformable"), 30)
    loaded = trainer("deformable", "seed=1")
    loaded.load_state_dict(whole.state_dict())
    view = whole.scene.train[3]
    assert torch.equal(whole.render(view), loaded.render(view))


def test_clones_and_children_are_canonical_and_share_the_field() -> None:
    """Catches children drawn from the deformed Gaussian, which the field would deform twice, and rows of the field."""
    model, plain = (fresh(name, 40) for name in ("deformable", "3dgs"))
    weights, rows = copy.deepcopy(model.field.state_dict()), torch.arange(40).repeat_interleave(2)
    before = model.slice(CameraTime.at(CAMERA.float(), 0.45))
    for each in (model, plain):
        each.select(rows)
    cloned = model.slice(CameraTime.at(CAMERA.float(), 0.45))
    for x, y in zip(tensors_of(before), tensors_of(cloned), strict=True):
        torch.testing.assert_close(x[rows], y)
    for each in (model, plain):
        each.split_rows(torch.arange(80), seeded(1))
    assert same(raw(model), raw(plain))
    assert same(weights, model.field.state_dict())


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("model", ["deformable", "hexplane", "scgs"])
def test_a_field_trains_to_the_same_bits_for_any_number_of_threads(model: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a repetition of a recorded step, or a penalty, that uses all threads, only felt with one view."""
    monkeypatch.setattr("gsbench.train.step.WORTH_A_THREAD", 0)
    ends = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        ends.append(without_times(train(trainer(model, "train.batch_size=1")).state_dict()))
    assert_same_bits(*ends)

"""SC-GS: its equations by vectors of an independent numpy program, its nodes, its penalty, its warm-up and its rows."""

from typing import Any

import pytest
import torch
from scipy.spatial.transform import Rotation
from small import CAMERA, DIGITS, doubles, fresh, lively, seeded
from torch import Tensor, nn

from gsbench.models import CameraTime
from gsbench.models.factors import rotation, sizes
from gsbench.models.scgs import Nodes, stretch
from gsbench.schedule import ActiveComponents

FULL = ActiveComponents(3, False, False)
QUERY = CameraTime.at(CAMERA, 0.45)


POSITION, FEATURES = doubles(0.4, 0.3, 0.2)[None], doubles(-1e-2, 0)[None]
WEIGHTS = doubles(0.35802218, 0.40319289, 0.23878493)


def nodes_of_the_vectors() -> Nodes:
    """Five nodes, with two features instead of eight."""
    values = {
        "positions": [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.5], [2, 2, 2]],
        "features": [[1e-2, 1e-2], [1e-2, -1e-2], [2e-2, 1e-2], [0, 1e-2], [1e-2, 0]],
        "log_radii": doubles(0.5, 0.6, 0.7, 0.5, 0.9).log().tolist(),
        "logits": [0.0, 0.5, -0.5, 0.2, 0.0],
    }
    nodes = Nodes(5).double()
    for name, value in values.items():
        nodes.get_parameter(name).data = torch.tensor(value, dtype=torch.float64)
    return nodes


class Motion(nn.Module):
    """A field that says what the vectors have of every node, and sizes and quaternions beside them, at all times."""

    def __init__(self, *, turns: bool) -> None:
        super().__init__()
        shifts = doubles([0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.3], [-0.1, 0.1, 0], [0, 0, 0])
        local = doubles([0.02, 0.1, 0, 0], [0, 0, 0.2, 0], [0.01, 0, 0, -0.1], [0, 0.05, 0, 0], [0, 0, 0, 0])
        others = torch.rand(5, 3 + 4, generator=seeded(0)).double().split([3, 4], -1)
        self.outputs = [shifts, *others, turns * local]

    def forward(self, positions: Tensor, _: Tensor) -> list[Tensor]:
        return [x.repeat(len(positions) // 5, 1) for x in self.outputs]


def test_the_nearest_nodes_and_their_weights():
    """Catches a distance without features, a wrong power of a radius, a lost sigmoid, and weights of another sum."""
    near, weights = nodes_of_the_vectors().nearest(POSITION, FEATURES)
    assert near.tolist() == [[0, 1, 2]]
    torch.testing.assert_close(weights.detach()[0], WEIGHTS, **DIGITS)


@pytest.mark.parametrize(
    ("turns", "expected"),
    [(False, doubles(0.43580222, 0.38063858, 0.27163548)), (True, doubles(0.45079391, 0.34920235, 0.37797328))],
)
def test_a_gaussian_follows_its_nodes(turns, expected):
    """Catches nodes that only shift, turns around the origin in place of the node, a turn that is not beside the unit
    quaternion; sizes that change before the exp, and a quaternion that changes after it is normalised."""
    model: Any = lively("scgs", 4)
    model.select(torch.arange(1))
    model.set_active(FULL)
    model.nodes, model.field = nodes_of_the_vectors(), Motion(turns=turns)
    model.splats["means"].data, model.splats["features"].data = POSITION, FEATURES
    sliced = model.slice(QUERY)
    torch.testing.assert_close(sliced.means.detach()[0], expected, **DIGITS)
    _, ds, dr, _ = model.field.outputs
    R = rotation(model.splats["quats"] + WEIGHTS @ dr[:3])
    scales = sizes(model.splats["scales"]) + WEIGHTS @ ds[:3]
    torch.testing.assert_close(sliced.factors, R * scales[:, None], rtol=1e-6, atol=0)
    assert torch.equal(sliced.opacities, torch.sigmoid(model.splats["opacities"]))


def test_nodes_are_placed_far_from_each_other():
    """Catches the nearest point in place of the farthest, a radius of another range, and a crash with few points."""
    points = torch.rand(200, 3, generator=seeded(0)) * 2.6 - 1.3
    points[7], points[9] = torch.full((3,), 1.3), torch.full((3,), -1.3)
    nodes = Nodes(20)
    nodes.place(points)
    torch.testing.assert_close(nodes.log_radii.detach().double(), torch.full((20,), -1.34707326).double())
    placed = nodes.positions.detach()
    assert torch.equal(placed[0], points[0])
    for i in range(1, 20):
        distances = torch.cdist(points, placed[:i]).amin(1)
        torch.testing.assert_close(torch.cdist(placed[i : i + 1], placed[:i]).amin(), distances.max())
    nodes.place(points[:5])
    assert torch.equal(nodes.positions[5:], points[:1].expand(15, 3))
    assert len(set(map(tuple, nodes.positions.tolist()))) == 5


def test_the_field_starts_next_to_zero():
    """Catches a start as that of Deformable-3DGS, whose Gaussians jump, and one at zero, where no layer learns."""
    model: Any = fresh("scgs", width=64, depth=8)
    model.set_active(FULL)
    outputs = model.field(model.nodes.positions.detach(), torch.tensor(0.3))
    for values, size in zip(outputs, (1e-5, 1e-8, 1e-5, 1e-4), strict=True):
        assert size / 100 < values.detach().abs().mean() < size * 100
    weights = model.field.head.weight.detach().split([3, 3, 4, 4])
    for values, size in zip(weights, (1e-5, 1e-8, 1e-5, 1e-4), strict=True):
        assert values.std().item() == pytest.approx(size, rel=0.2)
    torch.testing.assert_close(
        model.slice(CameraTime.at(CAMERA.float(), 0.3)).means, model.splats["means"], atol=2e-3, rtol=0
    )


def test_a_rigid_motion_is_not_penalised():
    """Catches a rotation from the later time to the earlier one, and reflections taken for rotations."""
    points = torch.randn(30, 3, generator=seeded(0)).double()
    R = rotation(torch.randn(4, 4, generator=seeded(1)).double())  # at four times
    near = torch.randint(30, (30, 4), generator=seeded(2))
    weights = torch.rand(30, 4, generator=seeded(3)).double()
    paths = points @ R.mT + torch.randn(4, 1, 3, generator=seeded(4)).double()
    assert stretch(paths, near, weights) < 1e-24
    assert stretch(torch.stack([points, -points]), near, weights) > 0.1


def test_the_penalty_is_the_least_energy():
    """Catches lost weights, other neighbours or times, and a rotation that is not the best, which SciPy finds."""
    paths = torch.randn(3, 10, 3, generator=seeded(0)).double()
    near = torch.stack([torch.randperm(10, generator=seeded(i))[:5] for i in range(10)])
    weights = torch.rand(10, 5, generator=seeded(11)).double()
    energies = []
    for before, after in ((paths[0], paths[1]), (paths[1], paths[2])):
        for i in range(10):
            edges = [(x[near[i]] - x[i]).numpy() for x in (after, before)]
            energies.append(Rotation.align_vectors(*edges, weights[i].numpy())[1] ** 2)
    torch.testing.assert_close(stretch(paths, near, weights), torch.tensor(energies).double().mean())


def test_the_weight_of_the_penalty():
    """Catches a penalty in the warm-up, of the canonical nodes alone, or of weight zero that costs its time."""
    model: Any = lively("scgs", rigidity=0.5)
    model.set_active(FULL)
    half = model.penalty()
    model.rigidity = 0.25
    torch.testing.assert_close(model.penalty() * 2, half)
    half.backward()
    assert all(p.grad.any() for p in model.field.hidden.parameters())
    model.rigidity = 0
    assert model.penalty() is None
    model.rigidity = 0.5
    model.set_active(ActiveComponents(3, False, False, warms_up=True))
    assert model.penalty() is None


def test_field_and_nodes_have_the_gradients_of_their_values():
    """Catches a lost or wrong derivative on the way from any number of the field or a node to a slice or the penalty,
    and a gradient of a mean through the choice of its nodes."""
    model: Any = lively("scgs", 5, width=3, depth=2, octaves=1, time_octaves=1, nodes=6, rigidity=1.0)
    model.set_active(FULL)
    field = {f"field.{name}": x for name, x in model.field.named_parameters()}
    nodes = {f"nodes.{name}": x for name, x in model.nodes.named_parameters() if name != "positions"}

    class Both(nn.Module):
        """All that an image depends on, and the penalty."""

        def __init__(self) -> None:
            super().__init__()
            self.model = model

        def forward(self) -> tuple[Tensor, ...]:
            sliced = self.model.slice(QUERY)
            return sliced.means, sliced.factors, self.model.penalty()

    names = [f"model.{name}" for name in field | nodes]

    def outputs(*values: Tensor) -> Any:
        return torch.func.functional_call(Both(), dict(zip(names, values, strict=True)), ())

    values = [x.detach().requires_grad_() for x in (field | nodes).values()]
    assert torch.autograd.gradcheck(outputs, values, fast_mode=True)


def test_positions_of_nodes_learn_by_what_follows_them():
    """Catches a derivative by the position of a node that is lost or wrong where the field does not depend on it."""
    model: Any = lively("scgs", 5)
    model.set_active(FULL)
    model.nodes, model.field = nodes_of_the_vectors(), Motion(turns=True)
    model.splats["features"].data = model.splats["features"].data[:, :2]
    positions = model.nodes.positions
    del model.nodes.positions

    def means(x: Tensor) -> Tensor:
        model.nodes.positions = x
        return torch.cat([model.slice(QUERY).means.flatten(), 1e4 * model.penalty()[None]])

    assert torch.autograd.gradcheck(means, positions.detach().requires_grad_())

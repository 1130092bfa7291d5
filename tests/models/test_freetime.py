"""The gate of FreeTimeGS++ and SharpTimeGS against their equations."""

import math

import pytest
import torch
from small import CAMERA, N, active, with_effect_sets

from gsbench.models import CameraTime, build
from gsbench.models.freetime import permanent_share

QUERY = CameraTime.at(CAMERA, 0.7)


def test_a_share_of_an_opacity_lasts():
    """Catches another steepness, G in the place of 1 - G, and a penalty that pulls G down (FreeTimeGS++'s code)."""
    model = active("freetime_plus")
    G = permanent_share({"permanence": torch.tensor([[-1.0], [0.05]], dtype=torch.float64)})
    torch.testing.assert_close(G, torch.tensor([2.06115362e-9, 0.73105858], dtype=torch.float64), rtol=1e-8, atol=0)
    with torch.no_grad():
        model.splats["permanence"][:] = 0.05
        model.splats["times"][:] = 0.5
        model.splats["durations"][:] = math.log(0.2 / math.sqrt(-2 * math.log(0.3)))
    opacities = model.slice(QUERY).opacities / torch.sigmoid(model.splats["opacities"])
    expected = torch.full((N,), 0.81174101, dtype=torch.float64)
    torch.testing.assert_close(opacities.detach(), expected, rtol=0, atol=5.1e-9)
    assert model.penalty().item() == pytest.approx(1e-3 * (1 - 0.73105858))
    model.penalty().backward()
    assert (model.splats["permanence"].grad < 0).all()
    as_if = with_effect_sets(model, 0, N // 3)
    assert as_if.penalty().item() == pytest.approx(1e-3 * (1 - 0.73105858) / 3)


@pytest.mark.parametrize(
    ("time", "mean_time", "sigma", "r", "factor", "mean"),
    [
        (0.45, 0.4, 0.3, 0.1, 1.0, [0.31250000, -0.72500000, 1.10625000]),
        (0.9, 0.4, 0.3, 0.1, 0.16901332, [0.42500000, -0.95000000, 1.16250000]),
        (5.0, 2.0, 1.5, 2.0, 0.64118039, [0.41320755, -0.92641509, 1.15660377]),
    ],
)
def test_the_equations_of_sharptime(time, mean_time, sigma, r, factor, mean):
    """Catches a profile with 1/2 or without its flat top, and f of the text's first version, which begins at 1."""
    numbers = {"times": mean_time, "durations": math.log(sigma), "plateaus": math.log(r)}
    raw = {key: torch.tensor([[value]], dtype=torch.float64) for key, value in numbers.items()}
    raw |= {"velocities": torch.tensor([[0.5, -1.0, 0.25]], dtype=torch.float64)}
    query = CameraTime(torch.zeros(3), torch.tensor(time, dtype=torch.float64))
    shift, opacity_factor = build("sharptime").change(raw, query)
    place = [p + float(x) for p, x in zip((0.3, -0.7, 1.1), shift[0], strict=True)]
    assert [round(x, 8) for x in (float(opacity_factor), *place)] == [factor, *mean]


@pytest.mark.parametrize("distance", [-0.2, -0.099, -0.101, 0.0, 0.099, 0.101, 0.2])
@pytest.mark.parametrize("sigma", [0.3, 1.5])  # f is 2, and above
def test_the_gradients_of_sharptime(distance, sigma):
    """Catches a derivative that is lost or wrong on one side of |t - mu_t| = r = 0.1, or by f."""
    model = build("sharptime")
    numbers = {"times": 0.5, "durations": math.log(sigma), "plateaus": math.log(0.1)}
    values = [torch.tensor([[x]], dtype=torch.float64, requires_grad=True) for x in numbers.values()]
    values.append(torch.tensor([[0.5, -1.0, 0.25]], dtype=torch.float64, requires_grad=True))
    query = CameraTime(torch.zeros(3), torch.tensor(0.5 + distance, dtype=torch.float64))

    def change(*values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return model.change(dict(zip([*numbers, "velocities"], values, strict=True)), query)

    assert torch.autograd.gradcheck(change, values, eps=1e-5)

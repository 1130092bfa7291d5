"""What a simplification keeps of a Gaussian: the colours that it had on average, and the effect that was not frozen."""

import pytest
import torch
from small import CAMERA, fresh, lively, seeded

from gsbench.models import CameraTime
from gsbench.models.simplifications import shares_of, simplifications_of


@pytest.mark.parametrize("variant", ["3dgs", "4dgs"])
@torch.no_grad()
def test_fewer_harmonics_have_the_same_colour_on_average(variant: str) -> None:
    """Catches a constant colour that is not given what the cut harmonics were on average, weighted by opacities."""
    model = fresh(variant).double()
    g = seeded(3)
    model.splats["shN"] += 0.02 * torch.randn(model.splats["shN"].shape, generator=g, dtype=torch.float64)
    model.splats["sh0"] *= 0.5  # away from black, below which a colour is cut
    if variant == "4dgs":
        model.splats["scales"][:, 3] = 2.0  # seen at all times, and more at some than at others
    queries = [
        CameraTime.at(4 * torch.randn(3, generator=g, dtype=torch.float64), time) for time in (0.1, 0.4, 0.5, 0.9)
    ]
    seen = [model.slice(query) for query in queries]
    weights = shares_of([one.opacities for one in seen])
    assert min(float(one.colors.amin()) for one in seen) > 0
    simplifications = [one for one in simplifications_of(model, queries, seen) if one.order is not None]
    assert [simplification.order for simplification in simplifications] == model.lower_orders()
    for simplification in simplifications:
        raw = dict(model.splats.items()) | simplification.raw
        colors = torch.stack(
            [model.shade(raw, one.means, one.opacities, q) for q, one in zip(queries, seen, strict=True)]
        )
        change = colors - torch.stack([one.colors for one in seen])
        assert change.abs().amax() > 1e-3
        torch.testing.assert_close((weights[..., None] * change).sum(0), torch.zeros_like(change[0]), atol=1e-6, rtol=0)


@pytest.mark.parametrize("variant", ["7dgs", "7dgs_paper"])
def test_time_goes_on_as_it_did_where_direction_is_frozen(variant: str) -> None:
    """Catches f_temp by the deviation that t has at a known direction: frozen, direction is known no more."""
    model = lively(variant)
    raw = {name: x.detach() for name, x in model.splats.items()}
    early, late = (CameraTime.at(CAMERA, time) for time in (0.35, 0.6))
    frozen = model.frozen(raw, [early, late], torch.full((2, len(model)), 0.5, dtype=torch.float64))["direction"]

    def fades(raw: dict[str, torch.Tensor]) -> torch.Tensor:
        return model.slice_geometry(raw, late)[2] / model.slice_geometry(raw, early)[2]

    assert (fades(raw) - 1).abs().amax() > 0.1
    torch.testing.assert_close(fades(raw | frozen), fades(raw), rtol=1e-6, atol=0)

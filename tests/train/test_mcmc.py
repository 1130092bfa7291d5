"""Relocation as in 3DGS-MCMC: its sums, what it copies to where, its limit and its noise."""

import copy
import math
from fractions import Fraction

import pytest
import torch
from models.small import CAMERA, Moments, moved, started

from gsbench.config import DensifyConfig
from gsbench.models import CameraTime, GaussianModel, build
from gsbench.train.batches import generator
from gsbench.train.density.mcmc import MCMCDensification, drawn, relocated
from gsbench.train.rows import Rows

OPTIONS = {
    "3dgs": {},
    "4dgs": {},
    "6dgs": {"lambda_d": 0.35},
    "7dgs": {"lambda_t": 0.5, "lambda_d": 0.3},
    "ndgs": {"lambda_t": 0.5, "lambda_d": 0.5},
    "dgs": {},
    "freetime": {},
}


def rule(model: GaussianModel, noise: float = 0.0) -> tuple[MCMCDensification, Moments]:
    moments = Moments()
    return MCMCDensification(Rows(model, moments), DensifyConfig(noise=noise), 0.005, 10), moments


@pytest.mark.parametrize(
    ("o", "n", "new", "c"),
    [(0.9, 2, 0.6838, 0.8679), (0.5, 2, 0.2929, 0.9522), (0.5, 6, 0.1091, 0.9219), (0.1, 3, 0.0345, 0.9898)],
)
def test_the_sums_of_relocation(o, n, new, c):
    """Catches a binomial of the wrong row, a lost sign and sums in float32, with numbers computed elsewhere."""
    results = relocated(torch.tensor([o, 0.3]), torch.tensor([n, 1]))
    assert [float(x[0]) for x in results] == pytest.approx([new, c], abs=6e-5)
    assert [float(x[1]) for x in results] == pytest.approx([0.3, 1.0])


@pytest.mark.parametrize("o", [0.01, 0.9, 1 - 1e-6])
def test_many_copies_do_not_cancel(o):
    """Catches alternating sums that lose their digits at 51 copies: against the paper's double sum by fractions."""
    new, c = (float(x[0]) for x in relocated(torch.tensor([o], dtype=torch.float64), torch.tensor([51])))
    exact = Fraction(new)
    total = sum(
        Fraction(math.comb(i - 1, k)) * (-1) ** k * exact ** (k + 1) / Fraction(math.sqrt(k + 1))
        for i in range(1, 52)
        for k in range(i)
    )
    assert c == pytest.approx(o / float(total), rel=1e-9)


def test_rows_are_drawn_in_proportion():
    """Catches rows of weight zero that are drawn, and weights that are not proportions."""
    counts = drawn(torch.tensor([0.0, 1.0, 0.0, 3.0, 0.0]), 4000, generator(0)).bincount(minlength=5)
    assert counts[[0, 2, 4]].sum() == 0
    assert 0.72 < counts[3] / 4000 < 0.78


@pytest.mark.parametrize("name", OPTIONS)
def test_dead_gaussians_move_to_living_ones(name):
    """Catches copies that are not all of the source, a limit that is passed, and moments that stay with old rows."""
    model = moved(started(build(name, **OPTIONS[name]), 40))
    with torch.no_grad():
        model.splats["opacities"][:30] = torch.linspace(-2, 1, 30)  # logits
        model.splats["opacities"][30:] = -8.0  # dead
    before = copy.deepcopy(model.splats.state_dict())
    density, moments = rule(model)
    assert density.densify(generator(1), has_reset=False, most=41) == 0
    assert len(model) == 41  # 42 by growth
    assert (torch.sigmoid(model.splats["opacities"]) > 0.005).all()
    sources = [int((model.splats["means"][i] == before["means"]).all(1).nonzero()[0]) for i in range(41)]
    assert sources[:30] == list(range(30))
    assert all(s < 30 for s in sources)
    copied = torch.tensor(sources).bincount() > 1
    less = model.splats["opacities"][:30] < before["opacities"][:30]
    assert torch.equal(less, copied)
    assert torch.equal(model.splats["opacities"][:30][~copied], before["opacities"][:30][~copied])
    assert moments.fresh[40]  # of the last call, the growth
    sh0 = model.splats["sh0"].detach()
    assert torch.equal(sh0, before["sh0"][sources])


@pytest.mark.parametrize("name", OPTIONS)
def test_shrinking_keeps_position_and_life(name):
    """Catches a factor that also changes how a slice moves or fades, or a covariance that is not smaller by c^2."""
    model = started(build(name, **OPTIONS[name])).double()
    model = model if name == "4dgs" else moved(model)  # 4DGS: exact where rotations mix no time, as at the start
    queries = [CameraTime.at(CAMERA, time) for time in (0.2, 0.6)]
    before = [model.slice(query) for query in queries]
    model.shrink_rows(torch.tensor([3, 5]), torch.tensor([0.9, 0.7], dtype=torch.float64))
    factor = torch.ones(len(model), 1, 1, dtype=torch.float64)
    factor[3], factor[5] = 0.81, 0.49
    for query, old in zip(queries, before, strict=True):
        new = model.slice(query)
        torch.testing.assert_close(new.opacities, old.opacities)
        torch.testing.assert_close(new.means, old.means)
        torch.testing.assert_close(new.factors @ new.factors.mT, factor * (old.factors @ old.factors.mT))


@pytest.mark.parametrize("name", OPTIONS)
def test_noise_is_of_the_covariance_and_of_the_transparent(name):
    """Catches noise on Gaussians that are seen, of another shape than theirs, or without the rate of the means."""
    model = started(build(name, **OPTIONS[name]), 4000).double()
    with torch.no_grad():
        model.splats["opacities"][:2000] = -9.0
        model.splats["opacities"][2000:] = 0.0
        sizes, space = ("scales", [0, 1, 2]) if "scales" in model.splats else ("log_diagonal", model.rows["p"])
        model.splats[sizes][:, space] = torch.tensor([0.1, 0.2, 0.4], dtype=torch.float64).log()
    before = model.splats["means"].detach().clone()
    density, _ = rule(model, noise=10.0)
    assert density.adds_noise
    density.add_noise(0.5, generator(2))
    moved_by = model.splats["means"].detach() - before
    assert moved_by[2000:].abs().max() < 1e-9
    share = 1 / (1 + math.exp(100 * (1 / (1 + math.exp(9.0)) - 0.005)))
    expected = torch.tensor([0.01, 0.04, 0.16], dtype=torch.float64) * 5.0 * share
    torch.testing.assert_close(moved_by[:2000].std(0), expected, rtol=0.1, atol=0)
    assert not rule(model, noise=0.0)[0].adds_noise

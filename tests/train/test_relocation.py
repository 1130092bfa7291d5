"""Relocation as in FreeTimeGS: its score, who moves to whom, and a training that is interrupted between two rounds."""

import pytest
import torch
from interrupted import assert_resumes
from models.small import Moments, moved, started
from test_mcmc import OPTIONS
from tiny_training import train, trainer

from gsbench.config import DensifyConfig
from gsbench.models import build
from gsbench.train.batches import generator
from gsbench.train.density.mcmc import opacities_of, relocated
from gsbench.train.density.relocation import RelocationDensification, score
from gsbench.train.rows import Rows

ROUNDS = (
    *("train.densify.kind=relocation", "train.densify.start=0", "train.densify.stop=50", "train.densify.every=10"),
    *("train.iterations=60", "train.recipe_iterations=60", "model.min_opacity=0.09"),
)


def test_the_score_of_freetimegs():
    """Catches sums over living rows alone, and weights other than one and one."""
    opacities, gradient = torch.tensor([[0.9, 0.004, 0.3, 0.6], [2e-4, 5e-5, 4e-4, 0.0]], dtype=torch.float64)
    scores = score(opacities, gradient)
    expected = torch.tensor([0.80658366, 0.07914037, 0.78168173, 0.33259424], dtype=torch.float64)
    torch.testing.assert_close(scores, expected, rtol=0, atol=5e-9)
    living = scores.masked_fill(opacities <= 0.005, 0)
    expected = torch.tensor([0.41990765, 0, 0.40694370, 0.17314864], dtype=torch.float64)
    torch.testing.assert_close(living / living.sum(), expected, rtol=0, atol=5e-9)
    assert torch.equal(score(opacities, torch.zeros(4)), opacities / opacities.sum())  # no view saw anything
    new, sizes = relocated(torch.tensor([0.9, 0.9], dtype=torch.float64), torch.tensor([2, 3]))
    assert [round(x, 8) for x in (*new.tolist(), *sizes.tolist())] == [0.68377223, 0.53584112, 0.86793785, 0.82776488]


@pytest.mark.parametrize("name", OPTIONS)
def test_dead_gaussians_move_to_opaque_ones_and_to_large_gradients(name):
    """Catches a Gaussian that is added, pruned or moved though it lives, a source that is dead or has no score, a copy
    that lacks a parameter, and gradients or moments that outlive the round."""
    model, moments = moved(started(build(name, **OPTIONS[name]), 40)), Moments()
    opacities = model.splats["opacities"].data
    opacities[:20], opacities[20:30], opacities[30:] = 2.0, -5.2, -8.0  # 0.88; 0.0055; dead
    before = {key: value.detach().clone() for key, value in model.splats.items()}
    rule = RelocationDensification(Rows(model, moments), DensifyConfig(), 0.005, 10)
    gradients = torch.zeros(1, 40, 2, dtype=torch.float64)
    gradients[0, 20:22], gradients[0, 30:] = 1.0, 0.1  # of two faint Gaussians, and of the dead
    rule.accumulate(torch.ones(1, 40, dtype=torch.bool), gradients, width=100, height=50, views=2, skip=torch.zeros(()))
    torch.testing.assert_close(rule.mean_gradient()[20], torch.tensor(100.0).hypot(torch.tensor(50.0)).double())
    assert rule.densify(generator(1), has_reset=True, most=100) == 0
    assert not rule.gradient.any()
    assert not rule.times_visible.any()
    sources = [int((mean == before["means"]).all(1).nonzero()[0]) for mean in model.splats["means"]]
    assert sources[:30] == list(range(30))
    assert set(sources[30:]) <= {*range(22)}
    assert set(sources[30:]) & {20, 21}
    assert torch.equal(model.splats["sh0"], before["sh0"][sources])
    copied = torch.tensor(sources).bincount(minlength=40)[:30] > 1
    assert torch.equal(moments.fresh, torch.cat([copied, torch.ones(10, dtype=torch.bool)]))
    assert torch.equal(model.splats["opacities"][:30] < before["opacities"][:30], copied)
    assert (torch.sigmoid(model.splats["opacities"]) > 0.004999).all()


def test_nothing_moves_without_the_living_or_the_dead():
    """Catches weights of zero from which a source is drawn, and gradients that stay when no row has changed."""
    for opacity in (-8.0, 1.0):
        model = started(build("3dgs"), 10)
        model.splats["opacities"].data.fill_(opacity)
        rule = RelocationDensification(Rows(model, Moments()), DensifyConfig(), 0.005, 10)
        drawn, skip = torch.ones(1, 10, dtype=torch.bool), torch.zeros(())
        rule.accumulate(drawn, torch.ones(1, 10, 2), width=8, height=8, views=1, skip=skip)
        means = model.splats["means"].detach().clone()
        rule.densify(generator(1), has_reset=False, most=100)
        assert torch.equal(model.splats["means"], means)
        assert not rule.gradient.any()


def test_a_training_with_relocation_continues_from_its_state():
    """Catches gradients that a checkpoint lacks, a number of Gaussians that changes, and a rule that is not called."""
    whole, stopped = assert_resumes(lambda: trainer("freetime", *ROUNDS), 25)
    assert len(whole.model) == len(stopped.model) == len(trainer("freetime").model)
    assert stopped.density.rule.gradient.any()
    before, after = (opacities_of(train(trainer("freetime", *ROUNDS), until=step).model) for step in (49, 50))
    assert before.min() < 0.08
    assert after.min() > 0.0899

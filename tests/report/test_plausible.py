"""Records that somebody changed by hand: what cannot be is in no table, and is told with its place and the reason."""

from dataclasses import replace

import pytest
from records import but, elsewhere, lost, make, on_demand, run, write_all

from gsbench.measure.curve import Point
from gsbench.measure.record import LengthChoice, Region, Stop
from gsbench.report import study
from gsbench.report.frame import load

RUN = run(seed=9)  # of two views, of 25 and 26 dB
FIRST, SECOND = RUN.per_view
CURVE = make().curve
GATED = on_demand([make(seed=9)])[0]


@pytest.mark.parametrize(
    ("edited", "reason"),
    [
        (but(RUN, metrics={"psnr": 60.0}), "metrics.psnr: expected 25.5, the mean of its views, got 60"),
        (replace(RUN, per_view=[FIRST]), "metrics.psnr: expected 25, the mean of its views, got 25.5"),
        (replace(RUN, per_view=[]), "per_view: expected each evaluated view, got none"),
        (
            replace(RUN, per_view=[FIRST, SECOND] * 2),
            "per_view: expected each view once, got test/r_000 more than once",
        ),
        (
            replace(RUN, per_view=[FIRST, replace(SECOND, psnr=None)]),
            "per_view: expected psnr of all 2 views, as metrics has it, got it of 1",
        ),
        (
            replace(RUN, per_view=[replace(FIRST, psnr=None), replace(SECOND, psnr=None)]),
            "per_view: expected psnr of all 2 views, as metrics has it, got it of 0",
        ),
        (make(seed=9, psnr=400.0), "metrics.psnr: expected 0 to 100, got 400"),
        (make(seed=9, psnr=-1.0), "metrics.psnr: expected 0 to 100, got -1"),
        (but(RUN, metrics={"ssim": 3.0}), "metrics.ssim: expected -1 to 1, got 3"),
        (but(RUN, metrics={"lpips_alex": -0.1}), "metrics.lpips_alex: expected 0 to 10, got -0.1"),
        (but(RUN, metrics={"flicker": 256.0}), "metrics.flicker: expected 0 to 255, got 256"),
        (replace(RUN, per_view=[FIRST, replace(SECOND, ssim=1.5)]), "per_view[1].ssim: expected -1 to 1, got 1.5"),
        (replace(RUN, curve=[CURVE[0]._replace(psnr_val=150.0)]), "curve[0].psnr_val: expected 0 to 100, got 150"),
        (replace(RUN, curve=[Point(500, -45.0, 20.0)]), "curve[0].seconds: expected 0 to 1e+15, got -45"),
        (but(RUN, cost={"train_s": -1.0}), "cost.train_s: expected 0 to 1e+15, got -1"),
        (but(RUN, cost={"stage_s": {"loss": -1.0}}), "cost.stage_s.loss: expected 0 to 1e+15, got -1"),
        (but(RUN, cost={"num_gaussians": -5}), "cost.num_gaussians: expected 0 to 1e+15, got -5"),
        (
            replace(RUN, cost=replace(RUN.cost, train_s=9.0)),
            "cost.train_s: expected 90, the sum of stage_s, got 9",
        ),
        (
            replace(RUN, cost=replace(RUN.cost, fps=200.0)),
            "cost.fps: expected 20, the 1000 / render_ms.p50, got 200",
        ),
        (replace(RUN, curve=[CURVE[0], CURVE[1]._replace(seconds=4.0)]), "curve: expected rising seconds"),
        (replace(RUN, curve=[Point(1000, 91.0, 20.0)]), "curve: expected at most 90 seconds, as cost.train_s, got 91"),
        (but(RUN, provenance={"config": {"seed": 3}}), "seed: expected 3, as in provenance.config, got 9"),
        (but(RUN, provenance={"config": {"model": {"name": "4dgs"}}}), "model: expected 4dgs, as in provenance.config"),
        (but(RUN, provenance={"config": {"data": {"dataset": "x"}}}), "dataset: expected x, as in provenance.config"),
        (replace(RUN, stop=Stop(-5, 1)), "stop.iteration: expected 0 to 1e+15, got -5"),
        (replace(RUN, length_choice=LengthChoice(-5, [])), "length_choice.kept: expected 0 to 1e+15, got -5"),
        (replace(RUN, regions={"moving": Region("masks", -5, 0.1, "")}), "regions.moving.views: expected 0 to"),
        (replace(RUN, averaged=-5), "averaged: expected 0 to 1e+15, got -5"),
        (but(GATED, on_demand={"gates": [replace(GATED.on_demand.gates[0], measured_db=-101.0)]}), "-100 to 100"),
        (
            replace(elsewhere(RUN, "other"), parts={"score": {"ms_ssim": 1.5}}),
            "parts.score.ms_ssim: expected 0 to 1, got 1.5",
        ),
    ],
)
def test_what_cannot_be_is_left_out_in_a_line(edited, reason, tmp_path):
    """Catches a record that was changed by hand and ranks among others, also where it is a row of a study."""
    write_all([run(), edited], tmp_path / "results")
    study.write([run(), edited], tmp_path / "study")
    for folder, file in (("results", edited.path / "record.json"), ("study", "runs.csv")):
        results = load(tmp_path / folder)
        assert results.runs.seed.tolist() == [0]
        (fault,) = results.faults
        assert fault.startswith(f"{tmp_path / folder / file}: {edited.path}: ")
        assert reason in fault


def test_views_that_other_runs_have_must_not_be_missing(tmp_path):
    """Catches a hard view that was deleted by hand, with a mean that is that of the others."""
    without = but(replace(RUN, per_view=[SECOND], seed=1), metrics={"psnr": SECOND.psnr})
    results = load(write_all([RUN, without], tmp_path / "same"))
    assert results.runs.seed.tolist() == [9]
    (fault,) = results.faults
    assert "per_view: expected test/r_000, as in other runs on these data: was it edited?" in fault
    with_one_more = replace(RUN, per_view=[FIRST, SECOND, replace(FIRST, name="test/r_9")], seed=1)
    with_one_more = but(with_one_more, metrics={"psnr": (2 * FIRST.psnr + SECOND.psnr) / 3})
    (fault,) = load(write_all([RUN, replace(RUN, seed=2), with_one_more], tmp_path / "more")).faults
    assert "per_view: expected no test/r_9, as in other runs on these data" in fault
    other_split = but(without, protocol={"eval_split": "val"})
    assert load(write_all([RUN, other_split], tmp_path / "split")).faults == ()
    assert load(write_all([RUN, lost(make(seed=2))], tmp_path / "failed")).faults == ()


def test_what_can_be_is_kept(tmp_path):
    """Catches a range that is too narrow: views without such pixels, a removal that gains PSNR, a negative z,
    AGR in a name."""
    screen = replace(GATED.on_demand.screen, z=-1.7)
    gained = but(GATED, on_demand={"gates": [replace(GATED.on_demand.gates[0], measured_db=-0.3)], "screen": screen})
    moving = replace(
        but(RUN, metrics={"psnr_moving": 20.0, "psnr_object": 21.0}),
        per_view=[replace(FIRST, psnr_moving=20.0), SECOND],
        seed=1,
    )
    named = but(make("7dgs_noagr", seed=2), provenance={"config": {"seed": 2, "model": {"name": "7dgs"}}})
    other = replace(
        elsewhere(replace(RUN, seed=3), "other"),
        provenance=replace(named.provenance, config={"model": {"name": "7dgs"}}),
    )
    assert all(load(write_all([r], tmp_path / str(r.seed))).faults == () for r in (gained, moving, named, other))

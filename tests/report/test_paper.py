"""The paper's tables as data: complete, and consistent with the averages the paper prints."""

from statistics import fmean

import pytest

from gsbench.report.paper import AVERAGE, MODELS, PROTOCOLS, paper_row, table1, table2

FIELDS = {"psnr": 2, "ssim": 3, "lpips": 3, "train_min": 1, "fps": 1, "num_gaussians": 0}  # digits printed


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("dataset", PROTOCOLS)
def test_every_average_matches_its_rows(dataset, model):
    """Would catch a mistyped cell or a lost row: rows and average are rounded, so they agree to one last digit."""
    rows = {scene: row for (d, scene, m), row in table1().items() if (d, m) == (dataset, model) and scene != AVERAGE}
    assert rows.keys() == {scene.lower() for scene in PROTOCOLS[dataset].scenes}
    average = paper_row(dataset, AVERAGE, model)
    for field, digits in FIELDS.items():
        if not (model == "7dgs_noagr" and field == "train_min"):  # the paper leaves these empty
            values = [getattr(row, field) for row in rows.values()]
            assert fmean(values) == pytest.approx(getattr(average, field), abs=10.0**-digits), field


def test_rows_by_hand():
    """Would catch columns read in another order: three rows read off the paper."""
    trex = paper_row("D-NeRF", "trex", "7dgs")
    assert (trex.psnr, trex.ssim, trex.lpips) == (30.72, 0.980, 0.018)
    assert (trex.train_min, trex.fps, trex.num_gaussians) == (63.4, 156.5, 67994)
    assert paper_row("7DGS-PBR", "suzanne", "7dgs_noagr").train_min is None
    assert paper_row("mini", "suzanne", "7dgs") is paper_row("D-NeRF", "trex", "3dgs") is None


def test_table_2_agrees_with_table_1_and_says_who_measured():
    """Would catch tables mixed up, and retrainings called the method's own: STG's paper has 33.6 dB on Technicolor."""
    for dataset in ("D-NeRF", "Technicolor"):
        for row in table2()[dataset]:
            if row.method in ("4DGS", "7DGS"):
                assert row.psnr == paper_row(dataset, AVERAGE, row.method.lower()).psnr
    assert [row.method for row in table2()["D-NeRF"] if row.lpips is None] == ["K-Planes"]
    sources = {(dataset, row.method): row.source for dataset, rows in table2().items() for row in rows}
    assert set(sources.values()) == {"quoted", "reproduced", "retrained"}
    retrained = [key for key, source in sources.items() if source == "retrained"]
    assert retrained == [("Technicolor", "4DGaussians"), ("Technicolor", "STG")]

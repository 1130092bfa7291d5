"""The paper's tables as data: complete, and consistent with the averages the paper prints."""

from statistics import fmean

import pytest

from gsbench.report.paper import AVERAGE, MODELS, paper_row, table1, table2

FIELDS = {"psnr": 2, "ssim": 3, "lpips": 3, "train_min": 1, "fps": 1, "num_gaussians": 0}  # digits printed
AVERAGES = [
    (dataset, model, field)
    for dataset in ("7DGS-PBR", "D-NeRF", "Technicolor")
    for model in MODELS
    for field in FIELDS
    if not (model == "7dgs_noagr" and field == "train_min")  # the paper leaves these empty
]


def test_there_are_51_averages():
    """Would catch a row or cell that was lost, and with it the checks below."""
    assert len(AVERAGES) == 51
    assert len(table1()) == (6 + 8 + 5 + 3) * 3


@pytest.mark.parametrize(("dataset", "model", "field"), AVERAGES)
def test_every_average_matches_its_rows(dataset, model, field):
    """Would catch a mistyped cell: rows and average are each rounded, so they agree to one unit of the last digit."""
    rows = [row for (d, scene, m), row in table1().items() if (d, m) == (dataset, model) and scene != AVERAGE]
    printed = getattr(paper_row(dataset, AVERAGE, model), field)
    assert fmean(getattr(row, field) for row in rows) == pytest.approx(printed, abs=10.0 ** -FIELDS[field])


def test_rows_by_hand():
    """Would catch columns read in another order: three rows read off the paper."""
    trex = paper_row("D-NeRF", "trex", "7dgs")
    assert (trex.psnr, trex.ssim, trex.lpips) == (30.72, 0.980, 0.018)
    assert (trex.train_min, trex.fps, trex.num_gaussians) == (63.4, 156.5, 67994)
    assert paper_row("7DGS-PBR", "suzanne", "7dgs_noagr").train_min is None
    assert paper_row("mini", "suzanne", "7dgs") is None
    assert paper_row("D-NeRF", "trex", "3dgs") is None


def test_table_2_agrees_with_the_averages_of_table_1():
    """Would catch tables mixed up: the paper's own methods have one PSNR in both."""
    for dataset in ("D-NeRF", "Technicolor"):
        for row in table2()[dataset]:
            model = {"4DGS": "4dgs", "7DGS": "7dgs"}.get(row.method)
            if model:
                assert row.psnr == paper_row(dataset, AVERAGE, model).psnr
    assert [row.method for row in table2()["D-NeRF"] if row.lpips is None] == ["K-Planes"]


def test_what_table_2_quotes_from_others():
    """Would catch numbers of retrainings that are called the method's own: STG's paper has 33.6 dB on Technicolor."""
    sources = {(dataset, row.method): row.source for dataset, rows in table2().items() for row in rows}
    assert set(sources.values()) == {"quoted", "reproduced", "retrained"}
    retrained = [key for key, source in sources.items() if source == "retrained"]
    assert retrained == [("Technicolor", "4DGaussians"), ("Technicolor", "STG")]

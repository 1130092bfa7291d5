"""The paper's tables as data: complete, and consistent with the averages the paper prints."""

import math

import pytest

from gsbench.report.paper import AVERAGE, MODELS, PROTOCOLS, average, read_table, table1

FIELDS = {"psnr_db": 2, "ssim": 3, "lpips": 3, "train_min": 1, "fps": 1, "gaussians": 0}  # digits printed


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("dataset", PROTOCOLS)
def test_every_average_matches_its_rows(dataset, model):
    """Would catch a mistyped cell or a lost row: rows and average are rounded, so they agree to one last digit."""
    rows = table1().xs((dataset, model), level=("dataset", "model"))
    printed, rows = rows.loc[AVERAGE], rows.drop(AVERAGE)
    assert set(rows.index) == {scene.lower() for scene in PROTOCOLS[dataset].scenes}
    for field, digits in FIELDS.items():
        if not (model == "7dgs_noagr" and field == "train_min"):  # the paper leaves these empty
            assert rows[field].mean() == pytest.approx(printed[field], abs=10.0**-digits), field


def test_rows_by_hand():
    """Would catch columns read in another order: three rows read off the paper."""
    assert average("D-NeRF", ["trex"], "7dgs").to_dict() == {
        "psnr_db": 30.72,
        "ssim": 0.980,
        "lpips_alex": 0.018,
        "train_min": 63.4,
        "fps": 156.5,
        "gaussians": 67994,
    }
    assert average("Technicolor", ["Train", "Painter"], "4dgs").psnr_db == pytest.approx((32.58 + 35.09) / 2)
    assert math.isnan(average("7DGS-PBR", ["suzanne"], "7dgs_noagr").train_min)
    for key in (("mini", ["suzanne"], "7dgs"), ("D-NeRF", ["trex", "x"], "7dgs"), ("D-NeRF", [], "7dgs")):
        assert average(*key).empty


def test_table_2_agrees_with_table_1_and_says_who_measured():
    """Would catch tables mixed up, and retrainings called the method's own: STG's paper has 33.6 dB on Technicolor."""
    rows = read_table("paper_table2.csv")
    for row in rows[rows.method.isin(["4DGS", "7DGS"])].itertuples():
        assert row.psnr_db == average(row.dataset, [AVERAGE], row.method.lower()).psnr_db
    assert rows.method[rows.lpips.isna()].tolist() == ["K-Planes"]
    assert set(rows.source) == {"quoted", "reproduced", "retrained"}
    retrained = rows[rows.source == "retrained"]
    assert retrained[["dataset", "method"]].to_numpy().tolist() == [["Technicolor", m] for m in ("4DGaussians", "STG")]

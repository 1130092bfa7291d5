"""Strips of pictures: where things are, what the error's colours mean, what is written."""

import cv2
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gsbench.measure import images as pictures
from gsbench.measure.images import ERROR_SCALE, GAP, HEADER


def cells(picture: np.ndarray, height: int, width: int, row: int = 0) -> list[np.ndarray]:
    top = HEADER + row * (height + GAP)
    return [picture[top : top + height, i * (width + GAP) :][:, :width] for i in range(3)]


def test_render_truth_and_error_are_where_the_header_says():
    """Would catch swapped columns, swapped red and blue, or an error that is not the absolute mean over RGB."""
    truth = np.random.default_rng(0).random((30, 300, 3))
    render = truth.copy()
    render[:10] = np.clip(truth[:10] + ERROR_SCALE / 2, None, 1)
    render[20:] = 1 - truth[20:]
    picture = pictures.strip([(render, truth), (truth, truth)])
    shown, reference, error = cells(picture, 30, 300)
    assert np.abs(shown / 255 - render).max() <= 0.5 / 255 + 1e-6
    assert np.abs(reference / 255 - truth).max() <= 0.5 / 255 + 1e-6
    assert (error[10:20] == error[10, 0]).all()
    assert error[10, 0].sum() < 20  # none is black
    brightest = np.abs(render - truth).mean(-1) >= ERROR_SCALE
    assert brightest.sum() > 100
    assert (error[brightest] == error[brightest][0]).all()
    assert error[brightest][0][:2].min() > 200  # 0.2 and more is bright yellow
    assert (cells(picture, 30, 300, 1)[2] == error[10, 0]).all()


def test_the_error_is_a_mean_over_channels_on_a_scale_of_its_own():
    """Would catch a signed error, a maximum over channels, a scale that adapts to the picture, so that two strips
    cannot be compared, and another scale than 0 to 0.2, which every strip ever written has."""

    def color(*channels, beside: float = 0.0) -> list[int]:
        truth = np.full((4, 300, 3), 0.5)
        render = truth + channels
        render[0] += beside
        return cells(pictures.strip([(render, truth)]), 4, 300)[2][3, 0].tolist()

    white = np.ones((4, 300, 3))
    beyond = pictures.strip([(1.5 * white, white), (0 * white, -0.5 * white)])
    for row in (0, 1):  # what no screen shows is no error
        assert (cells(beyond, 4, 300, row)[2] == color(0.0)).all()
    assert color(0.07) == color(-0.07) == color(0.07, beside=-0.5) == color(0.21, 0, 0) == color(0.07, 0.07, -0.07)
    assert color(0.19) != color(0.2) == color(0.4)


def test_errors_of_float32_have_a_log_scale():
    """Would catch a linear scale, whose errors are all black, other ends than the legend's, and zero as infinity."""
    values = np.array([[0.0, 1e-7, 1e-6, 1e-3, 1.0, 50.0]])
    levels = np.array([[0, 0, 0, 0.5, 1, 1]])
    assert (pictures.rounding_image(values) == pictures.inferno(levels)).all()


def test_small_images_are_enlarged_without_smoothing_and_nan_is_seen():
    """Catches interpolated pixels (of a 110-wide image each becomes 3 x 3), and broken ones that look black."""
    image = np.random.default_rng(0).random((5, 110, 3))
    shown = cells(pictures.strip([(image, image)]), 15, 330)[0]
    assert (shown.reshape(5, 3, 110, 3, 3).min((1, 3)) == shown.reshape(5, 3, 110, 3, 3).max((1, 3))).all()
    assert np.abs(shown[1::3, 1::3] / 255 - image).max() < 0.01
    truth = np.zeros((4, 300, 3))
    render = truth.copy()
    render[1, 2, 0] = np.nan
    shown, _, error = cells(pictures.strip([(render, truth)]), 4, 300)
    assert shown[1, 2].tolist() == error[1, 2].tolist() == [255, 0, 255]
    assert shown[1, 3].tolist() == [0, 0, 0]


@settings(max_examples=20, deadline=None)
@given(height=st.integers(1, 20), width=st.integers(1, 400), rows=st.integers(1, 3))
def test_any_size_gives_a_picture(height, width, rows):
    """Would catch a header that is drawn outside a narrow picture."""
    image = np.zeros((height, width, 3), np.float32)
    picture = pictures.strip([(image, image)] * rows)
    factor = -(-240 // width)
    assert picture.shape == (HEADER + rows * (height * factor + GAP) - GAP, 3 * width * factor + 2 * GAP, 3)
    assert picture[:HEADER].min() < 128  # something is written there


def test_the_png_holds_what_was_drawn(tmp_path):
    """Would catch RGB written as BGR, and a temporary file left behind."""
    image = np.random.default_rng(0).integers(0, 256, (7, 9, 3), np.uint8)
    pictures.write_png(image, tmp_path / "new" / "a.png")
    read = cv2.imread(str(tmp_path / "new" / "a.png"))
    assert (cv2.cvtColor(read, cv2.COLOR_BGR2RGB) == image).all()
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["a.png"]

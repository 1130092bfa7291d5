"""Which file is taken for which view, and which files of other programs are refused."""

import io
import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsbench import scenes
from gsbench.errors import InputError
from gsbench.measure.renders import check_renders
from gsbench.scenes import View

SIZE = 16
NAMES = ("r_0", "r_1")  # of the test views
BYTES = np.full((SIZE, SIZE, 3), 99, np.uint8)
FLOATS = np.full((SIZE, SIZE, 3), 0.5, np.float32)


@pytest.fixture(scope="module")
def views(square: Path) -> list[View]:
    return scenes.load(square / "square").test


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


def put(name: str, content: bytes = b"") -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes(content)


def moved(name: str, make: Callable[[Path], object]) -> Callable[[Path], object]:
    """Remove a file, and make something else in its place."""

    def spoil(folder: Path) -> None:
        (folder / name).unlink()
        make(folder / name)

    return spoil


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (put("r_0.npy", npy(FLOATS)), "expected one image of a name, got r_0.npy and r_0.png"),
        (put("r_2.png", png(BYTES)), "expected an image of each evaluated view by name, got one of no view: r_2"),
        (lambda folder: (folder / "r_1.png").unlink(), "by name, got none of r_1"),
        (put("r_0.png", png(BYTES)[:-20]), "damaged PNG"),
        (put("r_0.png", b"GIF89a"), "expected a PNG or a JPEG"),
        (put("r_0.png", png(BYTES[..., 0])), "got PNG's colour type 0 of 8 bits"),
        (put("r_0.png", png(BYTES.astype(np.uint16))), "16-bit PNG and 8-bit PNG: keep one kind"),
        (put("r_0.png", png(BYTES[:8])), "expected 16x16, the size of the view test/r_0, got 16x8: render it so"),
        (put("r_0.png", png(BYTES.repeat(2, 0).repeat(2, 1))), "got 32x32: render it so, or add --reduce"),
        (moved("r_0.png", os.mkfifo), "found a pipe"),
        (moved("r_0.png", lambda path: path.symlink_to("/none")), "found none"),
    ],
)
def test_wrong_images_are_refused_in_a_line(spoil, words, views, tmp_path):
    """Catches a score of the wrong images, images that are resized in silence, and a pipe that is read for ever."""
    for name in NAMES:
        put(f"{name}.png", png(BYTES))(tmp_path)
    spoil(tmp_path)
    refused(tmp_path, words, views)


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.float32(255) * FLOATS, "expected values in [0, 1], their mean is 128"),
        (FLOATS - np.linspace(0, 1.5, 3, dtype=np.float32), "their least -1: scale them"),
        (FLOATS * np.float32([1, 1, np.nan]), "their mean is nan"),
        (
            np.pad(FLOATS, ((0, 0), (0, 0), (0, 1)), constant_values=np.nan),
            "expected values in [0, 1], their mean is 0.5",
        ),
        (BYTES, "expected floats [H, W, 3] or [H, W, 4], got uint8"),
        (FLOATS[..., 0], "expected floats [H, W, 3]"),
        (np.array([{}]), "expected an array of numpy"),
    ],
)
def test_wrong_arrays_are_refused_in_a_line(array, words, views, tmp_path):
    """Catches a pickle that is loaded, values in [0, 255] or [-1, 1] that are clamped, and the trace of a metric."""
    for name in NAMES:
        put(f"{name}.npy", npy(array))(tmp_path)
    refused(tmp_path, words, views)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "expected a folder of images or a video, there is none"),
        (b"", "got another file"),
        (b"#EXTM3U\nhttp://example.org", "got another file"),
        (b"....ftypisom" + b"0" * 99, "expected 2 frames, one for each evaluated view, got 0 that OpenCV can read"),
    ],
)
def test_what_is_no_video_is_refused(content, words, views, tmp_path, capfd):
    """Catches a playlist that is followed, and lines of FFmpeg's above the error."""
    path = tmp_path / "film.mp4"
    if content is not None:
        path.write_bytes(content)
    refused(path, words, views)
    assert not capfd.readouterr().err


def refused(path: Path, words: str, views: list[View]) -> None:
    """Read all renders, and expect an error with some words, in one line."""
    with pytest.raises(InputError) as caught:
        list(check_renders(path, views, (0.0, 0.0, 0.0)).images())
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_there_is_an_image_for_each_view(views, tmp_path):
    """Catches a folder with half of the views, or with the ground truth beside them, that is matched by order."""
    for name in ("none", "a", "b", "c"):
        if name != "none":
            put(f"{name}.png", png(BYTES))(tmp_path)
        if name != "b":
            words = f"one for each evaluated view, such as r_0.png, got {len(list(tmp_path.iterdir()))}"
            refused(tmp_path, words, views)


def test_names_that_are_no_views_are_matched_by_their_order(views, tmp_path):
    """Catches an order of letters, in which frame_10 comes before frame_9, and files that are dropped in silence."""
    for i, name in enumerate(("frame_9.png", "frame_10.png", "notes.txt")):
        put(name, png(BYTES // (i + 1)))(tmp_path)
    renders = check_renders(tmp_path, views, (0.0, 0.0, 0.0))
    assert (renders.files, renders.others) == (("frame_9.png", "frame_10.png"), ("notes.txt",))
    assert [round(float(255 * image[0, 0, 0])) for image in renders.images()] == [99, 49]
    assert (renders.facts.matched, renders.facts.kind) == ("order", "8-bit PNG")


def test_an_order_that_names_contradict_is_refused(views, tmp_path):
    """Catches files that are scored on views of other names, as their names say these views and more."""
    for name in ("1_r_1.png", "2_r_0.png"):
        put(name, png(BYTES))(tmp_path)
    refused(tmp_path, "got 1_r_1.png in the place of r_0: name each as its view, such as r_0.png", views)
    for before, after in (
        ("1_r_1.png", "r_0_r_1.png"),
        ("2_r_0.png", "r_1.render.png"),
        ("r_1.render.png", "r_10.png"),
    ):
        (tmp_path / before).rename(tmp_path / after)
        if after != "r_0_r_1.png":
            assert check_renders(tmp_path, views, (0.0, 0.0, 0.0)).facts.matched == "order"


def test_names_in_capitals_and_hidden_files(views, tmp_path):
    """Catches .NPY that is matched by order, and copies that macOS makes, taken for images."""
    for name, shade in (("r_1.NPY", 0.5), ("r_0.NPY", 1.0)):
        put(name, npy(shade * FLOATS))(tmp_path)
    put("._r_0.png", b"macOS")(tmp_path)
    renders = check_renders(tmp_path, views[::-1], (0.0, 0.0, 0.0))
    assert (renders.facts.matched, renders.files, renders.others) == ("names", ("r_1.NPY", "r_0.NPY"), ("._r_0.png",))


def test_alpha_is_composited_over_the_background(views, tmp_path):
    """Catches alpha that is ignored or premultiplied: what is transparent has the background's colour, not its own."""
    half = np.concatenate([BYTES, np.full((SIZE, SIZE, 1), 51, np.uint8)], axis=-1)
    for name, content in zip(NAMES, (png(half), png(BYTES)), strict=True):
        put(f"{name}.png", content)(tmp_path)
    blended, opaque = check_renders(tmp_path, views, (1.0, 0.0, 0.5)).images()
    assert blended[3, 4].tolist() == pytest.approx([0.2 * 99 / 255 + 0.8 * c for c in (1.0, 0.0, 0.5)], abs=1e-6)
    assert opaque[3, 4].tolist() == pytest.approx([99 / 255] * 3)


def test_larger_images_are_reduced_by_the_mean_of_areas(views, tmp_path):
    """Catches another filter, and a size that the record does not name."""
    random = np.random.default_rng(0).random((2 * SIZE, 2 * SIZE, 3), np.float32)
    for name in NAMES:
        put(f"{name}.npy", npy(random))(tmp_path)
    renders = check_renders(tmp_path, views, (0.0, 0.0, 0.0), reduces=True)
    means = random.reshape(SIZE, 2, SIZE, 2, 3).mean((1, 3))
    np.testing.assert_allclose(next(renders.images()).numpy(), means, atol=1e-6)
    assert renders.facts.resized_from == "32x32"


def test_frames_of_a_video_are_the_views_in_their_order(views, tmp_path):
    """Catches frames in reverse, BGR taken for RGB, and a video that is longer than the views."""
    for count in (2, 3):
        path = tmp_path / f"{count}.avi"
        film = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (SIZE, SIZE))
        for i in range(count):
            film.write(np.full((SIZE, SIZE, 3), (40 + 80 * i, 60, 90), np.uint8))
        film.release()
    renders = check_renders(tmp_path / "2.avi", views, (0.0, 0.0, 0.0))
    for i, image in enumerate(renders.images()):
        assert (255 * image[5, 5]).tolist() == pytest.approx([90, 60, 40 + 80 * i], abs=4)
    refused(tmp_path / "3.avi", "expected 2 frames, one for each evaluated view, got more", views)

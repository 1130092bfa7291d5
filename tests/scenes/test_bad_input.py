"""Every fault a data set can have is an InputError of one line that names the file and the field."""

import json
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_scene import FRONT, edit, write_png, write_tiny

from gsbench import scenes
from gsbench.errors import InputError, TooLargeError
from gsbench.process import memory
from gsbench.scenes import images
from gsbench.scenes.sample import folder

Break = Callable[[Path], object]


def change(**values: object) -> Break:
    """Set fields of transforms_train.json."""
    return lambda root: edit(root, lambda content: content.update(values))


def change_frame(**values: object) -> Break:
    """Set fields of the second training frame."""
    return lambda root: edit(root, lambda content: content["frames"][1].update(values))


def drop(*keys: str) -> Break:
    return lambda root: edit(root, lambda content: [content.pop(key) for key in keys])


def drop_from_frame(key: str, split: str = "train") -> Break:
    return lambda root: edit(root, lambda content: content["frames"][-1].pop(key), split)


def matrix(**entries: Any) -> Break:
    """Replace single entries of a rigid matrix, as m23=0.5."""
    rows = [list(row) for row in FRONT]
    for key, value in entries.items():
        rows[int(key[1])][int(key[2])] = value
    return change_frame(transform_matrix=rows)


def write(name: str, data: bytes) -> Break:
    return lambda root: (root / name).write_bytes(data)


def truncate(name: str) -> Break:
    return lambda root: (root / name).write_bytes((root / name).read_bytes()[:-20])


def link(name: str, target: str) -> Break:
    """Replace a file by a link."""
    return lambda root: [(root / name).unlink(missing_ok=True), (root / name).symlink_to(target)]


def replace_by_pipe(root: Path) -> None:
    (root / "train" / "r_1.png").unlink()
    os.mkfifo(root / "train" / "r_1.png")


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(width: int, height: int, pixels: bytes, color: int = 6, depth: int = 8) -> bytes:
    """A PNG with right checksums around whatever it is given."""
    header = struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(pixels)) + chunk(b"IEND", b"")


JSON = "transforms_train.json"
IMAGE = "train/r_1.png"
MATRIX = "frames[1].transform_matrix"
PATH = "frames[1].file_path"
FAULTS: dict[str, tuple[Break, str, str]] = {  # what is done, the file the message names, the field or fault
    # the images
    "png missing": (lambda root: (root / IMAGE).unlink(), IMAGE, PATH),
    "png is a folder": (lambda root: [(root / IMAGE).unlink(), (root / IMAGE).mkdir()], IMAGE, PATH),
    "png is a pipe": (replace_by_pipe, IMAGE, PATH),
    "png truncated": (truncate(IMAGE), IMAGE, "truncated PNG"),
    "png empty": (write(IMAGE, b""), IMAGE, "expected a PNG"),
    "png is half a jpeg": (write(IMAGE, b"\xff\xd8\xff\xe0 JFIF"), IMAGE, "damaged JPEG"),
    "png is a gif": (write(IMAGE, b"GIF89a"), IMAGE, "expected a PNG or a JPEG"),
    "png without header": (write(IMAGE, b"\x89PNG\r\n\x1a\n" + chunk(b"IEND", b"")), IMAGE, "damaged PNG"),
    "png of zero size": (write(IMAGE, png(0, 6, b"")), IMAGE, "0x6"),
    "png of absurd size": (write(IMAGE, png(60000, 60000, b"")), IMAGE, "60000x60000"),
    "png with too few rows": (write(IMAGE, png(8, 6, bytes(33))), IMAGE, "cannot decode"),
    "png of 10 GB": (lambda root: os.truncate(root / IMAGE, 10**10), IMAGE, "at most"),
    "png of 3 bits": (write(IMAGE, png(8, 6, bytes(6 * 9), color=6, depth=3)), IMAGE, "3 bits"),
    "png is grey": (write(IMAGE, png(8, 6, bytes(9 * 6), color=0)), IMAGE, "RGB or RGBA"),
    "png of another size": (lambda root: write_png(root / IMAGE, np.zeros((6, 9, 4), np.uint8)), IMAGE, "9x6"),
    "png of another size in test": (
        lambda root: write_png(root / "test/r_0.png", np.zeros((3, 8, 4), np.uint8)),
        "test/r_0.png",
        "8x3",
    ),
    # the JSON
    "json does not parse": (write(JSON, b'{"frames": [,'), JSON, "expected JSON"),
    "json is binary": (write(JSON, b"\xff\xfe\xfd\x00\x81"), JSON, "expected JSON"),
    "json nested too deep": (write(JSON, b"[" * 100_000), JSON, "expected JSON"),
    "json integer too long": (write(JSON, b"9" * 5000), JSON, "expected JSON"),
    "json with a key twice": (write(JSON, b'{"frames": [], "frames": []}'), JSON, "'frames' appears twice"),
    "json is a pipe": (lambda root: [(root / JSON).unlink(), os.mkfifo(root / JSON)], JSON, "found a pipe"),
    "json without an end": (link(JSON, "/dev/zero"), JSON, "found a device"),
    "json of 10 GB": (lambda root: os.truncate(root / JSON, 10**10), JSON, "at most"),
    "val is a broken link": (link("transforms_val.json", "nowhere"), "transforms_val.json", "found none"),
    "json is a list": (write(JSON, b"[]"), JSON, "'frames'"),
    "frames missing": (drop("frames"), JSON, "frames"),
    "frames is text": (change(frames="all"), JSON, "frames"),
    "split empty": (change(frames=[]), JSON, "train split is empty"),
    "val file there but empty": (
        lambda root: edit(root, lambda content: content.update(frames=[]), "val"),
        "transforms_val.json",
        "val split is empty",
    ),
    "test missing": (lambda root: (root / "transforms_test.json").unlink(), "transforms_test.json", "found none"),
    "frame is a number": (change(frames=[7]), JSON, "frames[0]"),
    # the intrinsics
    "intrinsics missing": (
        drop("camera_angle_x"),
        JSON,
        "frames[0]: expected intrinsics as 'camera_angle_x' or 'fl_x'",
    ),
    "angle zero": (change(camera_angle_x=0), JSON, "camera_angle_x"),
    "angle of pi": (change(camera_angle_x=3.15), JSON, "camera_angle_x"),
    "angle not finite": (change(camera_angle_x=float("nan")), JSON, "camera_angle_x"),
    "focal zero in single precision": (change(fl_x=1e-50), JSON, "fl_x"),
    "focal zero": (change(fl_x=0), JSON, "fl_x"),
    "focal negative": (change(fl_x=10, fl_y=-10), JSON, "fl_y"),
    "focal is text": (change(fl_x="10"), JSON, "fl_x"),
    "center is true": (change(fl_x=10, cx=True), JSON, "cx"),
    "width zero": (change(w=0), JSON, "w"),
    "width contradicts the image": (change(w=800), JSON, "w: expected the images' own 8"),
    "height contradicts the image": (change(h=800.0), JSON, "h: expected the images' own 6"),
    "lens distortion": (change(k1=0.1), JSON, "k1"),
    # the paths
    "path missing": (drop_from_frame("file_path"), JSON, PATH),
    "path is a number": (change_frame(file_path=3), JSON, PATH),
    "path goes up": (change_frame(file_path="../outside"), JSON, PATH),
    "path goes up within": (change_frame(file_path="./train/../../tiny2/r_0"), JSON, PATH),
    "path is absolute": (change_frame(file_path="/etc/passwd"), JSON, PATH),
    "path with a drive": (change_frame(file_path="C:\\scene\\r_1.png"), JSON, "which is absolute: write it relative"),
    "path goes up by backslashes": (change_frame(file_path="..\\outside"), JSON, PATH),
    "path is a loop of links": (link(IMAGE, "r_1.png"), IMAGE, "cannot be read"),
    "path with a NUL": (change_frame(file_path="train/\0"), JSON, PATH),
    "path with a line break": (change_frame(file_path="train/\nr_1"), JSON, PATH),
    "path with a lone surrogate": (change_frame(file_path="train/\ud800"), JSON, PATH),
    "path too long": (change_frame(file_path="r" * 5000), "rrr", "cannot be read"),
    # the cameras
    "matrix missing": (drop_from_frame("transform_matrix"), JSON, MATRIX),
    "matrix of 3 rows": (change_frame(transform_matrix=FRONT[:3]), JSON, MATRIX),
    "matrix of ragged rows": (change_frame(transform_matrix=[*FRONT[:3], [0, 0, 0]]), JSON, MATRIX),
    "matrix with NaN": (matrix(m03=float("nan")), JSON, MATRIX),
    "matrix with infinity": (matrix(m23=float("inf")), JSON, MATRIX),
    "matrix beyond single precision": (matrix(m23=1e39), JSON, MATRIX),
    "matrix with null": (matrix(m00=None), JSON, MATRIX),
    "matrix with a huge integer": (matrix(m23=10**400), JSON, MATRIX),
    "matrix scaled": (matrix(m00=2, m11=2, m22=2), JSON, MATRIX),
    "matrix sheared": (matrix(m01=2e-4), JSON, MATRIX),
    "matrix mirrored": (matrix(m00=-1), JSON, MATRIX),
    "matrix singular": (matrix(m00=0), JSON, MATRIX),
    "matrix last row": (matrix(m32=1), JSON, MATRIX),
    "matrix last entry": (matrix(m33=2), JSON, MATRIX),
    # the times
    "time not finite": (change_frame(time=float("nan")), JSON, "frames[1].time"),
    "time is null": (change_frame(time=None), JSON, "frames[1].time"),
    "time is true": (change_frame(time=True), JSON, "frames[1].time"),
    "time for some": (drop_from_frame("time"), JSON, "frames[1].time"),
    "time not in test": (drop_from_frame("time", "test"), "transforms_test.json", "frames[0].time"),
}


def check_message(error: InputError, *parts: str) -> None:
    message = str(error)
    assert "\n" not in message
    for part in parts:
        assert part in message


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_is_one_line_that_names_file_and_field(fault: str, tiny: Path) -> None:
    """Catches a fault let through, a stack trace from the depths, and a message that leaves the user searching."""
    apply, file, field = FAULTS[fault]
    apply(tiny)
    with pytest.raises(InputError) as caught:
        scenes.load(tiny)
    check_message(caught.value, file, field)


def test_tiny_is_right_unless_broken(tiny: Path) -> None:
    """Without this, every case above could pass because of one and the same fault."""
    assert len(scenes.load(tiny).train) == 2


def test_tolerance_lets_single_precision_pass(tiny: Path) -> None:
    """Catches a rigidity check that refuses rounding: an error just below 1e-4 is a camera."""
    matrix(m01=5e-5)(tiny)
    scenes.load(tiny)


@pytest.mark.parametrize("downscale", [16, 0, -1, 1.5, True])
def test_downscale_must_leave_pixels(tiny: Path, downscale: Any) -> None:
    """Catches a factor that leaves no pixel, or is no number of pixels at all."""
    with pytest.raises(InputError) as caught:
        scenes.load(tiny, downscale=downscale)
    check_message(caught.value, "downscale", str(downscale))


@pytest.mark.parametrize("background", [(0, 0), (0, 0, 2.0), (0, 0, float("nan"))])
def test_background_must_be_a_colour(tiny: Path, background: Any) -> None:
    """Catches a background that would make every image wrong or NaN without a word."""
    with pytest.raises(InputError, match="background"):
        scenes.load(tiny, background=background)


def test_memory_is_asked_for_before_an_image_is_decoded(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches images of a few kilobytes that fill the memory with gigabytes of pixels, and a message without sizes."""
    for name in ("train/r_0.png", "train/r_1.png", "val/r_0.png", "test/r_0.png"):
        (tiny / name).write_bytes(png(8192, 8192, b""))
    monkeypatch.setattr(images, "decode_photo", lambda *_: pytest.fail("decoded"))
    monkeypatch.setattr(memory, "available", lambda: int(4.5 * 2**30))
    with pytest.raises(TooLargeError) as caught:
        scenes.load(tiny)
    check_message(caught.value, "4 images of 8192x8192", "need 5.0 GiB of memory, 4.5 GiB are available", "downscale")


def test_images_are_decoded_by_as_many_threads_as_memory_allows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches threads that together take more than there is: 4 images of 3 GiB in all are kept, 4 GiB decode one."""
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    for free, threads in ((7, 1), (10.9, 1), (11, 2), (10**6, 64)):
        for module in (memory, images):
            monkeypatch.setattr(module, "available", lambda free=free: int(free * 2**30))
        assert images.count_readers((8192, 8192), 4, 1, "x.png") == threads


def test_a_linked_scene_is_loaded(tiny: Path, tmp_path: Path) -> None:
    """Catches a folder that is refused because it is a link, or whose scene has another name than was asked for."""
    (tmp_path / "linked").symlink_to(tiny)
    scene = scenes.load(tmp_path / "linked")
    assert scene.name == "linked"
    assert scene.fingerprint == scenes.load(tiny).fingerprint


@pytest.mark.parametrize("path", ["a\0b", "a\nb", "x" * 5000, "/dev/null/x", None, 7])
def test_a_path_that_is_none_is_refused_in_one_line(path: Any) -> None:
    """Catches a stack trace from the file system for a name that no folder can have."""
    with pytest.raises(InputError) as caught:
        scenes.load(path)
    check_message(caught.value, "expected the path of a scene's folder")


@pytest.mark.parametrize("name", ["nothing", "empty"])
def test_nothing_known_in_the_folder(tmp_path: Path, name: str) -> None:
    """A wrong path is the commonest fault: says what was looked for, the layout, where such data is published."""
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError) as caught:
        scenes.load(tmp_path / name)
    parts = (name, "transforms_train.json", "transforms_{train,val,test}.json", "github.com/albertpumarola/D-NeRF")
    check_message(caught.value, *parts)


def test_broken_image_leaves_stderr_alone(tiny: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Catches OpenCV's or libpng's own lines around ours, for the commonest breakage."""
    truncate(IMAGE)(tiny)
    with pytest.raises(InputError):
        scenes.load(tiny)
    assert capfd.readouterr() == ("", "")


GOOD_PNG = (folder() / "suzanne" / "test" / "r_000.png").read_bytes()


@given(st.integers(0, len(GOOD_PNG) - 1), st.integers(1, 255))
def test_png_with_a_changed_byte_is_refused(at: int, flip: int) -> None:
    """Catches damage that a lenient decoder would turn into wrong pixels, at any byte of the file."""
    data = bytearray(GOOD_PNG)
    data[at] ^= flip
    with pytest.raises(InputError):
        images.decode_photo(bytes(data), "x.png")


@given(st.integers(0, len(GOOD_PNG) - 1))
def test_png_cut_anywhere_is_refused(length: int) -> None:
    """Catches a truncated file whose missing rows would come out black."""
    with pytest.raises(InputError):
        images.decode_photo(GOOD_PNG[:length], "x.png")


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("fuzzed"))


SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text()
VALUES = st.recursive(SCALARS, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner), max_leaves=6)


@settings(max_examples=200)
@given(
    st.sampled_from(["fl_x", "camera_angle_x", "cx", "w", "k1", "frames", "file_path", "time", "transform_matrix"]),
    VALUES,
)
def test_any_value_of_any_field_is_an_input_error_or_a_scene(fuzzed: Path, field: str, value: object) -> None:
    """Catches any other exception, and a scene with a camera that is not finite, whatever JSON a field holds."""
    write_tiny(fuzzed)
    in_frame = field in ("file_path", "time", "transform_matrix")
    edit(fuzzed, lambda content: (content["frames"][1] if in_frame else content).update({field: value}))
    try:
        scene = scenes.load(fuzzed)
    except InputError as error:
        check_message(error)
    else:
        for view in scene.train:
            assert view.camera.K.isfinite().all()
            assert view.camera.viewmat.isfinite().all()


@given(st.binary(max_size=300) | VALUES.map(lambda value: json.dumps(value).encode()))
def test_any_bytes_for_a_json_are_an_input_error(fuzzed: Path, data: bytes) -> None:
    """Catches any other exception for a JSON file that is anything at all."""
    write_tiny(fuzzed)
    (fuzzed / JSON).write_bytes(data)
    with pytest.raises(InputError) as caught:
        scenes.load(fuzzed)
    check_message(caught.value)

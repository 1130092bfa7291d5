"""Every fault a data set can have is an InputError of one line that names the file and the field."""

import os
import random
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile.mutations import damage_file
from hypothesis import example, given
from hypothesis import strategies as st
from tiny_scene import COUNTS, FRONT, IMAGES, check_message, edit, write_image

from gsbench import scenes
from gsbench.errors import InputError, TooLargeError
from gsbench.process import memory
from gsbench.scenes import images
from gsbench.scenes.sample import folder

Break = Callable[[Path], object]


def change(**values: object) -> Break:
    return lambda root: edit(root, lambda content: content.update(values))


def change_frame(**values: object) -> Break:
    """Set fields of the second training frame."""
    return lambda root: edit(root, lambda content: content["frames"][1].update(values))


def drop(*keys: str) -> Break:
    return lambda root: edit(root, lambda content: [content.pop(key) for key in keys])


def drop_from_frame(key: str, split: str = "train") -> Break:
    return lambda root: edit(root, lambda content: content["frames"][-1].pop(key), split)


def paint(name: str, *shape: int) -> Break:
    return lambda root: write_image(root / name, np.zeros(shape, np.uint8))


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
    return lambda root: [(root / name).unlink(missing_ok=True), (root / name).symlink_to(target)]


def pipe(name: str) -> Break:
    return lambda root: [(root / name).unlink(), os.mkfifo(root / name)]


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(width: int, height: int, pixels: bytes, color: int = 6, depth: int = 8, extra: bytes = b"") -> bytes:
    """A PNG with right checksums around any header, pixels and other chunks."""
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0))
    return SIGNATURE + header + extra + chunk(b"IDAT", zlib.compress(pixels)) + chunk(b"IEND", b"")


SIGNATURE = b"\x89PNG\r\n\x1a\n"
JSON, VAL, TEST = (f"transforms_{split}.json" for split in ("train", "val", "test"))
IMAGE = "train/r_1.png"
MATRIX = "frames[1].transform_matrix"
PATH = "frames[1].file_path"
FAULTS: dict[str, tuple[Break, str, str]] = {  # what is done, the file the message names, the field or fault
    # the images
    "png missing": (lambda root: (root / IMAGE).unlink(), IMAGE, PATH),
    "png is a pipe": (pipe(IMAGE), IMAGE, PATH),
    "png truncated": (truncate(IMAGE), IMAGE, "damaged PNG (Truncated File"),
    "png empty": (write(IMAGE, b""), IMAGE, "copy it again"),
    "png is half a jpeg": (write(IMAGE, b"\xff\xd8\xff\xe0 JFIF"), IMAGE, "damaged JPEG"),
    "png is a gif": (write(IMAGE, b"GIF89a"), IMAGE, "expected a PNG or a JPEG"),
    "png of zero size": (write(IMAGE, png(0, 6, b"")), IMAGE, "damaged PNG (its header)"),
    "png of absurd size": (write(IMAGE, png(60000, 60000, b"")), IMAGE, "3600000000 pixels) exceeds"),
    "png of 67 million pixels": (write(IMAGE, png(8192, 8193, b"")), IMAGE, "its size is 8192x8193"),
    "png with too few rows": (write(IMAGE, png(8, 6, bytes(33))), IMAGE, "cannot decode"),
    "png of 10 GB": (lambda root: os.truncate(root / IMAGE, 10**10), IMAGE, "at most"),
    "png of 3 bits": (write(IMAGE, png(8, 6, bytes(6 * 9), color=6, depth=3)), IMAGE, "damaged PNG (its header)"),
    "png is grey": (write(IMAGE, png(8, 6, bytes(54), color=0)), IMAGE, "RGB or RGBA, got PNG's colour type 0 of 8"),
    "png of another size": (paint(IMAGE, 6, 9, 4), IMAGE, "9x6"),
    # the JSON
    "json does not parse": (write(JSON, b'{"frames": [,'), JSON, "expected JSON"),
    "json nested too deep": (write(JSON, b"[" * 100_000), JSON, "expected JSON"),
    "json with a key twice": (write(JSON, b'{"frames": [], "frames": []}'), JSON, "'frames' appears twice"),
    "json is null": (write(JSON, b"null"), JSON, "expected a JSON object with 'frames', got null"),
    "json is a pipe": (pipe(JSON), JSON, "found a pipe"),
    "json without an end": (link(JSON, "/dev/zero"), JSON, "found a device"),
    "json of 10 GB": (lambda root: os.truncate(root / JSON, 10**10), JSON, "at most"),
    "val is a broken link": (link(VAL, "nowhere"), VAL, "found none"),
    "frames missing": (drop("frames"), JSON, "frames"),
    "split empty": (change(frames=[]), JSON, "got an empty list"),
    "val file there but empty": (write(VAL, b'{"camera_angle_x": 0.8, "frames": []}'), VAL, "got an empty list"),
    "an image twice": (change_frame(file_path="train/r_0.png"), JSON, "frames[0] has 'train/r_0.png' too"),
    "two images of one name": (
        lambda root: [(root / "train/r_0.jpg").touch(), change_frame(file_path="train/r_0.jpg")(root)],
        JSON,
        "frames[0] has 'train/r_0.png' too: remove one of the two, or rename it",
    ),
    "test missing": (lambda root: (root / TEST).unlink(), TEST, "found none"),
    "frame is a number": (change(frames=[7]), JSON, "frames[0]"),
    # the intrinsics
    "intrinsics missing": (drop("camera_angle_x"), JSON, "frames[0]: expected intrinsics as 'camera_angle_x'"),
    "angle zero": (change(camera_angle_x=0), JSON, "camera_angle_x"),
    "angle of pi": (change(camera_angle_x=3.15), JSON, "camera_angle_x"),
    "focal zero in single precision": (change(fl_x=1e-50), JSON, "fl_x"),
    "focal negative": (change(fl_x=10, fl_y=-10), JSON, "fl_y"),
    "focal is text": (change(fl_x="10"), JSON, "fl_x"),
    "width zero": (change(w=0), JSON, "w"),
    "width contradicts the image": (change(w=800), JSON, "w: expected the images' own 8"),
    "height contradicts the image": (change(h=800.0), JSON, "h: expected the images' own 6"),
    # the paths
    "path missing": (drop_from_frame("file_path"), JSON, PATH),
    "path is a number": (change_frame(file_path=3), JSON, PATH),
    "path goes up": (change_frame(file_path="../outside"), JSON, PATH),
    "path is absolute": (change_frame(file_path="/etc/passwd"), JSON, PATH),
    "path with a drive": (change_frame(file_path="C:\\scene\\r_1.png"), JSON, "which is absolute: write it relative"),
    "path goes up by backslashes": (change_frame(file_path="..\\outside"), JSON, PATH),
    "path is a loop of links": (link(IMAGE, "r_1.png"), IMAGE, "cannot be read"),
    "path with a NUL": (change_frame(file_path="train/\0"), JSON, PATH),
    "path with a lone surrogate": (change_frame(file_path="train/\ud800"), JSON, PATH),
    "path too long": (change_frame(file_path="r" * 5000), "rrr", "cannot be read"),
    # the cameras
    "matrix missing": (drop_from_frame("transform_matrix"), JSON, MATRIX),
    "matrix of 3 rows": (change_frame(transform_matrix=FRONT[:3]), JSON, MATRIX),
    "matrix of ragged rows": (change_frame(transform_matrix=[*FRONT[:3], [0, 0, 0]]), JSON, MATRIX),
    "matrix with NaN": (matrix(m03=float("nan")), JSON, MATRIX),
    "matrix beyond single precision": (matrix(m23=1e39), JSON, MATRIX),
    "matrix with a huge integer": (matrix(m23=10**400), JSON, MATRIX),
    "matrix scaled": (matrix(m00=2, m11=2, m22=2), JSON, MATRIX),
    "matrix sheared": (matrix(m01=2e-4), JSON, MATRIX),
    "matrix mirrored": (matrix(m00=-1), JSON, MATRIX),
    "matrix last row": (matrix(m32=1), JSON, MATRIX),
    # the times
    "time not finite": (change_frame(time=float("nan")), JSON, "frames[1].time"),
    "time is true": (change_frame(time=True), JSON, "frames[1].time"),
    "time for some": (drop_from_frame("time"), JSON, "frames[1].time"),
    "time not in test": (drop_from_frame("time", "test"), TEST, "frames[0].time"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_is_one_line_that_names_file_and_field(fault, tiny, capfd):
    """Catches a fault let through, a stack trace, a message without its place, and lines of OpenCV or libpng."""
    apply, file, field = FAULTS[fault]
    apply(tiny)
    with pytest.raises(InputError) as caught:
        scenes.load(tiny)
    check_message(caught.value, file, field)
    assert capfd.readouterr() == ("", "") or fault == "png with too few rows"  # which libpng tells itself


def test_tiny_is_right_unless_broken(tiny):
    """Catches cases above that fail for one and the same fault, and a rotation just below 1e-4 that is refused."""
    matrix(m01=5e-5)(tiny)
    assert len(scenes.load(tiny).train) == 2


ARGUMENTS: list[tuple[dict[str, Any], tuple[str, ...]]] = [
    *(({"downscale": factor}, ("downscale", str(factor))) for factor in (16, 0, -1, 1.5, True)),
    *(({"background": color}, ("background",)) for color in ((0, 0), (0, 0, 2.0), (0, 0, float("nan")))),
    *(({"path": path}, ("the path of a scene's folder",)) for path in ("a\0b", "a\nb", "x" * 5000, "/dev/null/x", 7)),
    ({"frames": (0, 1)}, ("frames: transforms_train.json lists its own frames",)),
    ({"leave_out": ["cam13"]}, ("leave_out: transforms_train.json has no names of cameras",)),
    ({"repair": ["Tiny_undist_00101_09"]}, ("repair: transforms_train.json has no frame before",)),
    ({"resize": "pilow"}, ("resize 'pilow' is not known. Did you mean 'pillow'",)),
]


@pytest.mark.parametrize(("arguments", "words"), ARGUMENTS)
def test_a_wrong_argument_is_refused(tiny, arguments, words):
    """Catches a factor without a pixel, another colour or protocol, a system's error, and another layout's option."""
    with pytest.raises(InputError) as caught:
        scenes.load(**{"path": tiny, **arguments})
    check_message(caught.value, *words)


def test_memory_is_asked_for_before_an_image_is_decoded(tiny, monkeypatch):
    """Catches images of a few kilobytes that fill the memory with gigabytes of pixels, and a message without sizes."""
    for name in IMAGES:
        (tiny / name).write_bytes(png(8192, 8192, b""))
    monkeypatch.setattr(images, "decode_photo", lambda *_: pytest.fail("decoded"))
    monkeypatch.setattr(memory, "available", lambda: int(4.5 * 2**30))
    with pytest.raises(TooLargeError) as caught:
        scenes.load(tiny)
    check_message(caught.value, "4 images of 8192x8192", "need 5.0 GiB of memory, 4.5 GiB are available", "downscale")


def test_images_are_decoded_by_as_many_threads_as_memory_allows(monkeypatch):
    """Catches threads that together take more than there is: 4 images of 3 GiB in all are kept, 4 GiB decode one."""
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    for free, threads in ((7, 1), (10.9, 1), (11, 2), (10**6, 64)):
        for module in (memory, images):
            monkeypatch.setattr(module, "available", lambda free=free: int(free * 2**30))
        assert images.count_readers((8192, 8192), 4, 1, "x.png") == threads


@pytest.mark.parametrize("name", ["nothing", "empty"])
def test_nothing_known_in_the_folder(tmp_path, name):
    """A wrong path is the commonest fault: says what was looked for, the layout, where such data is published."""
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError) as caught:
        scenes.load(tmp_path / name)
    check_message(caught.value, name, JSON, "transforms_{train,val,test}.json", "github.com/albertpumarola/D-NeRF")


GOOD_PNG = (folder() / "suzanne" / "test" / "r_000.png").read_bytes()


@given(st.integers(0, len(GOOD_PNG) - 5), st.integers(0, 255))  # the last 4 are the checksum of an empty chunk
def test_a_damaged_png_is_refused(at, flip):
    """Catches a changed byte that becomes wrong pixels in a lenient decoder, and missing rows that come out black."""
    data = bytearray(GOOD_PNG)
    data[at] ^= flip
    with pytest.raises(InputError):
        images.decode_photo(bytes(data if flip else data[:at]), "x.png")


BOMB = zlib.compress(bytes(10**8))
CHUNKS = [
    (b"PLTE", bytes(768)),
    (b"PLTE", b"\0"),
    (b"tRNS", bytes(6)),
    (b"gAMA", bytes(4)),
    (b"iCCP", b"a\0\0" + BOMB),
    (b"zTXt", b"a\0\0" + BOMB),
    (b"iTXt", b"a\0\1\0\0\0" + BOMB),
    (b"eXIf", b"MM\0*" + bytes(20)),
    (b"IDAT", b"\xff" * 20),
    (b"acTL", struct.pack(">II", 2**31 - 1, 0)),
    (b"ABCD", bytes(8)),
    (b"abCd", bytes(8)),
]


@given(
    st.sampled_from([(8, 6), (1, 1), (4096, 1), (0, 6), (65_536, 8), (2**31 - 1, 1), (2**32 - 1, 2**32 - 1)]),
    st.sampled_from([2, 6, 3, 0, 4, 7]),
    st.sampled_from([8, 16, 1, 3, 255]),
    st.none() | st.sampled_from(CHUNKS),
    st.integers(0, 500),
)
@example((8, 6), 6, 8, None, 6 * 33)
def test_a_png_of_any_header_is_an_image_or_refused(size, color, depth, extra, zeros):
    """Catches any other exception of a decoder, a text that unpacks to gigabytes, and an image of another size."""
    data = png(*size, bytes(zeros), color, depth, chunk(*extra) if extra else b"")
    try:
        pixels = images.decode_photo(data, "x.png")
    except InputError as error:
        check_message(error)
        assert (size, color, depth, zeros) != ((8, 6), 6, 8, 6 * 33) or extra
    else:
        assert pixels.shape[:2] == size[::-1]
        assert pixels.shape[2] in (3, 4)


@pytest.mark.parametrize("seed", range(80))
def test_any_damage_is_an_input_error_or_a_scene(tiny, seed):
    """Catches any other exception, a hang, and cameras, images or times that are wrong, whatever the files hold."""
    r = random.Random(seed)
    for name in r.sample((JSON, VAL, TEST, *IMAGES), r.choice((1, 1, 2))):
        print(damage_file(r, tiny / name))
    try:
        scene = scenes.load(tiny)
    except InputError as error:
        check_message(error)
        return
    assert np.isfinite(scene.extent)
    assert all(getattr(scene, split) for split in COUNTS)
    for view in (*scene.train, *scene.val, *scene.test):
        camera = view.camera
        assert view.image.shape == (camera.height, camera.width, 3)
        assert ((view.image >= 0) & (view.image <= 1)).all()
        assert (camera.K[[0, 1], [0, 1]] > 0).all()
        assert camera.K.isfinite().all()
        assert camera.viewmat.isfinite().all()
        assert view.time is None or 0 <= view.time <= 1

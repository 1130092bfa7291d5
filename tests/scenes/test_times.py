"""Which number of a name is the time: the kinds of names that captures have, fixed and moving cameras, and tables."""

from collections.abc import Callable, Sequence
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from capture import circle

from gsbench.errors import InputError
from gsbench.scenes import times

SOURCE = Path("images.txt")
CAMERAS, FRAMES = 4, 5


def fixed(names: Callable[[int, int], str], seed: int = 0) -> tuple[list[str], np.ndarray, list[float]]:
    """Names and poses of a rig of fixed cameras in random order, and the true times."""
    listed = [(camera, frame) for camera in range(CAMERAS) for frame in range(FRAMES)]
    listed = [listed[i] for i in np.random.default_rng(seed).permutation(len(listed))]
    poses = circle(CAMERAS)[[camera for camera, _ in listed]]
    return [names(*single) for single in listed], poses, [f / (FRAMES - 1) for _, f in listed]


def nudged(viewmats: np.ndarray) -> np.ndarray:
    """Poses that differ a little for each image, as COLMAP estimates them."""
    moved = viewmats.copy()
    moved[:, :3, 3] += 1e-3 * np.random.default_rng(1).standard_normal((len(moved), 3))
    return moved


def of_names(names: Sequence[str], viewmats: np.ndarray) -> times.Times:
    return times.of_names(times.NamedImages(names, viewmats, [0] * len(names), SOURCE))


def of_table(data: bytes, names: Sequence[str], cameras: int = 1) -> times.Times:
    """The times of images of one camera that stands still, or of one that moves."""
    viewmats = circle(cameras) if cameras > 1 else np.tile(np.eye(4), (len(names), 1, 1))
    return times.of_table(data, Path("times.csv"), times.NamedImages(names, viewmats, [0] * len(names), SOURCE))


FORMS: dict[str, Callable[[int, int], str]] = {
    "frame_0003/cam01": lambda c, f: f"frame_{f:04d}/cam{c:02d}.png",
    "cam01/frame_0003": lambda c, f: f"cam{c:02d}/frame_{f:04d}.png",
    "frame_0003_cam01": lambda c, f: f"frame_{f:04d}_cam{c:02d}.png",
    "cam01_0003": lambda c, f: f"cam{c:02d}_{f:04d}.jpg",
    "3/1": lambda c, f: f"{f}/{c}.png",
    "1/3": lambda c, f: f"{c}/{f}.png",
    "0003_cam01_1080p": lambda c, f: f"{f:04d}_cam{c:02d}_1080p.png",
    "00003_left": lambda c, f: f"{f:05d}_{'abcd'[c]}.png",
    "left/00003": lambda c, f: f"{'abcd'[c]}/{f:05d}.png",
    "cam01/t=0.75": lambda c, f: f"cam{c}/t={f / 4}.png",
    "cam01/1305031102.175304": lambda c, f: f"cam{c}/13050311{f:02d}.000000.png",
    "cam1/2023-05-01_12-30-59": lambda c, f: f"cam{c}/2023-05-01_12-{29 + (f + 57) // 60}-{(f + 57) % 60:02d}.png",
    "frame_0003/0003_cam01": lambda c, f: f"frame_{f:04d}/{f:04d}_cam{c:02d}.png",
    "frame-000003.color": lambda c, f: f"view{c}/frame-{f:06d}.color.png",
    r"cam01\0003": lambda c, f: f"cam{c:02d}\\{f:04d}.PNG",
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("moves", [False, True])
def test_the_time_of_a_rig(form, moves):
    """Catches the number of the camera taken for the time, in any order of folders, where poses repeat or nearly do."""
    names, viewmats, expected = fixed(FORMS[form])
    timed = of_names(names, nudged(viewmats) if moves else viewmats)
    assert timed.values == pytest.approx(expected)
    (note,) = timed.notes
    assert note.startswith("times: ")
    assert "scaled to [0, 1]" in note


COUNTS: dict[str, tuple[Callable[[int, int], str], bool]] = {  # names, and whether poses of a camera differ
    "films one after another": (lambda c, f: f"{c * FRAMES + f:05d}.png", False),
    "moments one after another": (lambda c, f: f"{f * CAMERAS + c:05d}.png", False),
    "each camera its own": (lambda c, f: f"cam{c}/IMG_{1000 * c + f:04d}.png", True),
    "clocks that differ by 1 ms": (lambda c, f: f"cam{c}/{1683000000000 + 40 * f + c}.png", False),
}


@pytest.mark.parametrize("kind", COUNTS)
def test_counts_that_cameras_do_not_share_are_asked_about(kind):
    """Catches films that are read as one after another in silence, and a question where clocks differ a little."""
    form, moves = COUNTS[kind]
    names, viewmats, _ = fixed(form)
    notes = of_names(names, nudged(viewmats) if moves else viewmats).notes[1:]
    assert len(notes) == ("clocks" not in kind)
    assert all("no two of 4 cameras or takes have the same time" in note for note in notes)


def clock(form: str, seconds: float = 1.0, cut: int = 0) -> Callable[[int], str]:
    """Names with a date or time of day that pass midnight; `cut`: decimals to leave out."""
    start = datetime(2023, 4, 30, 23, 59, 55)

    def write(i: int) -> str:
        text = (start + timedelta(seconds=seconds * i)).strftime(form)
        return f"{text[: len(text) - cut]}.jpg"

    return write


MOVING: dict[str, Callable[[int], str]] = {
    "IMG_0003": lambda i: f"IMG_{i:04d}.JPG",
    "clip_0003_1080p": lambda i: f"clip_{i:04d}_1080p.png",
    "4k_0003": lambda i: f"video_4k_{i:04d}.png",
    "r_3": lambda i: f"r_{i}.png",
    "1305031102.175304": lambda i: f"{1305031102.95 + i / 10:.6f}.png",
    "nanoseconds": lambda i: f"{1403636579763555584 + 100 * i}.png",
    "IMG_20230501_123059": clock("IMG_%Y%m%d_%H%M%S"),
    "20230501123059": clock("%Y%m%d%H%M%S"),
    "20230501_123059_500": clock("%Y%m%d_%H%M%S_%f", 0.5, cut=3),
    "PXL_20230501_123059500": clock("PXL_%Y%m%d_%H%M%S%f", 0.75, cut=3),
    "2023-05-01_12-30-59": clock("2k_%Y-%m-%d_%H-%M-%S"),
    "2023-05-01T12:30:59.500000": clock("%Y-%m-%dT%H:%M:%S.%f", 0.25),
    "2023-05-01": clock("plant 1 %Y-%m-%d", 86400),
    "at 12.30.59": clock("Shot %Y-%m-%d at %H.%M.%S"),
    "12-30-59": lambda i: f"12-{29 + (i + 55) // 60}-{(i + 55) % 60:02d}.png",
    "negative": lambda i: f"t={i - 4}.png",
    "signs": lambda i: f"frame_{i - 4}.png",
    "a dash": lambda i: f"video-{i:03d}.png",
    "take 1.9": lambda i: f"scan_1.{i + 5}.png",
    "a snapshot of VLC": lambda i: f"vlcsnap-2023-05-01-12h{30 + i * 7 // 60:02d}m{i * 7 % 60:02d}s000.png",
    "past noon": lambda i: f"Shot 2023-05-01 at {1 if i > 4 else 12}.{(50 + 2 * i) % 60:02d}.00 PM.png",
    "tenths of seconds": lambda i: f"00-00-{i // 2:02d}.{i % 2 * 5}.png",
    "an exponent": lambda i: f"t_{i * 3e-3:.1e}.png",
    "index and stamp": lambda i: f"{i:04d}_{100 + i / 10:.3f}.png",
}


@pytest.mark.parametrize("form", MOVING)
def test_the_time_of_a_moving_camera(form):
    """Catches the size of the picture, the digits after the point, and the seconds of a clock taken for the time."""
    count = 10
    names = [MOVING[form](i) for i in range(count)]
    assert len(set(names)) == count
    order = np.random.default_rng(0).permutation(count)
    timed = of_names([names[i] for i in order], circle(count)[order])
    assert timed.values == pytest.approx([i / (count - 1) for i in order])


@pytest.mark.parametrize("form", ["frame_0003/cam01", "0003/1"])
def test_two_cameras_that_move(form):
    """Catches the last number, that of the camera, where no pose repeats: words decide, or else the shorter steps."""
    listed = [(f, c) for f in range(8) for c in range(2)]
    path = circle(200)
    viewmats = np.stack([path[f + 100 * c] for f, c in listed])
    write = (lambda f, c: f"frame_{f:04d}/cam{c:02d}.png") if "cam" in form else (lambda f, c: f"{f:04d}/{c}.png")
    assert of_names([write(*single) for single in listed], viewmats).values == pytest.approx([f / 7 for f, _ in listed])


def test_no_time():
    """Catches times from numbers that do not change, from those of a still rig, and from nowhere."""
    for names in ([f"{letter}_1080p.png" for letter in "abcde"], [*"abcde"], [f"cam{i:02d}.png" for i in range(5)]):
        timed = of_names(names, circle(5))
        assert timed.values == [None] * 5
        assert "times: none" in timed.notes[0]


def stereo(count: int) -> np.ndarray:
    """Return poses of two cameras that stand nearer to each other than they move."""
    viewmats = np.repeat(circle(count), 2, 0)
    viewmats[1::2, 0, 3] -= 0.1
    return viewmats


REFUSED: dict[str, tuple[list[str], np.ndarray, str]] = {
    "a camera's number alone": (
        [f"cam{i // 2}_{'ab'[i % 2]}.png" for i in range(8)],
        np.repeat(circle(4), 2, 0),
        "'cam0_a.png' and 'cam0_b.png'.*expected different times",
    ),
    "equal": (
        [f"{i // 2}_{'ab'[i % 2]}.png" for i in range(8)],
        np.tile(circle(1), (8, 1, 1)),
        "'0_a.png' and '0_b.png'.*expected different times",
    ),
    "constant": (
        [f"{'abcd'[i]}_1080p.png" for i in range(4)],
        np.tile(circle(1), (4, 1, 1)),
        "expected different times",
    ),
    "two that contradict": (
        [f"{i}_{(3 * i) % 7}.png" for i in range(7)],
        circle(7),
        "one number that is the time, got 0, 0",
    ),
    "of takes": ([f"{i // 5}_{i % 5}.png" for i in range(10)], np.tile(circle(1), (10, 1, 1)), "one number that is"),
    "chapters": ([f"part{1 + i // 10}/frame_{i % 10:03d}.png" for i in range(20)], circle(40)[:20], "got 0, 1, which"),
    "a stereo rig that drives": ([f"image_0{2 + i % 2}/{i // 2:06d}.png" for i in range(24)], stereo(12), "got 2, 0"),
    "some without": (["a.png", "b_1.png"], circle(2), "'a.png': expected a number in its name"),
    "of two forms": (["IMG_20230501_123059.jpg", "IMG_20230501_123059_1.jpg"], circle(2), "expected names of one form"),
    "endless": (["9" * 5000, "1"], circle(2), "expected a time"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_contradictory_names_are_refused(kind):
    """Catches views of one camera at one time, and a guess where several numbers change."""
    names, viewmats, words = REFUSED[kind]
    with pytest.raises(InputError, match=words) as caught:
        of_names(names, viewmats)
    assert "\n" not in str(caught.value)
    assert "times.csv" in str(caught.value) or kind == "endless"


def test_digits_beyond_a_float_count():
    """Catches nanoseconds of a clock that are rounded, and a number of thousands of decimals that stops Python."""
    names = [f"{10**18 + i}.png" for i in range(3)]
    assert of_names(names, circle(3)).values == [0, 0.5, 1]
    assert of_names(["0." + "1" * 5000, "1.0", "0.0"], circle(3)).values[1:] == [1, 0]


TABLES = {
    "plain": "name,time\na.png,1\nb.png,2\nc.png,4\n",
    "case": "Name,TIME\na.png,1\nb.png,2\nc.png,4",
    "blank lines": "\nname,time\n\na.png,1\nb.png,2\n  \nc.png,4\n\n,\n",
    "spaces": " name , time \n a.png , 1 \nb.png, 2\nc.png,4 ",
    "another column": "frame,name,time,note\n0,a.png,1,x\n1,b.png,2,\n2,c.png,4,y\n",
    "byte order mark": "\ufeffname,time\na.png,1\nb.png,2\nc.png,4\n",
    "semicolons": "name;time\na.png;1,0\nb.png;2,0\nc.png;4,0\n",
    "tabs": "name\ttime\na.png\t1\nb.png\t2\nc.png\t4\n",
    "carriage returns": "name,time\r\na.png,1\r\nb.png,2\r\nc.png,4\r\n",
    "without suffix": "name,time\na,1\nb,2\nc,4\n",
    "with the folder": "name,time\nimages/a.png,1\n./b.png,2\nimages\\c.png,4\n",
    "another suffix": "name,time\na.jpg,1\nb.JPG,2\nc.jpeg,4\n",
    "quotes": '"name","time"\n"a.png","1"\n"b.png","2"\n"c.png","4"\n',
    "nanoseconds": "name,time\na.png,1700000000000000001\nb.png,1700000000000000002\nc.png,1700000000000000004\n",
    "rows of others": "name,time\na.png,1\nb.png,2\nc.png,4\nd.png,99\n",
}


@pytest.mark.parametrize("kind", TABLES)
def test_tables_as_programs_write_them(kind):
    """Catches a table that is refused for what a spreadsheet adds to it."""
    timed = of_table(TABLES[kind].encode(), ["a.png", "b.png", "c.png"])
    assert timed.values == pytest.approx([0, 1 / 3, 1])
    assert ("left out" in timed.notes[0]) == (kind == "rows of others")
    assert ("'frame, note'" in timed.notes[0]) == (kind == "another column")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("name,time,time\na,1,1\n", "first line name,time"),
        ("name;time\na;1\nb\n", "line 3: expected a name"),
        ("name,time\na,1_0\nb,2\n", "line 2: expected a time"),
        ("name,time\na,1\nb,1\nc,2\n", "'a' and 'b': expected different times"),
        ("name,time\na,1\nb,2\n", "got none of 'c'"),
    ],
)
def test_a_table_that_contradicts_itself_is_refused(content, words):
    """Catches two images of one camera at one time, and a row of another length."""
    with pytest.raises(InputError, match=words):
        of_table(content.encode(), ["a", "b", "c"])


def test_a_table_of_any_case_is_read_and_a_tiny_exponent_ends(tmp_path):
    """Catches Times.CSV that is left out in silence, a number whose exact value has a hundred million digits, and a
    division by zero where all times are equal, as of many cameras at one moment."""
    (tmp_path / "Times.CSV").write_text("name,time\na,1e-99999999\nb,1\n")
    timed, digests = times.of_images(tmp_path, times.NamedImages(["a", "b"], circle(2), [0, 1], SOURCE))
    assert timed.values == [0, 1]
    assert list(digests) == ["Times.CSV"]
    timed = of_table(b"name,time\na,3\nb,3\n", ["a", "b"], cameras=2)
    assert timed.values == [None, None]


def test_fields_are_scaled_over_all_files():
    """Catches splits that are scaled apart, times in [0, 1] that are changed, and seconds beside shares of the clip."""
    assert times.of_fields({"a": [0.0, 0.7], "b": [0.1]}) == ({"a": [0.0, 0.7], "b": [0.1]}, [])
    timed, (note,) = times.of_fields({"a": [0.0, 0.3], "b": [0.1]})
    assert timed == {"a": [0.0, 0.3], "b": [0.1]}
    assert "0 to 0.3, as written" in note
    timed, (note,) = times.of_fields({"a": [0.0, 30.0], "b": [15.0, 40.0]})
    assert timed == {"a": [0, 0.75], "b": [0.375, 1]}
    assert "0 to 40" in note
    assert times.of_fields({"a": [-1.0, 1.0]})[0] == {"a": [0, 1]}
    assert times.of_fields({"a": [0.5, 0.5], "b": [0.5]})[0] == {"a": [None, None], "b": [None]}
    with pytest.raises(InputError, match="b: time: expected the unit of the other files"):
        times.of_fields({"a": [0.0, 59.0], "b": [0.0, 0.5, 1.0]})


def test_places_do_not_depend_on_the_unit():
    """Catches a tolerance in world units: one place for all cameras of a small scene, or many for one far away."""
    for factor in (1e-4, 1, 1e5):
        viewmats = np.repeat(circle(6), 2, 0)
        viewmats[:, :3, 3] *= factor
        viewmats[1::2, :3, 3] *= 1 + 1e-9
        names = [""] * 12
        places = times.NamedImages(names, viewmats, [0] * 12, SOURCE).places
        assert len(set(places)) == 6
        assert places[::2] == places[1::2]
        assert len(set(times.NamedImages(names, viewmats, [0, 1] * 6, SOURCE).places)) == 12

"""Determine the times of views: from numbers in the names of images, from times.csv, or from fields of a file.

Names have numbers of frames, of cameras, of takes and of pixels. Which one is the time follows from the cameras: images
with the same pose and intrinsics are of one fixed camera, whose own number is constant there and whose time is not.
Times that cannot be determined raise `InputError`.
"""

import csv
import os
import re
from collections import defaultdict
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from fractions import Fraction
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsbench.errors import InputError
from gsbench.reading import read_file
from gsbench.scenes.files import digest, number, without_suffix

TABLE = "times.csv"
_MAX_TABLE = 1 << 26  # bytes of times.csv
_LARGEST = 1e30  # the largest time, in any unit
_SMALLEST = 1e-30  # the smallest number that is read exactly: the digits of 1e-99999999 would fill the memory
_LONGEST = 100  # digits of a number that is read exactly
_SAME_PLACE = 6  # decimals, relative to the radius of the cameras: poses that agree to them are one place
_CLEARLY = 10.0  # a camera moves this many times less between neighbouring times than between cameras
_SHORT = 0.5  # times in [0, 1] that cover less may be in another unit
_FEW = 0.1  # a file whose times lie in [0, 1], a smaller share of all times than this, has another unit than the others
_WHOLE = re.compile(r"(?:(?<![^=/_])-)?[0-9]+")  # "-" is a sign at the start and after = / _
_DECIMAL = re.compile(_WHOLE.pattern + r"(?:\.[0-9]+(?:[eE][-+][0-9]{1,2}(?![0-9]))?)?")
# Groups: H M S hours, minutes, seconds; f, g digits of the fraction, g only behind a point; Y m D the date; c, d repeat
_CLOCK = (
    r"(?P<H>[01]\d|2[0-3])(?P<c>{})(?P<M>[0-5]\d)(?P=c)(?P<S>[0-5]\d)"
    r"(?:[-_.,]?(?P<f>\d{{3}}|\d{{6}}|\d{{9}})|[.,](?P<g>\d{{1,9}}))?(?!\d)"
)
_TWELVE = r"(?P<H>0?[1-9]|1[0-2])(?P<c>[-_.:])(?P<M>[0-5]\d)(?P=c)(?P<S>[0-5]\d).?(?P<half>[AaPp])[Mm]"
_LETTERS = r"(?P<H>\d{1,2})h(?P<M>[0-5]?\d)m(?P<S>[0-5]?\d)s(?P<f>\d{3}|\d{6}|\d{9})?(?!\d)"
_DATE = r"(?<!\d)(?P<Y>(?:19|20)\d\d)(?P<d>[-_.]?)(?P<m>0[1-9]|1[0-2])(?P=d)(?P<D>0[1-9]|[12]\d|3[01])"
_MOMENTS = (
    re.compile(_DATE + r"(?:[-_ T]| at )?" + _TWELVE, re.ASCII),  # 2023-05-01 at 1.30.59 PM
    re.compile(_DATE + r"(?:[-_ T]| at )?" + _CLOCK.format("[-_.:]?"), re.ASCII),  # 2023-05-01_12-30-59
    re.compile(_DATE + r"(?:[-_ T]| at )?" + _LETTERS, re.ASCII),  # 2023-05-01-12h30m59s123
    re.compile(r"(?<!\d)" + _CLOCK.format("[-:]"), re.ASCII),  # 12-30-59
    re.compile(r"(?<!\d)" + _LETTERS, re.ASCII),  # 12h30m59s
    re.compile(_DATE + r"(?!\d)", re.ASCII),  # 2023-05-01
)
_CAMERA_WORDS = ("cam", "camera")
_TIME_WORDS = ("frame", "f", "time", "timestamp", "t")


@dataclass(frozen=True)
class Times:
    """Hold the time of each view in [0, 1], or None for each, and sentences that say where they are from."""

    values: list[float | None]
    notes: list[str]


@dataclass(frozen=True)
class _Number:
    """Hold a number in a name."""

    value: Fraction
    label: str  # the text before it, from the number before or from the folder on
    is_moment: bool = False  # a date or a time of day, or both, in seconds

    @property
    def word(self) -> str:
        """The last word before the number, in lower case."""
        return (re.findall("[a-z]+", self.label.lower()) or [""])[-1]


@dataclass(frozen=True)
class _Column:
    """Hold the numbers at the same place of all names."""

    numbers: tuple[_Number, ...]
    place: int  # from 1
    count: int  # of numbers in the first name

    @property
    def values(self) -> list[Fraction]:
        """The numbers without their labels."""
        return [number.value for number in self.numbers]

    @property
    def words(self) -> set[str]:
        """The words before the numbers."""
        return {number.word for number in self.numbers}

    @cached_property
    def order(self) -> list[int]:
        """The indices of the images in the order of the numbers."""
        return sorted(range(len(self.numbers)), key=self.values.__getitem__)


@dataclass(frozen=True)
class NamedImages:
    """Hold what tells the times of images: their names and cameras."""

    names: Sequence[str]  # with folders
    viewmats: NDArray[np.float64]  # [N, 4, 4] world to camera
    lenses: Sequence[Hashable]  # what is equal for equal intrinsics
    source: Path  # the file that names the images, for messages

    @cached_property
    def poses(self) -> NDArray[np.float64]:  # [N, 12]
        """Rotations, and positions relative to the radius of the cameras, so that a scene's unit does not matter."""
        rotations = self.viewmats[:, :3, :3]
        centers = -np.einsum("nji,nj->ni", rotations, self.viewmats[:, :3, 3])  # -R^T t
        centers -= centers.mean(0)
        radius = np.linalg.norm(centers, axis=1).max() or 1.0
        return np.concatenate([rotations.reshape(-1, 9), centers / radius], 1)

    @cached_property
    def places(self) -> list[Hashable]:
        """A key of each image, equal for images with the same pose and intrinsics: those of a fixed camera."""
        poses = np.round(self.poses, _SAME_PLACE) + 0.0  # -0 becomes 0
        return [(pose.tobytes(), lens) for pose, lens in zip(poses, self.lenses, strict=True)]

    @property
    def has_fixed_camera(self) -> bool:
        """Whether two images have the same pose and intrinsics."""
        return len(set(self.places)) < len(self.places)


def of_images(root: Path, images: NamedImages) -> tuple[Times, dict[str, str]]:
    """Return the times from times.csv in `root` and its SHA-256 by its name; without it those from names, and {}."""
    path = table_of(root)
    if path is None:
        return of_names(images), {}
    data = read_file(path, str(path), _MAX_TABLE)
    return of_table(data, path, images), {path.name: digest(data)}


def table_of(root: Path) -> Path | None:
    """Return the path of times.csv in a scene's folder, in any case; None if there is none."""
    names = sorted(name for name in os.listdir(root) if name.lower() == TABLE)
    return root / (TABLE if TABLE in names else names[0]) if names else None


def of_names(images: NamedImages) -> Times:
    """Return the time of each image from a number in its name, scaled to [0, 1]; None for all without such numbers."""
    columns, none = _columns(images), [None] * len(images.names)
    changing = [column for column in columns if len(set(column.values)) > 1]
    if not changing:
        if columns:  # all numbers are equal: then no camera may have two images
            check_distinct(images, [Fraction(0)] * len(images.names), images.source)
        why = "the numbers in the names do not change" if columns else "the names have no numbers"
        return Times([*none], [f"times: none, as {why} and there is no {TABLE}"])
    column = _time_among(changing, images)
    if column is None:
        note = f"times: none, as the names have only the number of the camera; write {TABLE} if the scene moves"
        return Times([*none], [note])
    check_distinct(images, column.values, images.source)
    apart = _apart(column, [other for other in changing if other is not column], images)
    return Times([*_scaled(column.values)], [_described(column, images.names), *apart])


def of_table(data: bytes, path: Path, images: NamedImages) -> Times:  # data: of times.csv
    """Return the time of each image from times.csv, scaled to [0, 1]; None for all if all times are equal.

    The table has a first line with `name` and `time`, in any case and order. Columns are separated by commas,
    semicolons or tabs. Blank lines, other columns and rows of other images are left out. Names may lack their suffix.
    """
    try:
        lines = data.decode("utf-8-sig").splitlines()
        head = next((line for line in lines if line.strip()), "")
        separator = next((mark for mark in ",;\t" if mark in head), ",")
        rows = [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=separator, strict=True)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: expected a table name,time: {error}", docs="data.md#times") from None
    filled = [(line_number, row) for line_number, row in enumerate(rows, 1) if any(row)]
    columns = [cell.lower() for cell in filled[0][1]] if filled else []
    if any(columns.count(key) != 1 for key in ("name", "time")):
        raise InputError(
            f"{path}: expected the first line name,time, got {','.join(columns)[:60]!a}", docs="data.md#times"
        )
    table: dict[str, Fraction] = {}
    for line, row in filled[1:]:
        cells = dict(zip(columns, row, strict=False))
        name, text = cells.get("name", ""), cells.get("time", "")
        is_whole = len(row) >= len(columns) and not any(row[len(columns) :])  # empty cells may follow
        if not is_whole or not name or name in table:
            raise InputError(f"{path}: line {line}: expected a name, once, and its time, got {','.join(row)[:60]!a}")
        table[name] = _exact(text.replace(",", ".") if separator == ";" else text, f"{path}: line {line}")
    by_loose: dict[str, str] = {}
    for name in table:
        by_loose.setdefault(_loose(name), name)
    used = [name if name in table else by_loose.get(_loose(name), "") for name in images.names]  # "": no row
    missing = next((name for name, row in zip(images.names, used, strict=True) if not row), None)
    if missing is not None:
        raise InputError(
            f"{path}: expected a time of each image of the model, got none of {missing[:80]!a}: add it",
            docs="data.md#times",
        )
    values = [table[name] for name in used]
    spare = len(table) - len(set(used))
    rest = f"; {spare} rows of other images are left out" if spare else ""
    others = [name for name in columns if name not in ("name", "time")]
    rest += f"; columns that are not read: {', '.join(others)[:60]!a}" if any(others) else ""
    if len(set(values)) == 1:
        return Times([None] * len(used), [f"times: none, as all times of {TABLE} are equal{rest}"])
    check_distinct(images, values, path)
    first, last = float(min(values)), float(max(values))
    return Times([*_scaled(values)], [f"times: {TABLE}, {first:.10g} to {last:.10g}, scaled to [0, 1]{rest}"])


def of_fields(
    values: Mapping[str, Sequence[float]],  # the field `time` of each frame, by the file that has it
) -> tuple[dict[str, list[float | None]], list[str]]:
    """Return the times of each file's frames in [0, 1], and sentences on what was done.

    Times in [0, 1] stay as they are; a sentence says so if they cover less than half of it. Others, such as seconds or
    numbers of frames, are scaled over all files together. If all are equal, the scene has no times.
    """
    all_times = [value for times in values.values() for value in times]
    first, last = min(all_times), max(all_times)
    if first == last and len(all_times) > 1:
        none: dict[str, list[float | None]] = {file: [None] * len(times) for file, times in values.items()}
        return none, [f"times: none, as all times are {first:.10g}"]
    if first >= 0 and last <= 1:
        short = f"times: the field 'time', {first:.10g} to {last:.10g}, as written, since they lie in [0, 1]"
        return {file: [*times] for file, times in values.items()}, [short] if last - first < _SHORT else []
    for file, times in values.items():
        is_small = 0 <= min(times) < max(times) <= 1
        if is_small and max(times) - min(times) < _FEW * (last - first):
            raise InputError(
                f"{file}: time: expected the unit of the other files, got {min(times):.10g} to "
                f"{max(times):.10g}, and over all files {first:.10g} to {last:.10g}: scale all to [0, 1]",
                docs="data.md#times",
            )
    scaled = iter(_scaled([Fraction(value) for value in all_times]))
    note = f"times: the field 'time', {first:.10g} to {last:.10g}, scaled to [0, 1] over all splits"
    return {file: [next(scaled) for _ in times] for file, times in values.items()}, [note]


def check_distinct(
    images: NamedImages,
    times: Sequence[float | Fraction | None],
    source: Path,  # the file that has the times
    cure: str = f"write {TABLE}, or correct it",
) -> None:
    """Raise InputError if two images of a fixed camera have the same time."""
    first: dict[tuple[Hashable, float | Fraction], str] = {}
    for name, time, place in zip(images.names, times, images.places, strict=True):
        other = name if time is None else first.setdefault((place, time), name)  # the first image there and then
        if other != name:
            raise InputError(
                f"{source}: images {other[:80]!a} and {name[:80]!a}: expected different times, as their "
                f"pose and intrinsics are equal, got the same: {cure}",
                docs="data.md#times",
            )


def _columns(images: NamedImages) -> list[_Column]:
    """Return the numbers that all names have, place by place from the right."""
    names, source = images.names, images.source
    numbers = _numbers(names, source)
    least = min(len(row) for row in numbers)
    if not least and any(numbers):
        name = next(name for name, row in zip(names, numbers, strict=True) if not row)
        raise InputError(
            f"{source}: image {name[:80]!a}: expected a number in its name, as others have: rename it, or "
            f"write {TABLE}",
            docs="data.md#times",
        )
    columns = [
        _Column(tuple(row[at] for row in numbers), len(numbers[0]) + at + 1, len(numbers[0])) for at in range(-least, 0)
    ]
    # Names may have more numbers before those that all have, if the texts between those are the same in all names.
    if len({len(row) for row in numbers}) > 1 and any(len({n.label for n in column.numbers}) > 1 for column in columns):
        few, many = (
            next(name for name, row in zip(names, numbers, strict=True) if len(row) == count)
            for count in (least, max(map(len, numbers)))
        )
        raise InputError(
            f"{source}: images {few[:60]!a} and {many[:60]!a}: expected names of one form, the first has "
            f"fewer numbers: rename them, or write {TABLE}",
            docs="data.md#times",
        )
    return columns


def _numbers(names: Sequence[str], source: Path) -> list[list[_Number]]:
    """Return the numbers in the name of each image, such as 3 and 12 of cam3/frame_12.png, in their order.

    If every name has one date or time of day, or both, its digits together are one number, in seconds.
    """
    plain = [without_suffix(name.replace("\\", "/")) for name in names]
    moments: list[re.Match[str] | None] = [None] * len(names)
    for form in _MOMENTS:
        matches = [list(form.finditer(name)) for name in plain]
        if all(len(of_name) == 1 for of_name in matches):
            moments = [of_name[0] for of_name in matches]
            break
    pattern = _DECIMAL if _have_decimals(plain) else _WHOLE
    by_name = []
    for name, moment in zip(plain, moments, strict=True):
        of_name, label_start = [], 0
        for start, end in _spans(name, moment, pattern):
            label = name[label_start:start].rpartition("/")[2]
            is_moment = moment is not None and (start, end) == moment.span()
            value = (
                _seconds(moment, source)
                if moment and is_moment
                else _exact(name[start:end], f"{source}: image {name[start:end][:40]}")
            )
            of_name.append(_Number(value, label, is_moment))
            label_start = end
        by_name.append(of_name)
    return by_name


def _spans(name: str, moment: re.Match[str] | None, pattern: re.Pattern[str]) -> list[tuple[int, int]]:
    """Return where the numbers of a name begin and end; those inside its date and time of day are one number."""
    spans = [match.span() for match in pattern.finditer(name)]
    if moment is None:
        return spans
    begin, end = moment.span()
    return sorted([*((a, b) for a, b in spans if b <= begin or a >= end), (begin, end)])


def _have_decimals(names: Sequence[str]) -> bool:
    """Return whether a point between digits is a decimal point, and not, as in 1.9 and 1.10, one between two numbers.

    Decimals are written with as many digits in all names, or without zeros at their ends.
    """
    decimals = [part for name in names for part in re.findall(r"[0-9]\.([0-9]+)", name)]
    return len({len(part) for part in decimals}) < 2 or not any(len(part) > 1 and part[-1] == "0" for part in decimals)


def _seconds(moment: re.Match[str], source: Path) -> Fraction:
    """Return a date or a time of day, or both, in seconds."""
    fields = moment.groupdict()
    digits = fields.get("f") or fields.get("g") or ""  # of the fraction of a second
    fraction = Fraction(int(digits or 0), 10 ** len(digits))
    try:
        year, month, day = (int(fields.get(key) or 1) for key in "YmD")  # any day, if the names have none
        days = date(year, month, day).toordinal()
    except ValueError:
        raise InputError(
            f"{source}: image {moment.group()[:40]!a}: expected a date: rename it, or write {TABLE}",
            docs="data.md#times",
        ) from None
    hour, minute, second = (int(fields.get(key) or 0) for key in "HMS")  # 0: the names have dates alone
    if half := fields.get("half"):
        hour = hour % 12 + 12 * (half in "Pp")
    return days * 86400 + hour * 3600 + minute * 60 + second + fraction


def _exact(text: str, where: str) -> Fraction:
    """Convert a number exactly: nanoseconds of a clock have more digits than a float."""
    value = number(text, _LARGEST, f"{where}: expected a time")
    is_short = len(text) < _LONGEST and abs(value) >= _SMALLEST
    return Fraction(text) if is_short else Fraction(value)


def _time_among(changing: list[_Column], images: NamedImages) -> _Column | None:
    """Return the column that is the time; None if the only one is the number of the camera.

    The time changes while a camera stays where it is. Without fixed cameras, words before the numbers decide, then how
    far cameras move from one number to the next.
    """
    candidates = [column for column in changing if _changes_at_a_place(column, images.places)]
    if not candidates:
        if images.has_fixed_camera:  # its images have equal numbers, which is refused
            check_distinct(images, [Fraction(0)] * len(images.names), images.source)
        candidates = [column for column in changing if not column.words & {*_CAMERA_WORDS}]
        if not candidates:
            if len(changing) == 1:
                return None
            candidates = changing
    candidates = _without_copies(candidates)
    if len(candidates) > 1:
        named = [column for column in candidates if column.words <= {*_TIME_WORDS}]
        candidates = named if len(named) == 1 else _steadiest(candidates, changing, images)
    if len(candidates) == 1:
        candidates += _chapters(candidates[0], changing, images)  # then no number alone is the time
    if len(candidates) == 1:
        return candidates[0]
    first_values = ", ".join(f"{float(column.values[0]):.10g}" for column in candidates)
    raise InputError(
        f"{images.source}: image {images.names[0][:80]!a}: expected one number that is the time, "
        f"got {first_values}, which all change from image to image: write {TABLE}",
        docs="data.md#times",
    )


def _changes_at_a_place(column: _Column, places: Sequence[Hashable]) -> bool:
    """Return whether the number changes within the images of a fixed camera."""
    first: dict[Hashable, Fraction] = {}
    return any(first.setdefault(place, value) != value for place, value in zip(places, column.values, strict=True))


def _without_copies(columns: list[_Column]) -> list[_Column]:
    """Leave out columns whose times would be those of a later one, such as frame_0003/0003.png."""
    scaled = [_scaled(column.values) for column in columns]
    return [column for i, column in enumerate(columns) if scaled[i] not in scaled[i + 1 :]]


def _steadiest(candidates: list[_Column], changing: list[_Column], images: NamedImages) -> list[_Column]:
    """Return the column from number to number of which cameras clearly move least; otherwise all candidates.

    Numbers that only repeat the order of each other, such as a frame and its time stamp, leave the one with decimals.
    """
    steps = [_step(column, [other for other in changing if other is not column], images) for column in candidates]
    moving = sorted((step, i) for i, step in enumerate(steps) if step is not None)
    if moving:
        step, best = moving[0][0], candidates[moving[0][1]]
        others = [column for column in changing if column is not best]
        # Two cameras of a rig stand nearer to each other than it moves: a number of few values must be clearer.
        has_fewer = any(len(set(best.values)) < len(set(other.values)) for other in others)
        clearly_more = step * (_CLEARLY**2 if has_fewer else _CLEARLY)
        if len(moving) == 1 or clearly_more < moving[1][0]:
            return [best]
    have_one_order = all(column.order == candidates[0].order for column in candidates)
    decimal = [column for column in candidates if any(value.denominator > 1 for value in column.values)]
    return decimal if not moving and have_one_order and len(decimal) == 1 else candidates


def _step(column: _Column, others: list[_Column], images: NamedImages) -> float | None:
    """Return by how much poses change on average from one number to the next while the rest of the name stays.

    None: no two names differ in this number alone.
    """
    groups: dict[Hashable, list[int]] = defaultdict(list)
    for i, key in enumerate(_rest_of_names(others, images)):
        groups[key].append(i)
    values, distances = column.values, []
    for group in groups.values():
        ordered = sorted(group, key=values.__getitem__)
        distances += [_distance(images, a, b) for a, b in pairwise(ordered)]
    return sum(distances) / len(distances) if distances else None


def _distance(images: NamedImages, a: int, b: int) -> float:
    """Return how far the pose of image number `a` is from that of number `b`."""
    return float(np.linalg.norm(images.poses[a] - images.poses[b]))


def _chapters(column: _Column, changing: list[_Column], images: NamedImages) -> list[_Column]:
    """Return the columns of which each number goes on where the one before ends, such as chapters of a video.

    There both numbers together are the time. The moving camera makes no large step from chapter to chapter.
    """
    others = [other for other in changing if other is not column and not other.words & {*_CAMERA_WORDS}]
    step = _step(column, others, images)
    if step is None or images.has_fixed_camera:
        return []
    chapters = []
    for other in others:
        order = sorted(column.order, key=other.values.__getitem__)  # by chapter, then by number
        jumps = [_distance(images, a, b) for a, b in pairwise(order) if other.values[a] != other.values[b]]
        # The number begins anew in a chapter.
        repeats = len({(other.values[i], column.values[i]) for i in order}) > len(set(column.values))
        if repeats and sum(jumps) < _CLEARLY * step * len(jumps):
            chapters.append(other)
    return chapters


def _scaled(values: Sequence[Fraction]) -> list[float]:
    """Map the first time to 0 and the last, which differs, to 1."""
    first = min(values)
    length = max(values) - first
    return [float((value - first) / length) for value in values]


def _described(column: _Column, names: Sequence[str]) -> str:
    """Return a sentence that says which number of the names is the time, its range and its unit."""
    first, last = float(min(column.values)), float(max(column.values))
    if column.numbers[0].is_moment:
        what, unit = "the clock time", "seconds"
    else:
        what = "the number" if column.count == 1 else f"number {column.place} of {column.count}"
        unit = "decimals" if any(value.denominator > 1 for value in column.values) else "whole numbers"
    ends = f"{last - first:.10g} seconds" if column.numbers[0].is_moment else f"{first:.16g} to {last:.16g} ({unit})"
    at = column.order[0]
    return f"times: {what} in each name, {ends}, scaled to [0, 1]; {names[at][:80]!a} is the first"


def _apart(column: _Column, others: list[_Column], images: NamedImages) -> list[str]:
    """Return a sentence if cameras have no time in common, as where each has its own count, or one count is of all."""
    values = column.values
    is_count = all(value.denominator == 1 for value in values) and max(values) - min(values) < 2 * len(values)
    for keys in (images.places, _rest_of_names(others, images)):  # fixed cameras, or those that names tell apart
        groups: dict[Hashable, list[Fraction]] = defaultdict(list)
        for key, value in zip(keys, values, strict=True):
            groups[key].append(value)
        ends = sorted((min(group), max(group)) for group in groups.values() if len(group) > 1)
        are_apart = all(last < first for (_, last), (first, _) in pairwise(ends))
        is_count_of_all = keys is images.places and is_count and len({*values}) == len(values)
        if len(ends) > 1 and (are_apart or is_count_of_all):
            return [
                f"times: no two of {len(ends)} cameras or takes have the same time: if each camera counts its own "
                f"images, or one count goes over all cameras, write {TABLE}"
            ]
    return []


def _rest_of_names(others: list[_Column], images: NamedImages) -> list[Hashable]:
    """Return a key of each name, equal for names that differ in the number alone that is not among `others`."""
    return [
        (re.sub("[0-9]+", "#", name), *(other.values[i] for other in others)) for i, name in enumerate(images.names)
    ]


def _loose(name: str) -> str:
    """Return the name of an image without suffix, without the folder images/, and with / for backslashes."""
    return without_suffix(name.replace("\\", "/").removeprefix("./").removeprefix("images/"))

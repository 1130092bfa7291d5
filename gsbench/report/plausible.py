"""Tell what of a record cannot be, as somebody may have edited it: a number out of range, a mean not of its views."""

import math
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from itertools import pairwise
from pathlib import Path
from statistics import fmean
from typing import Any

import msgspec

from gsbench.config_roles import flat, without_agr
from gsbench.errors import InputError
from gsbench.measure import record as files
from gsbench.measure.exact_views import MOST_PSNR
from gsbench.measure.record import Record
from gsbench.report.columns import VIEWS

MEASURED = ("metrics", "per_view", "cost", "regions", "on_demand", "stop", "averaged", "length_choice")
RANGES = (  # of a number by its name; the first pattern that fits counts
    ("psnr.*", 0.0, MOST_PSNR),
    ("ssim.*", -1.0, 1.0),
    (r"ms_ssim|dssim\d", 0.0, 1.0),
    ("lpips.*", 0.0, 10.0),
    ("flicker.*|static_drift", 0.0, 255.0),
    (".*_db", -MOST_PSNR, MOST_PSNR),  # changes of PSNR
    ("z", -math.inf, math.inf),
    (".*", 0.0, 1e15),  # seconds, counts, bytes, shares
)
NAMES = {  # what names a run, and the same in its settings
    "experiment": "experiment",
    "dataset": "data.dataset",
    "scene": "scene.name",
    "model": "model.name",  # without _agr or _noagr
    "seed": "seed",
}
Views = Mapping[str, frozenset[str]]  # names of views by data and settings
OF_PIXELS = ("psnr_moving", "psnr_object")  # views without such pixels have none
ROUNDING = 1e-6  # by which a mean may differ from that of its views, and a sum from its parts, relative to it


def read(path: Path) -> Record:
    """Read the record at `path`; an InputError names the field that is not valid or cannot be."""
    record = files.read(path)
    check(record, str(path))
    return record


def views_of_data(records: Iterable[Record]) -> Views:
    """Return which views finished runs evaluate, by their data and settings: those that most runs have, or the most."""
    counts: dict[str, Counter[frozenset[str]]] = defaultdict(Counter)
    for record in records:
        if record.status == "ok":
            counts[_data(record)][_names(record)] += 1
    return {data: max(sets, key=lambda names: (sets[names], len(names))) for data, sets in counts.items()}


def check(record: Record, where: str, views: Views | None = None) -> None:
    """Raise InputError if something of a record cannot be.

    Args:
        record: the record.
        where: the beginning of the message.
        views: those of `views_of_data`.
    """
    why = _implausible(record)
    if not why and views and record.status == "ok":
        expected, names = views[_data(record)], _names(record)
        if names != expected:
            lacking, extra = sorted(expected - names), sorted(names - expected)
            what = lacking[0] if lacking else f"no {extra[0]}"
            why = f"per_view: expected {what}, as in other runs on these data"
    if why:
        raise InputError(f"{where}: {why}: was it edited? delete it, and run again")


def _data(record: Record) -> str:
    """Return what decides which views are evaluated: the data, the split, and the settings of the scene."""
    scene = (record.provenance.config or {}).get("scene")
    return repr((record.dataset, record.scene, record.provenance.data_hash, record.protocol.get("eval_split"), scene))


def _names(record: Record) -> frozenset[str]:
    return frozenset(view.name for view in record.per_view)


def _implausible(record: Record) -> str:
    """Return what of a record cannot be, with its place in record.json; "" if nothing is wrong."""
    measured = {name: msgspec.to_builtins(getattr(record, name)) for name in MEASURED}
    measured |= {"curve": [point._asdict() for point in record.curve], "parts.score": record.parts.get("score")}
    for place, number in _numbers(measured):
        low, high = _range(place.rpartition(".")[2])
        if not low <= number <= high:
            return f"{place}: expected {low:g} to {high:g}, got {number:g}"
    return _of_names(record) or _of_views(record) or _of_seconds(record)


def _of_names(record: Record) -> str:
    """Return which name of a record is not that of its settings; "" if all are."""
    settings = dict(flat(record.provenance.config))
    for name, key in NAMES.items():
        if key not in settings or (name == "model" and record.rendered_elsewhere):
            continue
        here, there = str(getattr(record, name)), str(settings[key])
        if name == "model":
            here, there = without_agr(here), without_agr(there)
        if here != there:
            return f"{name}: expected {there:.80}, as in provenance.config, got {here:.80}"
    return ""


def _of_views(record: Record) -> str:
    """Return what is wrong with the views of a record, or with a metric that is not the mean of theirs."""
    names = [view.name for view in record.per_view]
    if record.status == "ok" and not names:
        return "per_view: expected each evaluated view, got none"
    if len(set(names)) < len(names):
        return f"per_view: expected each view once, got {max(names, key=names.count)} more than once"
    for score in VIEWS.values():
        mean = (record.metrics or {}).get(score)
        values = [value for view in record.per_view if (value := getattr(view, score)) is not None]
        if mean is None or not (values or score == "psnr"):  # early records have only PSNR of their views
            continue
        if len(values) < len(names) and score not in OF_PIXELS:
            return f"per_view: expected {score} of all {len(names)} views, as metrics has it, got it of {len(values)}"
        if not abs(mean - fmean(values)) <= ROUNDING:
            return f"metrics.{score}: expected {fmean(values):g}, the mean of its views, got {mean:g}"
    return ""


def _of_seconds(record: Record) -> str:
    """Return what is wrong with seconds that follow from others; "" if nothing is."""
    cost, ends = record.cost, [point.seconds for point in record.curve]
    if any(later < earlier for earlier, later in pairwise(ends)):
        return "curve: expected rising seconds"
    if cost is None:
        return ""
    p50 = cost.render_ms.p50 if cost.render_ms else 0.0
    follow = {  # by place: the number, and what it follows from
        "cost.train_s": (cost.train_s, math.fsum(cost.stage_s.values()) if cost.stage_s else None, "sum of stage_s"),
        "cost.fps": (cost.fps, 1000 / p50 if p50 else None, "1000 / render_ms.p50"),
    }
    for place, (number, expected, rule) in follow.items():
        if number is not None and expected is not None and not abs(number - expected) <= ROUNDING * expected:
            return f"{place}: expected {expected:g}, the {rule}, got {number:g}"
    if ends and cost.train_s is not None and ends[-1] > cost.train_s * (1 + ROUNDING):
        return f"curve: expected at most {cost.train_s:g} seconds, as cost.train_s, got {ends[-1]:g}"
    return ""


def _numbers(node: Any, place: str = "") -> Iterator[tuple[str, float]]:
    """Yield each number of plain JSON with its place, such as "cost.stage_s.loss"."""
    if isinstance(node, dict):
        for key, value in node.items():
            yield from _numbers(value, f"{place}.{key}".lstrip("."))
    elif isinstance(node, list):
        for i, value in enumerate(node):
            yield from _numbers(value, f"{place}[{i}]")
    elif isinstance(node, int | float):
        yield place, node


@cache
def _range(name: str) -> tuple[float, float]:
    return next((low, high) for pattern, low, high in RANGES if re.fullmatch(pattern, name))

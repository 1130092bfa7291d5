"""Runs with numbers worked by hand, and the tables of the report that are made of them."""

import dataclasses
from pathlib import Path

from make_golden import make

from gsbench.measure.curve import Point
from gsbench.measure.record import Effects, Record, ViewScore
from gsbench.report import frame
from gsbench.report.section import Section
from gsbench.report.sections import built


def run(model="7dgs", seed=0, views=(25.0, 26.0), scene="suzanne", seconds=90.0, **changes) -> Record:
    """A run with the PSNR of its views, and its mean as the metric."""
    base = make("7dgs", scene, seed, sum(views) / len(views))
    scores = [ViewScore(f"test/r_{i:03}", value) for i, value in enumerate(views)]
    cost = dataclasses.replace(base.cost, train_s=seconds)
    return dataclasses.replace(base, **{"model": model, "per_view": scores, "cost": cost} | changes)


def runs_of(model, variant, psnr, seconds, seeds=(0,), scene="suzanne") -> list[Record]:
    """Runs of a model at a variant whose PSNR on val is half a dB above that on test."""
    return [
        run(model, s, (psnr + s / 100, psnr + s / 50), scene, seconds, variant=variant,
            metrics={**make().metrics, "psnr": psnr + s * 0.015}, curve=[Point(1000, seconds, psnr + 0.5)])
        for s in seeds
    ]  # fmt: skip


def three_lengths() -> list[Record]:
    """Model a at 10, 20, 40 s, of which 20 is worse than 10; b at 15 s between them, and at 100 s the best."""
    return [
        *runs_of("a", "", 20.0, 10.0),
        *runs_of("a", "iterations=2", 19.0, 20.0),
        *runs_of("a", "iterations=4", 23.0, 40.0),
        *runs_of("b", "", 19.5, 15.0),
        *runs_of("b", "iterations=9", 25.0, 100.0),
    ]


def lost(record: Record, reason: str = "out of memory") -> Record:
    """The same run, failed."""
    nothing = {"metrics": None, "missing": {}, "cost": None, "per_view": [], "curve": []}
    return dataclasses.replace(record, status="failed", reason=reason, **nothing)


EIGHT = {  # name: effects (time, direction, AGR), dB
    "3dgs": ((0, 0, 0), 20.0),
    "4dgs": ((1, 0, 0), 24.0),
    "6dgs": ((0, 1, 0), 21.0),
    "7dgs_noagr": ((1, 1, 0), 27.0),
    "3dgs_agr": ((0, 0, 1), 20.5),
    "4dgs_agr": ((1, 0, 1), 25.0),
    "6dgs_agr": ((0, 1, 1), 21.5),
    "7dgs": ((1, 1, 1), 29.0),
}


def with_effects(*names: str) -> list[Record]:
    """Three seeds of models of EIGHT."""
    return [
        run(name, seed, (EIGHT[name][1] + seed / 100, EIGHT[name][1] + 1), seconds=10 * EIGHT[name][1] + seed,
            effects=Effects(*map(bool, EIGHT[name][0])))
        for name in names
        for seed in range(3)
    ]  # fmt: skip


def results(*records: Record) -> frame.Results:
    """The tables of records, each at the path where a run writes it."""
    return frame.tables([(Path(record.path) / "record.json", record) for record in records], [])


def chapter(*records: Record) -> frame.Results:
    """The tables of records of one experiment on one data set."""
    (only,) = results(*records).chapters()
    return only


def sections(*records: Record) -> dict[str, Section]:
    """The sections of a report of these records, by key."""
    return {section.key: section for section in built(chapter(*records))}

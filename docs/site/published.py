"""Read the reference records as the reports do, and write their numbers in one form on all pages."""

import functools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from gsbench.measure.curve import FALL
from gsbench.measure.record import Record
from gsbench.report import compare, messages, tables
from gsbench.report.comparisons import comparisons
from gsbench.report.configurations import Configuration, Group, Values, groups
from gsbench.report.family import Family, Tested, Weights
from gsbench.report.intervals import Estimate, estimate, over_seeds

MODELS = ("3dgs", "6dgs", "4dgs", "7dgs_noagr", "7dgs_nodir", "7dgs", "auto")
NAMES = {"7dgs": "7DGS", "7dgs_noagr": "7DGS without AGR", "7dgs_nodir": "7DGS without direction", "4dgs": "4DGS",
         "3dgs": "3DGS", "6dgs": "6DGS", "auto": "`model=auto`", "freetime": "FreeTimeGS", "dbs": "dBS", "ubs": "UBS",
         "ndgs": "N-DGS", "dgs": "dGS"}  # fmt: skip
SUCCESSORS = ("freetime", "dbs", "ubs", "ndgs", "dgs")
CASES = {
    "250": "iterations=250",
    "500": "iterations=500",
    "1,000": "",
    "1,000, threshold 4e-4": "densify.grad_threshold=0.0004",
    "2,000": "iterations=2000",
    "4,000": "iterations=4000",
}
TIMES = ("train_s", "train_cpu_s", "fps")  # parts of the cost that depend on the machine
PAPERS = "best_on_test=true"  # trex at the paper's resolution, batch size and iterations
ON_GPU = f"device=cuda,{PAPERS}"  # the same on a GPU
LONG = "recipe=long"
TREX100 = "downscale=8,initial_points=20000,iterations=3000"  # trex at 100 x 100 pixels
SMALLER = "downscale=4,iterations=7000"  # trex at 200 x 200 pixels
# `+recipe=quick` and what a row changes of it, by the setting of its runs.
QUICK = {
    "recipe=quick": "",
    "recipe=quick,iterations=6500,densify.max_gaussians=110000": ", 6,500 iterations, at most 110,000 Gaussians",
    "recipe=quick,iterations=12000,densify.max_gaussians=110000": ", 12,000 iterations, at most 110,000 Gaussians",
}


@dataclass(frozen=True)
class Experiment:
    """The reference records of one experiment on one data set, with all comparisons that its report makes."""

    group: Group

    @functools.cached_property
    def family(self) -> Family:
        """Return all comparisons of the experiment's report, so that the page is as strict as the report."""
        return comparisons(self.group)

    @functools.cached_property
    def _found(self) -> dict[tuple[str, str], Configuration]:
        return {(c.model, c.variant): c for c in self.group.configurations}

    def has(self, model: str, variant: str = "") -> bool:
        """Tell whether a model has finished runs with these settings."""
        return (model, variant) in self._found

    def configuration(self, model: str, variant: str | None = "") -> Configuration:
        """Return a model with these settings; None: with the only settings it was run with."""
        if variant is not None:
            return self._found[model, variant]
        (only,) = (c for c in self.group.configurations if c.model == model)
        return only

    def runs(self, model: str, variant: str = "") -> list[Record]:
        """Return the runs of a model with these settings, on all scenes and with all seeds."""
        return [run for runs in self.configuration(model, variant).runs.values() for run in runs]

    def of(self, model: str, variant: str | None = "", quantity: str = "psnr") -> Estimate:
        """Estimate a quantity of a model, averaged over scenes; the interval is over seeds."""
        found = self.configuration(model, variant)
        values = [self.group.sample(found, scene, quantity)[:, None] for scene in found.runs]
        return estimate(values, generalise=False) if all(map(len, values)) else Estimate(math.nan, 0, 0, "")

    def difference(self, model: str, other: str, variant: str | None = "") -> Estimate:
        """Estimate how much more PSNR a model has than another one, paired by scene, seed and view."""
        return estimate(list(self.contrast(model, other, variant).values()))

    def contrast(self, model: str, other: str, variant: str | None = "") -> dict[str, Values]:
        """Return the paired differences in PSNR of two models, by scene that both have finished."""
        weights = self._minus(model, other, variant)
        both = [scene for scene in self.group.scenes if all(scene in found.runs for _, found in weights)]
        return dict(zip(both, self.group.contrast(weights, "psnr"), strict=True))

    def tested(self, model: str, other: str, variant: str = "") -> Tested:
        """Return the difference of two models as the experiment's report tests it."""
        return self.family.of(self._minus(model, other, variant))

    def _minus(self, model: str, other: str, variant: str | None) -> Weights:
        return [(1.0, self.configuration(model, variant)), (-1.0, self.configuration(other, variant))]


@functools.cache
def experiments(folder: Path) -> list[Experiment]:
    """Read the records of a folder, one experiment for each data set.

    Raises:
        AssertionError: a record cannot be read, or the folder has none.
    """
    records, faults = tables.load(folder)
    assert records, f"{folder}: no records"
    assert not faults, faults
    return [Experiment(group) for group in groups(records)]


def experiment(published: Path, name: str) -> Experiment:
    """Read an experiment that has one data set."""
    (found,) = experiments(published / name)
    return found


def machine(found: Experiment) -> str:
    """Name the machine on which most runs were made, without what changes no time."""
    parts = found.group.machine.split(", ")
    processor = parts[0].replace("AMD EPYC family 25 model 17 stepping 1", "AMD EPYC Zen 4")
    return ", ".join([processor, *(part for part in parts[1:] if "core" in part or "thread" in part)])


def prices(found: Experiment) -> dict[str, compare.Price]:
    """Return the price of each effect by name, within one parametrisation where 7DGS without direction was run."""
    cube = compare.cube(found.group, found.family)
    return {price.name: price for price in [*cube.prices, *cube.nested] if compare.is_single(price.name)}


def metric(runs: list[Record], name: str) -> float:
    """Average a metric over runs; NaN if one lacks it."""
    values = [value for run in runs if run.metrics and (value := run.metrics.get(name)) is not None]
    return fmean(values) if values and len(values) == len(runs) else math.nan


def best_on_test(runs: list[Record]) -> Estimate:
    """Estimate the PSNR at the best iteration on test; the interval is over seeds."""
    values = [value for run in runs if run.metrics and (value := run.metrics.get("psnr_best_on_test")) is not None]
    return over_seeds(values) if values else Estimate(math.nan, 0, 0, "")


def cost(runs: list[Record], name: str) -> float:
    """Average a part of the cost over runs, such as "train_s".

    Raises:
        AssertionError: it is a time, and the runs were made on several machines.
    """
    if name in TIMES:  # CPU-seconds do not depend on the number of threads, which is a part of the machine's name
        own = [run.provenance for run in runs]
        machines = {one.device if name == "train_cpu_s" else one.machine for one in own}
        assert len(machines) == 1, f"{name}: expected runs of one machine, got {machines}"
    return fmean(getattr(run.cost, name) for run in runs if run.cost)


def overfitted(found: Experiment) -> list[str]:
    """Return the models that lose more than FALL dB from 2,000 to 4,000 iterations."""
    return [m for m in MODELS if found.of(m, CASES["2,000"]).mean - found.of(m, CASES["4,000"]).mean > FALL]


def successors(found: Experiment) -> list[tuple[float, str]]:
    """Return PSNR and name of each newer method that was run, the highest PSNR first."""
    return sorted(((found.of(model).mean, model) for model in SUCCESSORS if found.has(model)), reverse=True)


def number(value: float, digits: int = 2) -> str:
    """Format a number with commas; a dash for NaN."""
    return "–" if math.isnan(value) else f"{value:,.{digits}f}"


def signed(value: float, digits: int = 2) -> str:
    """Format a difference as the reports do, with the minus of a keyboard."""
    return messages.signed(value, digits).replace("−", "-")


def change(of: Estimate, *, told: bool = False) -> str:
    """Format a difference with its interval, bold if it is significant."""
    mean = f"**{signed(of.mean)}**" if told else signed(of.mean)
    return f"{mean} ({number(of.low)} to {number(of.high)})"


def row(cells: Iterable[str]) -> str:
    """Return a row of a table."""
    return f"| {' | '.join(cells)} |"


def table(head: Iterable[str], rows: Iterable[Iterable[str]], left: int = 1) -> str:
    """Return a table whose columns after the first `left` ones are numbers."""
    titles, cells = list(head), list(map(list, rows))
    assert all(len(one) == len(titles) for one in cells), f"expected {len(titles)} cells a row, got {cells}"
    marks = ["---"] * left + ["---:"] * (len(titles) - left)
    return "\n".join([row(titles), row(marks), *map(row, cells)])


def best(values: list[float], texts: list[str]) -> list[str]:
    """Mark the highest value bold, as it is shown."""
    highest = max(text for text, value in zip(texts, values, strict=True) if value == max(values))
    return [f"**{text}**" if text == highest else text for text in texts]


def by_scene(of: Estimate, form: Callable[[float], str] = number) -> list[str]:
    """Format what an estimate is the mean of: a number for each scene."""
    return [form(mean) for mean in of.each]


def plus_minus(of: Estimate) -> str:
    """Format a number of one model with half the width of its interval, if it has one."""
    return f"{of.mean:.2f} ± {of.half:.2f}" if of.over else f"{of.mean:.2f}"


def costs(found: Experiment, case: str, models: Iterable[str], form: str) -> list[str]:
    """Return a row of PSNR and seconds of training; the highest PSNR is bold."""
    psnr = [found.of(model, CASES[case]).mean for model in models]
    seconds = [found.of(model, CASES[case], "seconds").mean for model in models]
    shown = best(psnr, [f"{value:.2f}" for value in psnr])
    return [case, *(form.format(psnr=p, seconds=number(s, 1)) for p, s in zip(shown, seconds, strict=True))]


def gated(published: Path, model: str) -> dict[str, list[float]]:
    """Return how PSNR, and frame time and size in per cent, change on each scene if effects are removed."""
    changes: dict[str, list[float]] = {"psnr": [], "ms": [], "mb": []}
    for group in (found.group for found in experiments(published / "effects")):
        own = [c for c in group.configurations if c.model == model]
        full = [c for c in own if not c.on_demand]
        for less in (c for c in own if c.on_demand):
            before = max(full, key=lambda c: _shared(c.variant, less.variant))
            for scene in less.runs:
                for unit, values in changes.items():
                    old, new = (float(group.sample(c, scene, unit).mean()) for c in (before, less))
                    values.append(new - old if unit == "psnr" else 100 * (new / old - 1))
    return changes


def _shared(variant: str, other: str) -> int:
    """Count the settings that two variants share."""
    return len(set(variant.split(",")) & set(other.split(",")))


def span(values: list[float], digits: int) -> str:
    """Format the lowest and the highest of some differences."""
    return f"{signed(min(values), digits)} to {signed(max(values), digits)}"

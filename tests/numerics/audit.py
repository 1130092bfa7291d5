"""Run the audit: compute numerically hard inputs with every model and backend, and measure the errors."""

import sys
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing import get_context

import torch
from tqdm import tqdm

from gsbench.models.cholesky import FACTOR_ORDERS
from numerics import colors, curves, pictures, population, slices, trainings
from numerics.cases import CASES, Case, Cell, of_area, present
from numerics.slices import JOINT

MILLION = 1_000_000
NOT_DEFAULT = 100_000  # Gaussians that are sliced in the factor order that is not the default
MOVING = 20_000  # Gaussians of dGS, dBS, UBS and FreeTimeGS each
DEFAULT_ORDER = "conditioned_first"
# The short audit: random Gaussians per factor order, training steps, and the case that is left out.
FEW, SHORT_STEPS, SLOWEST = 4_000, 60, "faint_crowd"
FIXED = {"slicing": slices.judge, "colour": colors.judge, "projection": pictures.judge, "blending": pictures.judge}
Step = Callable[[], object]


@dataclass
class Audit:
    """The results of an audit: errors, condition numbers and times."""

    backends: list[str]
    cells: list[Cell] = field(default_factory=list)
    verified: dict[str, float] = field(default_factory=dict)  # errors of float64 against mpmath, by order or model
    conditions: list[curves.ConditionCurve] = field(default_factory=list)
    safety: list[curves.SliceTime] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def broken(self) -> list[Cell]:
        """The results in which a default setting exceeds its error bound."""
        return [cell for cell in self.cells if cell.is_default and not cell.holds]


def run(million: int = MILLION, *, long: bool = False, short: bool = False) -> Audit:
    """Run the audit with a progress bar on stderr, on one thread.

    The trainings whose drift is measured take half of the time; they run in another process meanwhile.

    Args:
        million: the number of random 7D Gaussians to slice.
        long: train for 2,000 steps instead of 150, and slice the `million` Gaussians with both row orders of the factor
            (otherwise only with the default order).
        short: test only default settings, with fewer Gaussians and training steps, one seed and no timings.
    """
    began, threads = time.perf_counter(), torch.get_num_threads()
    torch.set_num_threads(1)
    audit = Audit(present())
    with ProcessPoolExecutor(1, get_context("spawn")) as other:  # a process is started by its first task
        named = _short_steps(audit) if short else _steps(audit, million, long, other)
        with tqdm(named, desc="stability", file=sys.stderr) as steps:
            for name, step in steps:
                steps.set_postfix_str(name)
                step()
    torch.set_num_threads(threads)
    audit.seconds = time.perf_counter() - began
    return audit


def only(case: Case, *subjects: str) -> Case:
    """Return a copy of a case that is restricted to the given models."""
    return replace(case, subjects=subjects)


def _judged(
    audit: Audit, case: Case, judge: Callable[..., Iterable[Cell]], *arguments: object, **more: object
) -> tuple[str, Step]:
    return case.name, lambda: audit.cells.extend(judge(case, *arguments, **more))


def hard_slices(audit: Audit, name: str, N: int) -> None:
    """Measure the errors of N random slices: of 7DGS in a factor order, or of another model."""
    cells, audit.verified[name] = population.hard_slices(name, N, audit.backends)
    audit.cells += cells


def _hard_slices(audit: Audit, counts: dict[str, int]) -> list[tuple[str, Step]]:
    return [(f"hard slices, {name}", partial(hard_slices, audit, name, N)) for name, N in counts.items()]


def _short_steps(audit: Audit) -> list[tuple[str, Step]]:
    """Return the names and functions of the tests in a short audit, which tests only default settings."""
    fastest, steps = audit.backends[0], []
    for case in of_area("slicing"):
        some = [model for model in case.subjects if model in JOINT and model != "6dgs"]  # 6DGS is 7DGS without time
        few = only(case, *some, *[model for model in case.subjects if model not in JOINT][:1])
        steps.append(_judged(audit, few, slices.judge, audit.backends, ["square_root"], copies=1))
    for area in ("colour", "projection", "blending"):
        steps += [_judged(audit, case, FIXED[area], audit.backends) for case in of_area(area) if case.name != SLOWEST]
    driven, drifting = (only(CASES[name], "7dgs") for name in ("learning_rates_times_30", "single_against_double"))
    steps += [
        _judged(audit, driven, trainings.judge, fastest, steps=SHORT_STEPS),
        _judged(audit, CASES["poisoned_photograph"], trainings.judge, fastest),
        _judged(audit, drifting, trainings.drift, fastest, trainings.SEEDS[:1], steps=SHORT_STEPS),
    ]
    return steps + _hard_slices(audit, dict.fromkeys((*FACTOR_ORDERS, *population.MOVING), FEW))


def _steps(audit: Audit, million: int, long: bool, other: ProcessPoolExecutor) -> list[tuple[str, Step]]:
    """Return the names and functions of all tests and timings in a full audit. The drift of trainings is measured in
    the process `other`; timings begin when it is done."""
    fastest, backends = audit.backends[0], audit.backends
    steps = [_judged(audit, case, judge, backends) for area, judge in FIXED.items() for case in of_area(area)]
    for case in of_area("training"):
        more = {"steps": trainings.LONG_STEPS} if long and case.name == "learning_rates_times_30" else {}
        steps.append(_judged(audit, case, trainings.judge, fastest, **more))
    drifts = other.submit(_drifts, fastest, long)
    few = million if long else min(million, NOT_DEFAULT)
    counts = {order: million if order == DEFAULT_ORDER else few for order in FACTOR_ORDERS}
    return [
        *steps,
        *_hard_slices(audit, counts | dict.fromkeys(population.MOVING, min(million, MOVING))),
        ("error by condition number", lambda: audit.conditions.extend(curves.by_condition())),
        ("drift of float32", lambda: audit.cells.extend(drifts.result())),
        ("cost of safety", lambda: audit.safety.extend(curves.safety(backends))),
    ]


def _drifts(backend: str, long: bool) -> list[Cell]:
    """Measure how far trainings in float32 drift from float64, on one thread."""
    torch.set_num_threads(1)
    (case,) = of_area("drift")
    if long:
        return list(trainings.drift(case, backend, steps=trainings.LONG_DRIFT_STEPS))
    return list(trainings.drift(only(case, *trainings.DRIFTING), backend, steps=trainings.DRIFT_STEPS))

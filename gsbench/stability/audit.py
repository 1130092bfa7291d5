"""Run the stability audit: compute numerically hard inputs with every model and backend, and measure the errors."""

import sys
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing import get_context
from typing import TypeVar

import torch
from tqdm import tqdm

from gsbench.errors import InputError
from gsbench.kernels.backends import resolve
from gsbench.models.slicing import SCHEMES
from gsbench.models.triangular import FACTOR_ORDERS
from gsbench.stability import colors, curves, moving_population, pictures, population, slices, trainings
from gsbench.stability.cases import CASES, Bound, Case, Cell, backends_with, device_of, of_area
from gsbench.stability.slicing_cases import ALL
from gsbench.stability.training_cases import DRIFT_STEPS, DRIFTING, LONG_DRIFT_STEPS, LONG_STEPS

BACKENDS = ("cpu", "cuda", "reference")
MILLION = 1_000_000
NOT_DEFAULT = 100_000  # Gaussians that are sliced in the factor order that is not the default
SUBTRACTING = 50_000  # Gaussians that are sliced by the schemes that subtract covariances
MOVING = 20_000  # Gaussians of dGS, dBS, UBS and FreeTimeGS each
DEFAULT_ORDER = "conditioned_first"
SEED = 0
# The short audit: random Gaussians per factor order, training steps, and the test case that is left out.
FEW, SHORT_STEPS, SLOWEST = 4_000, 60, "faint_crowd"
T = TypeVar("T")
Step = Callable[[], None]


@dataclass
class Audit:
    """The results of a stability audit: errors, condition numbers and times."""

    backends: list[str]
    cells: list[Cell] = field(default_factory=list)
    verified: dict[str, float] = field(default_factory=dict)  # errors of float64 against mpmath, by order or model
    conditions: list[curves.ConditionCurve] = field(default_factory=list)
    accuracy: list[curves.AccuracyPoint] = field(default_factory=list)
    safety: list[curves.SliceTime] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def broken(self) -> list[Cell]:
        """Return the results in which a default setting exceeds its error bound."""
        return [cell for cell in self.cells if cell.is_default and not cell.holds]


def present() -> list[str]:
    """Return the names of the backends (CPU kernels, CUDA kernels, torch) that work on this machine."""
    found = []
    for name in BACKENDS:
        try:
            found.append(resolve(name, device_of(name)).name)
        except InputError:
            continue
    return found


def run(million: int = MILLION, *, long: bool = False, short: bool = False) -> Audit:
    """Run the stability audit with a progress bar on stderr, on one thread.

    The trainings whose drift is measured take half of the time; they run in another process meanwhile.

    Args:
        million: the number of random Gaussians with ill-conditioned factors to slice, by default a million.
        long: train for 2,000 steps instead of 150, and slice the `million` Gaussians with both row orders of the factor
            (otherwise only with the default order).
        short: test only default settings, with fewer Gaussians and training steps, one seed and no timings.
    """
    began, threads = time.perf_counter(), torch.get_num_threads()
    torch.set_num_threads(1)
    audit = Audit(present())
    with ProcessPoolExecutor(1, get_context("spawn")) as other:  # a process is started by its first task
        listed = _short_steps(audit) if short else _steps(audit, million, long, other)
        with tqdm(listed, desc="stability", file=sys.stderr) as steps:
            for name, step in steps:
                steps.set_postfix_str(name)
                step()
    torch.set_num_threads(threads)
    audit.seconds = time.perf_counter() - began
    return audit


def _short_steps(audit: Audit) -> list[tuple[str, Step]]:
    """Return the names and functions of the tests in a short audit, which tests only default settings."""
    fastest = audit.backends[0]
    judged: list[tuple[Case, Callable[[Case], Iterable[Cell]]]] = []
    for case in of_area("slicing"):
        some = [model for model in case.subjects if model in ALL and model != "6dgs"]  # 6DGS is 7DGS without time
        judge_slices = partial(slices.judge, backends=audit.backends, schemes=["square_root"], copies=1)
        judged.append((only(case, *(some or case.subjects[:1])), judge_slices))
    for area, judge in (("colour", colors.judge), ("projection", pictures.judge), ("blending", pictures.judge)):
        judged += [(case, partial(judge, backends=audit.backends)) for case in of_area(area) if case.name != SLOWEST]
    driven, drifting = (only(CASES[name], "7dgs") for name in ("learning_rates_times_30", "single_against_double"))
    judged += [
        (driven, partial(trainings.judge, backend=fastest, steps=SHORT_STEPS)),
        (CASES["poisoned_photograph"], partial(trainings.judge, backend=fastest)),
        (drifting, partial(trainings.drift, backend=fastest, seeds=trainings.SEEDS[:1], steps=SHORT_STEPS)),
    ]
    steps: list[tuple[str, Step]] = [(case.name, partial(_extend, audit.cells, judge, case)) for case, judge in judged]
    steps += [(f"hard slices, {order}", partial(hard_slices, audit, order, FEW)) for order in FACTOR_ORDERS]
    models = moving_population.MODELS
    return steps + [(f"hard slices, {model}", partial(moving_slices, audit, model, FEW)) for model in models]


def only(case: Case, *subjects: str) -> Case:
    """Return a copy of a test case that is restricted to the given models."""
    return replace(case, subjects=subjects)


def _extend(cells: list[Cell], judge: Callable[[Case], Iterable[Cell]], case: Case) -> None:
    cells.extend(judge(case))


def _drifts(backend: str, long: bool) -> list[Cell]:
    """Measure how far trainings in float32 drift from float64, on one thread."""
    torch.set_num_threads(1)
    found: list[Cell] = []
    for case in of_area("drift"):
        some, count = (case, LONG_DRIFT_STEPS) if long else (only(case, *DRIFTING), DRIFT_STEPS)
        found += trainings.drift(some, backend, steps=count)
    return found


def _steps(audit: Audit, million: int, long: bool, other: ProcessPoolExecutor) -> list[tuple[str, Step]]:
    """Return the names and functions of all tests and timings in a full audit.

    Args:
        audit: gets the results.
        million: the number of random Gaussians.
        long: whether trainings are long.
        other: the process in which the drift of trainings is measured; timings begin when it is done.
    """
    steps: list[tuple[str, Step]] = []

    def add(name: str, found: list[T], more: Callable[[], Iterable[T]]) -> None:
        steps.append((name, lambda: found.extend(more())))

    fastest = audit.backends[0]
    for area, judge in (("slicing", slices.judge), ("colour", colors.judge), ("projection", pictures.judge),
                        ("blending", pictures.judge)):  # fmt: skip
        for case in of_area(area):
            add(case.name, audit.cells, partial(judge, case, audit.backends))
    for case in of_area("training"):
        more = {"steps": LONG_STEPS} if long and case.name == "learning_rates_times_30" else {}
        add(case.name, audit.cells, partial(trainings.judge, case, fastest, **more))
    drifts = other.submit(_drifts, fastest, long)
    for order in FACTOR_ORDERS:
        count = million if long or order == DEFAULT_ORDER else min(million, NOT_DEFAULT)
        steps.append((f"hard slices, {order}", partial(hard_slices, audit, order, count)))
    for model in moving_population.MODELS:
        steps.append((f"hard slices, {model}", partial(moving_slices, audit, model, min(million, MOVING))))
    add("error by condition number", audit.conditions, curves.by_condition)
    add("drift of float32", audit.cells, drifts.result)
    add("error by time", audit.accuracy, partial(curves.accuracy_for_time, audit.backends))
    add("cost of safety", audit.safety, partial(curves.safety, audit.backends))
    return steps


def hard_slices(audit: Audit, order: str, N: int) -> None:
    """Measure the errors of conditional 3D Gaussians for N random 7D Gaussians with ill-conditioned factors.

    The diagonal entries of their covariances' Cholesky factors go down to 1e-5. The result is the 99.9th percentile of
    the errors over the Gaussians.
    """
    hard = population.draw(torch.Generator().manual_seed(SEED), N, order)
    known = population.truth(hard, order)
    audit.verified[order] = population.verify(hard, order)
    for scheme in SCHEMES:
        count = N if scheme == "square_root" else min(N, SUBTRACTING)
        for backend in backends_with(scheme, "7dgs", audit.backends):
            start = time.perf_counter()
            errors = population.judge(hard.rows(slice(count)), known, order, scheme, backend)
            ms = 1e3 * (time.perf_counter() - start)
            forward, gradient = (curves.percentile(x) for x in (errors.cov, errors.gradient))
            audit.cells.append(
                Cell("population", f"hard_slices_{order}", "7dgs", scheme, backend, forward, gradient,
                     float(errors.bad.mean()), ms, Bound(), f"{count} slices")
            )  # fmt: skip


def moving_slices(audit: Audit, model: str, N: int) -> None:
    """Measure the errors of N random slices of dGS, dBS, UBS or FreeTimeGS."""
    cells, audit.verified[model] = moving_population.judge(model, N, audit.backends)
    audit.cells += cells

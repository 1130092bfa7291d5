"""Hostile arguments of public functions: the result of plain ones and its gradient, or an InputError of one line.

As a program, this file tries so many cases: a crash of a kernel, a hang or a flood of memory ends that process alone.
"""

import faulthandler
import os
import random
import resource
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest
import torch
from forked import python
from targets import Target, targets
from tensors import disturb, disturb_layout, plain
from torch import Tensor

from gsbench.errors import InputError
from gsbench.models import CameraTime
from gsbench.raster import RasterOutput, rasterize

NUMBERS = (
    *(0, 1, -1, 2, 17, 2**31, 2**63, 10**30),
    *(0.0, 0.5, 1e-30, 1e30, float("nan"), float("inf")),
    *(True, False, None, "", "x", "no", "paper", "cpu", "reference", "schur", [], (0.0, 0.0, 0.0), torch.tensor(1.0)),
)
UNIQUE = ("viewmats", "Ks", "factor", "factors")  # repeated rows would be no rotation, or singular
LIMIT_S = 30  # of a case; the first gradient of a process takes 8, while torch imports what it needs for it
MEMORY = 8 << 30  # bytes of address space beyond those that torch takes


@pytest.mark.parametrize("count", [60, pytest.param(400, marks=pytest.mark.slow)])
def test_any_call_works_or_is_an_input_error(count):
    """Catches a crash in a kernel, a stack trace from torch, and a result or gradient that depends on strides."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "OMP_NUM_THREADS": "1"}
    done = python(__file__, str(count), env=environment)
    assert done.returncode == 0, f"{done.stdout[-600:]}\nexit status {done.returncode}: {done.stderr[-3000:]}"


def test_a_time_beyond_64_bits_is_a_number():
    """Catches torch's OverflowError for an integer that a float holds."""
    assert float(CameraTime.at(torch.zeros(3), 10**30).time) == pytest.approx(1e30)


def try_cases(count: int) -> None:
    """Try the cases of the first seeds, each after a line that says what it is; both outcomes must be frequent."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY, resource.RLIM_INFINITY))
    outcomes: Counter[str] = Counter()
    for seed in range(count):
        what, call = draw(random.Random(f"public API {seed}"))
        print(f"case {seed}: {what}", flush=True)
        faulthandler.dump_traceback_later(LIMIT_S, exit=True)
        try:
            with warnings.catch_warnings(action="error"):  # a warning from the depths is no clear message either
                call()
            outcomes["accepted"] += 1
        except InputError as error:
            outcomes["refused"] += 1
            clear = 0 < len(str(error)) < 1000 and str(error).isprintable()
            assert clear, error  # noqa: PT017  no test, but what a test runs
    faulthandler.cancel_dump_traceback_later()
    assert min(outcomes["accepted"], outcomes["refused"]) >= count / 20, outcomes


def draw(r: random.Random) -> tuple[str, Callable[[], None]]:
    """Draw a function, the layouts of all its tensors and, more often than not, a hostile argument."""
    name, target = r.choice(list(targets().items()))
    arguments, done = dict(target.arguments), []
    for key, x in arguments.items():
        if isinstance(x, Tensor) and x.dim() and x.is_floating_point() and r.random() < 0.3:
            arguments[key], what = disturb_layout(r, x, repeat=key not in UNIQUE)
            done.append(f"{key} {what}")
    changed = r.random() < 0.6
    if changed:
        key = r.choice(list(arguments))
        tensor = isinstance(arguments[key], Tensor)
        arguments[key], what = disturb(r, arguments[key]) if tensor else _number(r)
        done.append(f"{key} {what}")
    return f"{name}: {', '.join(done)}", lambda: check(target, arguments, changed)


def _number(r: random.Random) -> tuple[Any, str]:
    value = r.choice(NUMBERS)
    return value, f"= {value!r}"


def check(target: Target, arguments: dict[str, Any], changed: bool) -> None:
    """Call a function; where only layouts differ, compare results and gradients with those of plain arguments."""
    same = {key: plain(x) for key, x in arguments.items()}
    results, gradients = _call(target.function, target, arguments)
    if changed:
        return
    expected, expected_gradients = _call(target.function, target, same)
    with torch.no_grad():
        _compare([x for x in _tensors(target.function(**arguments)) if x.numel()], expected, 1e-6)
    _compare(results, expected, 1e-6)
    _compare(gradients, expected_gradients, 1e-5)
    if target.function is rasterize:
        exact = {key: plain(x).double() if isinstance(x, Tensor) else x for key, x in arguments.items()}
        expected, expected_gradients = _call(target.function, target, exact | {"backend": "reference"})
        _compare(results[:2], expected[:2], 1e-4)
        _compare(gradients, expected_gradients, 1e-3)


def _call(function: Callable[..., Any], target: Target, arguments: dict[str, Any]) -> tuple[list[Tensor], list[Tensor]]:
    """Return results and the gradients of a sum of their squares by every float tensor, as leaves of a graph."""
    leaves = []
    arguments = dict(arguments)
    for key, x in arguments.items():
        if isinstance(x, Tensor) and x.is_floating_point() and key not in target.constant and not x.is_sparse:
            arguments[key] = x.detach().requires_grad_()
            leaves.append(arguments[key])
    result = function(**arguments)
    results = [x for x in _tensors(result) if x.numel()]
    with_gradient = [x for x in results if x.requires_grad]
    if with_gradient:
        sum(x.double().square().sum() for x in with_gradient).backward()
    for leaf in leaves:
        assert leaf.grad is None or leaf.grad.shape == leaf.shape
    return results, [torch.zeros_like(x) if x.grad is None else x.grad for x in leaves]


def _tensors(result: Any) -> Iterable[Tensor]:
    if isinstance(result, RasterOutput):
        return [result.image, result.alpha, result.info.means2d, result.info.depths]
    if isinstance(result, float | int):
        return [torch.tensor(float(result))]
    return [result] if isinstance(result, Tensor) else result or []


def _compare(results: list[Tensor], expected: list[Tensor], tolerance: float) -> None:
    """Assert that tensors agree, relative to the norm of each."""
    assert len(results) == len(expected)
    for x, y in zip(results, expected, strict=True):
        assert x.shape == y.shape
        assert x.isfinite().all()
        distance = (x.detach().double() - y.detach().double()).norm()
        assert distance <= tolerance * max(1e-3, y.detach().double().norm()), f"{x} is not {y}"


if __name__ == "__main__":
    try_cases(int(sys.argv[1]))

"""Hostile arguments of public functions: the result of plain ones and its gradient, or an InputError of one line."""

import random
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch
from hostile_models import draw_model
from targets import Target, targets
from tensors import disturb, disturb_layout, plain
from torch import Tensor
from workers import Case, Pool, generator, sample

from gsbench.kernels.adam import adam
from gsbench.raster import RasterOutput, rasterize

NUMBERS = (0, 1, -1, 2, 17, 2**31, 2**63, 10**30, 0.0, 0.5, 1e-30, 1e30, float("nan"), float("inf"), True, False, None,
           "", "x", "cpu", "reference", "schur", [], (0.0, 0.0, 0.0), torch.tensor(1.0))  # fmt: skip


UNIQUE = ("viewmats", "Ks", "factor", "factors")  # repeated rows would be no rotation, or singular


def draw(seed: int, _: Path) -> Case:
    """Draw a function, the layouts of all its tensors and, more often than not, a hostile argument."""
    r = generator("public API", seed)
    if r.random() < 0.2:
        return draw_model(r)
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
    return Case(f"{name}: {', '.join(done)}", lambda: check(target, arguments, changed))


def _number(r: random.Random) -> tuple[Any, str]:
    value = r.choice(NUMBERS)
    return value, f"= {value!r}"


def check(target: Target, arguments: dict[str, Any], changed: bool) -> None:
    """Call a function; where only layouts differ, compare results and gradients with those of plain arguments."""
    same = {key: plain(x) for key, x in arguments.items()}
    results, gradients = _call(target.function, target, arguments)
    if changed:
        return
    expected, their_gradients = _call(target.function, target, same)
    if target.function is not adam:  # it has changed its arguments
        with torch.no_grad():
            _compare([x for x in _tensors(target.function(**arguments)) if x.numel()], expected, 1e-6)
    _compare(results, expected, 1e-6)
    _compare(gradients, their_gradients, 1e-5)
    if target.function is rasterize:
        exact = {key: plain(x).double() if isinstance(x, Tensor) else x for key, x in arguments.items()}
        expected, their_gradients = _call(target.function, target, exact | {"backend": "reference"})
        _compare(results[:2], expected[:2], 1e-4)
        _compare(gradients, their_gradients, 1e-3)


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
    in_place = [arguments[key] for key in ("parameter", "mean", "square")] if function is adam else []
    for leaf in leaves:
        assert leaf.grad is None or leaf.grad.shape == leaf.shape
    return [*results, *in_place], [torch.zeros_like(x) if x.grad is None else x.grad for x in leaves]


def _tensors(result: Any) -> Iterable[Tensor]:
    """The tensors of a result."""
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


@sample(60, 400)
def test_any_call_works_or_is_an_input_error(count: int, pool: Pool) -> None:
    """Catches a crash in a kernel, a stack trace from torch, and a result or gradient that depends on strides."""
    pool.check(__name__, count)

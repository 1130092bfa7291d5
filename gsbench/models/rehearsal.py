"""Rehearse a model on four Gaussians before a training, so that mistakes in its code are found at the start."""

import inspect
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from torch import Tensor

from gsbench.errors import InputError, one_line
from gsbench.models.base import GaussianModel, Raw
from gsbench.models.camera_time import CameraTime
from gsbench.models.gated import has_gates
from gsbench.models.gaussian_batch import Conditioned
from gsbench.models.registry import HOW_TO
from gsbench.scenes.scene import Points

N = 4  # Gaussians
SHAPES = {"means": [N, 3], "factors": [N, 3, 3], "opacity_factor": [N], "beta_exponents": [N]}  # of Conditioned


def rehearse(model: GaussianModel, name: str) -> None:
    """Initialise, slice, split and freeze four Gaussians of a model, which is of no use afterwards.

    Raises:
        InputError: a method raises an error, or returns what no training can use. The message names the method, and the
            line of the model's file where it raised an error.
    """
    points = torch.eye(N, 3)
    with _named(model, name, "initial_geometry"):
        geometry = model.initial_geometry(Points(points, points), torch.ones(N), torch.Generator().manual_seed(0))
        _check_rows(geometry)
        missing = {*model.centers, *model.geometry} - {"means", *geometry}
        _check(not missing, f"all parameters of `centers` and `geometry`, {', '.join(sorted(missing))} is missing")
    with _named(model, name, "initialise"):
        model.initialise(Points(points, points), 1.0, torch.Generator().manual_seed(0))
    with _named(model, name, "spatial_scales"):
        scales = model.spatial_scales()
        _check(scales.shape in ((N, 1), (N, 3)), f"shape {[N, 3]} or {[N, 1]}, got {list(scales.shape)}")
    query = CameraTime.at(torch.full((3,), -2.0), 0.5 if "time" in model.observes or model.agr else None)
    raw: Raw = dict(model.splats.items())
    with _named(model, name, "condition"), torch.enable_grad():
        first, second = (model.condition(raw, query) for _ in range(2))
        _check_conditioned(first)
        for field, value, again in zip(Conditioned._fields, first, second, strict=True):
            is_same = value is again or (value is not None and again is not None and torch.equal(value, again))
            _check(is_same, f"the same {field} for the same query and parameters, got others")
        _check_gradients(first, {key: raw[key] for key in (*model.centers, *model.geometry)})
    with _named(model, name, "slice"):
        model.slice(query)
    with _named(model, name, "split"):
        rows = torch.tensor([0, 0, 1, 1])
        _check_changed(model.split(model.raw_of(rows), torch.Generator().manual_seed(0)), raw)
    if has_gates(model):
        with _named(model, name, "static"):
            _check_conditioned(model.static(raw))
        with _named(model, name, "frozen"):
            frozen = model.frozen(model.raw_of(torch.arange(N)), [query], torch.ones(1, N))
            expected = ["static", *model.observes] if model.observes else []
            is_right = set(frozen) <= set(expected) and ("static" in frozen or not expected)
            _check(is_right, f"static, and others of {expected}, got {list(frozen)}")
            for changed in frozen.values():
                _check_changed(changed, raw)


def _check_rows(raw: Raw) -> None:
    """Raise InputError unless these are raw parameters of N Gaussians, in finite numbers."""
    _check(isinstance(raw, dict), f"raw parameters by name, got a {type(raw).__name__}")
    for key, value in raw.items():
        _check(isinstance(value, Tensor) and value.dim() > 0, f"a tensor {key}, got {value!r:.60}")
        _check(len(value) == N, f"{key} with {N} rows, one for each Gaussian, got {list(value.shape)}")
        _check(bool(value.isfinite().all()), f"finite {key}, got {value.flatten().tolist()[:N]}")


def _check_changed(changed: Raw, raw: Raw) -> None:
    """Raise InputError unless these are new values of raw parameters of N Gaussians."""
    _check_rows(changed)
    for key, value in changed.items():
        _check(key in raw, f"raw parameters, got '{key}', which is none: {', '.join(raw)}")
        shape = list(raw[key].shape)
        _check(list(value.shape) == shape, f"{key} of shape {shape}, got {list(value.shape)}")


def _check_conditioned(sliced: Conditioned) -> None:
    _check(isinstance(sliced, Conditioned), f"a Conditioned, got a {type(sliced).__name__}")
    for field, value in sliced._asdict().items():
        if value is not None:
            _check_field(field, value.detach())


def _check_field(field: str, value: Tensor) -> None:
    _check(list(value.shape) == SHAPES[field], f"{field} of shape {SHAPES[field]}, got {list(value.shape)}")
    _check(value.dtype == torch.float32, f"{field} of torch.float32, got {value.dtype}")
    _check(bool(value.isfinite().all()), f"finite {field}, got {value.flatten().tolist()[:N]}")
    if field == "opacity_factor":
        low, high = value.aminmax()
        _check(bool(low >= 0 and high <= 1), f"{field} from 0 to 1, got {float(low):g} to {float(high):g}")


def _check_gradients(sliced: Conditioned, raw: Raw) -> None:
    """Raise InputError if a raw parameter has no gradient from the slice, so that it would not be trained."""
    parts = [part.sum() for part in sliced if part is not None and part.requires_grad]
    grads = torch.autograd.grad(parts, list(raw.values()), allow_unused=True) if parts else [None] * len(raw)
    idle = [key for key, grad in zip(raw, grads, strict=True) if grad is None]
    _check(not idle, f"a gradient of each of `centers` and `geometry`, {', '.join(idle)} has none")


def _check(holds: bool, expected: str) -> None:
    if not holds:
        raise InputError(f"expected {expected}")


@contextmanager
def _named(model: GaussianModel, name: str, method: str) -> Iterator[None]:
    """Let errors in the block begin with the model, the method and the line of the model's file."""
    try:
        yield
    except Exception as error:  # whatever the model's code raises
        file = inspect.getfile(type(model))
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
        where = f"{Path(file).name}, line {lines[-1]}: " if lines else ""
        what = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
        message = f"model '{name}': {method}: {where}{what}{one_line(error)}"
        raise InputError(message, docs=HOW_TO) from error

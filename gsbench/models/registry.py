"""Register models by name and build them."""

import importlib
import inspect
import pkgutil
from collections.abc import Callable
from typing import Any, TypeVar

from gsbench.errors import InputError, did_you_mean
from gsbench.models.base import GaussianModel

_REGISTRY: dict[str, type[GaussianModel]] = {}
M = TypeVar("M", bound=type[GaussianModel])


def register(name: str) -> Callable[[M], M]:
    """Decorate a class so that `build` finds it by this name."""

    def enter(model: M) -> M:
        _REGISTRY[name] = model
        return model

    return enter


def find(name: str) -> type[GaussianModel]:
    """Return the class registered as `name`.

    This imports every module of `gsbench.models`, so that a new model is one new file in that folder.

    Raises:
        InputError: the model is unknown.
    """
    package = importlib.import_module("gsbench.models")
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"gsbench.models.{module.name}")
    if not isinstance(name, str) or name not in _REGISTRY:
        raise InputError(f"model '{name}' is not known. {did_you_mean(name, _REGISTRY)}")
    return _REGISTRY[name]


def build(name: str, **options: Any) -> GaussianModel:
    """Build the model registered as `name`, without Gaussians yet.

    Args:
        name: such as `3dgs`, `4dgs`, `6dgs`, `7dgs`.
        options: of the model's class and of `GaussianModel`, such as `agr`, `sh_degree`, `lambda_t`.

    Returns:
        The model. `initialise` gives it Gaussians, `load_state` those of a checkpoint; `load_run` does all of it.

    Raises:
        InputError: the model is unknown, does not have an option, needs an option that is missing, or the option has
            another type.

    Example:
        >>> from gsbench import build
        >>> model = build("7dgs", agr=True, lambda_t=0.5, lambda_d=0.5)
        >>> model.observes, len(model)
        (('time', 'direction'), 0)
        >>> build("7dsg")
        Traceback (most recent call last):
        ...
        gsbench.errors.InputError: model '7dsg' is not known. Did you mean '7dgs'? Valid: 3dgs, ...
    """
    model = find(name)
    # A constructor passes unknown options on to its base, so the options are those of all base classes.
    known: dict[str, inspect.Parameter] = {}
    for cls in (cls for cls in model.__mro__ if issubclass(cls, GaussianModel)):
        own = inspect.signature(cls.__init__, eval_str=True).parameters.values()
        known = {p.name: p for p in own if p.kind is p.KEYWORD_ONLY} | known
    for option, value in options.items():
        if option not in known:
            raise InputError(f"model '{name}' has no option '{option}'. {did_you_mean(option, known)}")
        if not _is_a(value, known[option].annotation):
            expected = getattr(known[option].annotation, "__name__", known[option].annotation)
            raise InputError(f"model '{name}': {option}: expected {expected}, got {value!r:.80}")
    for option, parameter in known.items():
        if parameter.default is parameter.empty and option not in options:
            raise InputError(f"model '{name}' needs the option '{option}', which has no default")
    return model(**options)


def _is_a(value: object, kind: Any) -> bool:
    """Tell whether an option's value has the type of the constructor's argument; a number may be whole."""
    if kind is float:
        return type(value) in (int, float)
    if kind in (bool, int, str):
        return type(value) is kind
    return not isinstance(kind, type) or isinstance(value, kind)

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


def build(name: str, **options: Any) -> GaussianModel:
    """Build the model registered as `name`, without Gaussians yet.

    This imports every module of `gsbench.models`, so that a new model is one new file in that folder.

    Raises:
        InputError: the model is unknown, does not have an option, or needs an option that is missing.
    """
    package = importlib.import_module("gsbench.models")
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"gsbench.models.{module.name}")
    if name not in _REGISTRY:
        raise InputError(f"model '{name}' is not known. {did_you_mean(name, _REGISTRY)}")
    model = _REGISTRY[name]
    # A constructor passes unknown options on to its base, so the options are those of all base classes.
    signatures = [inspect.signature(cls.__init__) for cls in model.__mro__ if issubclass(cls, GaussianModel)]
    known = {p.name: p.default for s in signatures for p in s.parameters.values() if p.kind is p.KEYWORD_ONLY}
    for option in options:
        if option not in known:
            raise InputError(f"model '{name}' has no option '{option}'. {did_you_mean(option, known)}")
    for option, default in known.items():
        if default is inspect.Parameter.empty and option not in options:
            raise InputError(f"model '{name}' needs the option '{option}', which has no default")
    return model(**options)

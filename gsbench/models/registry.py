"""Register models by name, also those of other packages, and build them."""

import importlib
import inspect
import pkgutil
import traceback
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, TypeVar

from gsbench.errors import InputError, did_you_mean, one_line
from gsbench.models.base import GaussianModel

_REGISTRY: dict[str, type[GaussianModel]] = {}
ENTRY_POINTS = "gsbench.models"  # the group in which an installed package lists its modules of models
M = TypeVar("M", bound=type[GaussianModel])


def register(name: str) -> Callable[[M], M]:
    """Decorate a class so that `build` finds it by this name; raises InputError if another class has the name."""

    def enter(model: M) -> M:
        other = _REGISTRY.get(name, model)
        if (other.__module__, other.__qualname__) != (model.__module__, model.__qualname__):
            raise InputError(f"model '{name}': expected a name of its own, {other.__module__} has a model of that name")
        _REGISTRY[name] = model
        return model

    return enter


def find(name: str, module: str | None = None) -> type[GaussianModel]:
    """Return the class registered as `name`.

    Every module of `gsbench.models` is imported, so that a new model is one new file in that folder, and every entry
    point of the group `gsbench.models` of an installed package.

    Args:
        name: of the model.
        module: a Python module that registers it, imported first; the user names it, never a file.

    Raises:
        InputError: the model is unknown, or a module cannot be imported.
    """
    _import_all()
    import_models(module, f"model.module={module!a:.80}")
    if not isinstance(name, str) or name not in _REGISTRY:
        raise InputError(f"model '{name}' is not known. {did_you_mean(name, _REGISTRY)}")
    return _REGISTRY[name]


def is_registered(name: str) -> bool:
    """Tell whether gsbench, an installed package or an imported module has a model of this name.

    Raises:
        InputError: the models of an installed package cannot be imported.
    """
    _import_all()
    return name in _REGISTRY


def _import_all() -> None:
    """Import every module of `gsbench.models` and every entry point, if that was not done before."""
    package = importlib.import_module("gsbench.models")
    for own in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"gsbench.models.{own.name}")
    for point in entry_points(group=ENTRY_POINTS):
        import_models(point.module, f"entry point {point.name} of {ENTRY_POINTS}")


def import_models(module: str | None, named_by: str = "--model-module") -> None:
    """Import a module that registers models; raises InputError with one line that says where it fails.

    Args:
        module: its name, such as package.module; None for nothing.
        named_by: the option that named it, for the message.
    """
    if module is None:
        return
    try:
        importlib.import_module(module)
    except InputError:
        raise
    except Exception as error:  # whatever the code of another package raises
        place = traceback.extract_tb(error.__traceback__)[-1]
        where = "" if "importlib" in place.filename else f"{Path(place.filename).name}, line {place.lineno}: "
        raise InputError(f"{named_by}: expected a Python module that can be imported: {where}"
                         f"{type(error).__name__}: {one_line(error)}") from None  # fmt: skip


def build(name: str, *, module: str | None = None, **options: Any) -> GaussianModel:
    """Build the model registered as `name`, without Gaussians yet.

    Args:
        name: such as `3dgs`, `4dgs`, `6dgs`, `7dgs`.
        module: a Python module that registers it, as in `find`.
        options: of the model's class and of `GaussianModel`, such as `agr`, `sh_degree`, `lambda_t`.

    Returns:
        The model. `initialise` or `load_state` gives it Gaussians. `load_run` builds and loads a trained one.

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
    model = find(name, module)
    if inspect.isabstract(model):
        lacks = ", ".join(sorted(model.__abstractmethods__))
        raise InputError(f"model '{name}': expected all methods that a model needs, {model.__name__} lacks {lacks}")
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

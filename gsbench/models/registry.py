"""Register model classes by name, also those of other packages, and build models."""

import importlib
import inspect
import pkgutil
import traceback
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, TypeVar

from gsbench.errors import InputError, check_known, did_you_mean, one_line
from gsbench.models.base import GaussianModel

_REGISTRY: dict[str, type[GaussianModel]] = {}
HOW_TO = "adding_a_model.md"
ENTRY_POINTS = "gsbench.models"  # the group in which an installed package lists its modules of models
M = TypeVar("M", bound=type[GaussianModel])


def register(name: str) -> Callable[[M], M]:
    """Return a class decorator that registers a model as `name`.

    The decorator raises InputError if another class has the name, or if the class is no model.
    """

    def enter(model: M) -> M:
        _check_class(name, model)
        other = _REGISTRY.get(name, model)
        # A module that is imported again registers a new class of the same name, which replaces the old one.
        if (other.__module__, other.__qualname__) != (model.__module__, model.__qualname__):
            raise InputError(f"model '{name}': expected a name of its own, {other.__module__} has a model of that name")
        _REGISTRY[name] = model
        return model

    return enter


def _check_class(name: str, model: type) -> None:
    """Raise InputError unless a class is a model whose lists of names are tuples."""
    if not (isinstance(model, type) and issubclass(model, GaussianModel)):
        raise InputError(f"model '{name}': expected a subclass of GaussianModel, got {model!r:.80}", docs=HOW_TO)
    for attribute in ("observes", "centers", "geometry"):
        names = getattr(model, attribute, None)
        if not isinstance(names, tuple) or not all(isinstance(each, str) for each in names):
            raise InputError(f"model '{name}': {attribute}: expected a tuple of names, got {names!r:.80}", docs=HOW_TO)
    for each in model.observes:
        check_known(f"model '{name}': observes:", each, ("time", "direction"))


def find(name: str, module: str | None = None) -> type[GaussianModel]:
    """Return the model class registered as `name` by gsbench, an installed package, or a Python module to import.

    The name of the module must come from the user, never from a checkpoint, because an import runs code.

    Raises:
        InputError: the model is unknown, or a module cannot be imported.
    """
    _import_all()
    import_models(module, f"model.module={module!a:.80}")
    if not isinstance(name, str) or name not in _REGISTRY:
        hint = "" if module else " A model of yours needs module: NAME in its YAML."
        raise InputError(f"model '{name}' is not known. {did_you_mean(name, _REGISTRY)}{hint}", docs=HOW_TO)
    return _REGISTRY[name]


def is_registered(name: str) -> bool:
    """Return whether gsbench, an installed package or an imported module has registered a model as `name`."""
    _import_all()
    return name in _REGISTRY


def _import_all() -> None:
    """Import every module of `gsbench.models`, and those that installed packages list as entry points."""
    package = importlib.import_module("gsbench.models")
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"gsbench.models.{module.name}")
    for point in entry_points(group=ENTRY_POINTS):
        import_models(point.module, f"entry point {point.name} of {ENTRY_POINTS}")


def import_models(
    module: str | None,  # the name of the module, such as package.module; None: do nothing
    named_by: str = "--model-module",  # the option that gave the name, for the error message
) -> None:
    """Import a Python module that registers models; raises InputError with the file and line if the import fails."""
    if module is None:
        return
    if not all(part.isidentifier() for part in module.split(".")):
        raise InputError(f"{named_by}: expected the name of a module, such as package.module", docs=HOW_TO)
    try:
        importlib.import_module(module)
    except InputError:
        raise
    except Exception as error:  # whatever the code of another package raises
        place = traceback.extract_tb(error.__traceback__)[-1]  # in importlib if there is no such module
        where = "" if "importlib" in place.filename else f"{Path(place.filename).name}, line {place.lineno}: "
        is_absent = isinstance(error, ModuleNotFoundError) and error.name == module
        advice = ": run the command in its folder, or add this to PYTHONPATH" if is_absent else ""
        raise InputError(
            f"{named_by}: expected a Python module that can be imported: {where}"
            f"{type(error).__name__}: {one_line(error)}{advice}",
            docs=HOW_TO,
        ) from None


def build(name: str, *, module: str | None = None, **options: Any) -> GaussianModel:
    """Build the model registered as `name`, without Gaussians.

    Args:
        name: the name of the model, such as `3dgs`, `4dgs`, `6dgs`, `7dgs`.
        module: a Python module that registers the model, as in `find`.
        options: options of the model class and of `GaussianModel`, such as `agr`, `sh_degree`, `lambda_t`.

    Returns:
        The model. `initialise` or `load_state` gives it Gaussians. To load a trained model, use `load_run`.

    Raises:
        InputError: the model is unknown, an option is unknown or of the wrong type, or a required option is missing.

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
        raise InputError(
            f"model '{name}': expected all methods that a model needs, {model.__name__} lacks {lacks}",
            docs=HOW_TO,
        )
    # A constructor passes unknown options on to its base, so the options are those of all base classes.
    parameters: dict[str, inspect.Parameter] = {}
    for cls in (cls for cls in model.__mro__ if issubclass(cls, GaussianModel)):
        options_of_cls = inspect.signature(cls.__init__, eval_str=True).parameters.values()
        parameters = {p.name: p for p in options_of_cls if p.kind is p.KEYWORD_ONLY} | parameters
    for option, value in options.items():
        if option not in parameters:
            raise InputError(f"model '{name}' has no option '{option}'. {did_you_mean(option, parameters)}")
        if not _is_a(value, parameters[option].annotation):
            expected = getattr(parameters[option].annotation, "__name__", parameters[option].annotation)
            raise InputError(f"model '{name}': {option}: expected {expected}, got {value!r:.80}")
    for option, parameter in parameters.items():
        if parameter.default is parameter.empty and option not in options:
            raise InputError(f"model '{name}' needs the option '{option}', which has no default")
    return model(**options)


def _is_a(value: object, kind: Any) -> bool:
    """Return whether `value` has the type `kind` of a constructor's argument; an int is accepted as a float."""
    if kind is float:
        return type(value) in (int, float)
    if kind in (bool, int, str):
        return type(value) is kind
    return not isinstance(kind, type) or isinstance(value, kind)  # others, such as int | None, are not checked here

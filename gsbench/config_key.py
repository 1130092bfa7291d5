"""Describe a config key in its dataclass field: default, meaning, unit, range or choices, and what depends on it.

    iterations: int = key(30_000, "steps of this run", low=1)

All that is known of a key stands in this line. The schema, `--help`, docs/config.md, refusals, the name and the hash of
a run, and what `--against` compares are derived from it. This module imports only Python's own library.
"""

import copy
import dataclasses
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from gsbench.errors import InputError, did_you_mean

# What depends on a key: the training; only what is measured after it; no number of a record; and not even the record,
# because the key says how a run is launched.
Role = Literal["training", "measuring", "place", "launching"]

REQUIRED: Any = "???"  # the default of a key without default, for OmegaConf
ENDLESS = 10**9  # more than any machine can do
ANY_NAME = "NAME"  # stands for the names of a dict in a dotted key, such as model.lr.NAME.start
_FACTS = "key"
_T = TypeVar("_T")


@dataclass(frozen=True)
class Key:
    """The facts of a config key, or of a group of keys."""

    default: Any = None
    help: str = ""
    unit: str = ""
    low: float = -math.inf  # the range, both ends included
    high: float = ENDLESS
    choices: tuple[str, ...] = ()  # allowed texts; () for any
    role: Role | None = None  # None: that of the group; "training" outside of groups
    needs: str | None = None  # the key counts only if this other key is set, and not to its `absent`
    absent: Any = None  # what runs had before there was the key; this value does not change their hashes
    kind: Any = None  # the type

    @property
    def range(self) -> str:
        """Return the range or the choices as text; "" if every value is allowed."""
        if self.choices:
            return ", ".join(self.choices)
        if self.low == -math.inf:
            return ""
        return f"{self.low:.9g} to {self.high:.9g}" if self.high < ENDLESS else f"at least {self.low:.9g}"

    @property
    def shown(self) -> str:
        """Return the default as a YAML file has it; "" if the key has none."""
        if self.default == REQUIRED:
            return ""
        is_word = self.default is None or isinstance(self.default, bool)
        return json.dumps(self.default) if is_word else str(self.default) or "''"

    def check(self, name: str, value: Any) -> None:
        """Raise InputError if a value of the key is not finite, out of range or none of the choices."""
        if self.choices and value is not None and value not in self.choices:
            raise InputError(f"{name} '{value}' is not known. {did_you_mean(value, self.choices)}")
        if isinstance(value, float) and not math.isfinite(value):
            raise InputError(f"{name}: expected a finite number, got {value}")
        if isinstance(value, int | float) and self.low > -math.inf and not self.low <= value <= self.high:
            # `range` does not name the limit ENDLESS, which a value may exceed.
            expected = self.range if value < self.low or self.high < ENDLESS else f"at most {self.high:.9g}"
            raise InputError(f"{name}: expected {expected}{self.unit and f' {self.unit}'}, got {value}")


def key(
    default: Any,
    help: str,
    *,
    unit: str = "",
    low: float = -math.inf,
    high: float = ENDLESS,
    choices: tuple[str, ...] = (),
    role: Role | None = None,
    needs: str | None = None,
    absent: Any = None,
) -> Any:
    """Return the dataclass field of a config key; `Key` explains the arguments."""
    facts = {_FACTS: Key(default, help, unit, low, high, choices, role, needs, absent)}
    if isinstance(default, list | dict):
        return field(default_factory=lambda: copy.deepcopy(default), metadata=facts)
    return field(default=default, metadata=facts)


def group(kind: type, help: str = "", *, role: Role | None = None) -> Any:
    """Return the dataclass field of a group of keys, whose role is that of all keys that have no other."""
    return field(default_factory=kind, metadata={_FACTS: Key(help=help, role=role)})


def described(config: type, dotted: str) -> Key:
    """Return the facts of a dotted key, such as "train.iterations", "train" or "model.lr.means.start".

    A key that no dataclass declares, such as `model.options.scheme`, counts as the group in which it is.
    """
    facts = _root(config)
    for name in dotted.split("."):
        inner = _members(facts)
        if name not in inner and ANY_NAME not in inner:
            return Key(role=facts.role, needs=facts.needs)
        facts = inner[name if name in inner else ANY_NAME]
    return facts


def declared(config: type) -> dict[str, Key]:
    """Return every key of a config by its dotted name, those of a group after the keys beside it."""
    return dict(_leaves(_root(config), ""))


def _leaves(facts: Key, prefix: str) -> Iterator[tuple[str, Key]]:
    inner = _members(facts)
    yield from ((f"{prefix}{name}", key) for name, key in inner.items() if not _members(key))
    for name, key in inner.items():
        yield from _leaves(key, f"{prefix}{name}.")


def _root(config: type) -> Key:
    return Key(role="training", kind=config)


def _members(group: Key) -> dict[str, Key]:
    """Return what a group of keys declares, by name; {} for a key with a value."""
    kind = group.kind
    if get_origin(kind) is dict and dataclasses.is_dataclass(get_args(kind)[1]):  # groups by free names
        return {ANY_NAME: Key(role=group.role, needs=group.needs, kind=get_args(kind)[1])}
    if not dataclasses.is_dataclass(kind):
        return {}
    hints = get_type_hints(kind)
    members = {}
    for each in dataclasses.fields(kind):
        facts = each.metadata.get(_FACTS, Key())
        inherited = {"role": facts.role or group.role, "needs": facts.needs or group.needs}
        members[each.name] = dataclasses.replace(facts, kind=hints[each.name], **inherited)
    return members


_joining: dict[str, list[type]] = {}  # the dataclasses that join a group of the config, by its dotted name


def joins(group: str) -> Callable[[type[_T]], type[_T]]:
    """Let the keys of a dataclass join a group of the config, such as "train", or the config itself for "".

    It is for the modules of gsbench/train/hooks/, which gsbench/config.py imports (and explains).
    """

    def register(kind: type[_T]) -> type[_T]:
        _joining.setdefault(group, []).append(kind)
        return kind

    return register


def extended(group: str) -> Callable[[type[_T]], type[_T]]:
    """Add to the dataclass of a group the keys of all that join it, after its own and by the names of their modules."""

    def extend(kind: type[_T]) -> type[_T]:
        joining = sorted(_joining.get(group, []), key=lambda joined: joined.__module__, reverse=True)
        names = {"__module__": kind.__module__, "__qualname__": kind.__qualname__, "__doc__": kind.__doc__}
        return dataclass(type(kind.__name__, (*joining, kind), names))  # the fields of the last base come first

    return extend

"""Parse plain JSON into typed dataclasses; unknown keys, wrong types and NaN are errors."""

import dataclasses
import math
from functools import cache
from types import UnionType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from gsbench.errors import InputError, did_you_mean

T = TypeVar("T")
LARGEST = 1e100  # squares stay finite, and charts can show the number
MOST_ENTRIES = 1000  # of a list or an object, unless its field's metadata have another number under MOST
MOST = "most"


def parse(kind: type[T], value: object, file: str) -> T:
    """Parse `value`, the result of json.loads, into an instance of the dataclass `kind`.

    Fields may be dataclasses, named tuples, list[X], dict[str, X], X | None, bool, int, float (integers are accepted),
    str, and Any (plain JSON). Lists and objects have at most MOST_ENTRIES entries, or as many as the metadata of their
    field say (`field(metadata={MOST: 9})`). A dataclass may have a method `with_present_names`, which renames keys of
    older files.

    Raises:
        InputError: `value` does not match; the message is `<file>: <field>: expected ..., got ...`.
    """
    parsed: T = _parse(kind, value, file, "")
    return parsed


def _parse(kind: Any, value: Any, file: str, field: str, most: int = MOST_ENTRIES) -> Any:
    """Parse `value` as the type `kind`; `field` is its path in the file, such as `cost.render_ms.p50` or `curve[3]`."""
    if isinstance(value, list | dict) and len(value) > most:
        raise InputError(f"{file}: {field or 'the file'}: expected at most {most:,} entries, got {len(value):,}")
    if dataclasses.is_dataclass(kind):
        return _parse_fields(kind, value, file, field)
    if hasattr(kind, "_fields"):  # a named tuple, written as a list
        kinds = list(_kinds(kind).values())
        if type(value) is not list or len(value) != len(kinds):
            raise _fault(file, field, f"a list of {', '.join(kind._fields)}", value)
        return kind(*(_parse(k, v, file, f"{field}[{i}]") for i, (k, v) in enumerate(zip(kinds, value, strict=True))))
    if isinstance(kind, UnionType):
        return None if value is None else _parse(get_args(kind)[0], value, file, field, most)
    if get_origin(kind) is list:
        if type(value) is not list:
            raise _fault(file, field, "a list", value)
        return [_parse(get_args(kind)[0], v, file, f"{field}[{i}]") for i, v in enumerate(value)]
    if get_origin(kind) is dict:
        if type(value) is not dict:
            raise _fault(file, field, "an object", value)
        return {_text(k, file, field): _parse(get_args(kind)[1], v, file, f"{field}.{k}") for k, v in value.items()}
    if kind is Any:
        return _parse_any(value, file, field)
    return _parse_scalar(kind, value, file, field)


@cache
def _kinds(kind: Any) -> dict[str, Any]:
    """Return the field types of a dataclass or named tuple, in order."""
    return get_type_hints(kind)


def _parse_fields(kind: Any, value: Any, file: str, field: str) -> Any:
    """Parse an object as the dataclass `kind`: fields without a default are required, and other keys are errors."""
    if type(value) is not dict:
        raise _fault(file, field, "an object", value)
    if hasattr(kind, "with_present_names"):
        value = kind.with_present_names(value)
    kinds = _kinds(kind)
    prefix = f"{field}." if field else ""
    for name in value:
        if name not in kinds:
            raise InputError(f"{file}: {prefix}{name[:80]!a}: unknown key. {did_you_mean(name, kinds)}")
    for one in dataclasses.fields(kind):  # a field added later has a default, so older files stay readable
        if one.name not in value and one.default is one.default_factory is dataclasses.MISSING:
            raise InputError(f"{file}: {prefix}{one.name}: expected a value, the key is missing")
    most = {one.name: one.metadata.get(MOST, MOST_ENTRIES) for one in dataclasses.fields(kind)}
    return kind(**{name: _parse(kinds[name], given, file, prefix + name, most[name]) for name, given in value.items()})


def _parse_any(value: Any, file: str, field: str) -> Any:
    """Parse plain JSON of any type; numbers must be finite."""
    if value is None or type(value) is bool:
        return value
    for container in (dict[str, Any], list[Any]):
        if type(value) is get_origin(container):
            return _parse(container, value, file, field)
    if type(value) is float and math.isfinite(value):  # a setting may be any finite number
        return value
    return _parse_scalar(type(value), value, file, field)


def _parse_scalar(kind: Any, value: Any, file: str, field: str) -> Any:
    """Parse a bool, int, float or str; only an int in place of a float is converted."""
    if kind is str and type(value) is str:
        return _text(value, file, field)
    if kind is int and type(value) is int and abs(value) < 2**63:  # tables cannot store larger integers
        return value
    if kind is float and type(value) in (int, float):
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if abs(number) <= LARGEST:
            return number
    if kind is bool and type(value) is bool:
        return value
    names = {
        str: "a string",
        int: "an integer",
        float: f"a finite number of at most {LARGEST:g}",
        bool: "true or false",
    }
    raise _fault(file, field, names.get(kind, "plain JSON"), value)


def _text(value: str, file: str, field: str) -> str:
    """Parse a string that can be encoded as UTF-8; JSON escapes may also form lone surrogates, which are errors."""
    try:
        value.encode()
    except UnicodeEncodeError:
        raise _fault(file, field, "Unicode text", value) from None
    return value


def _fault(file: str, field: str, expected: str, value: Any) -> InputError:
    return InputError(f"{file}: {field or 'the file'}: expected {expected}, got {ascii(value)[:80]}")

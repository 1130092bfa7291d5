"""Parse plain JSON into typed dataclasses with msgspec; unknown keys, wrong types, NaN and endless lists are errors."""

import dataclasses
from typing import Any, TypeVar

import msgspec

from gsbench.errors import InputError, did_you_mean, printable

T = TypeVar("T")
LARGEST = 1e100  # squares stay finite, and charts can show the number
MOST_ENTRIES = 10_000  # of a list or an object, unless its type says less by msgspec.Meta(max_length=..)


def parse(kind: type[T], plain: object, file: str, most: int = MOST_ENTRIES) -> T:
    """Convert `plain`, the result of json.loads, to an instance of the dataclass `kind`.

    An integer is accepted in place of a float, and nothing else is converted. Lists and objects have at most `most`
    entries.

    Raises:
        InputError: `plain` does not match; the message is `<file>: <field>: expected ..., got ...`.
    """
    try:
        parsed = msgspec.convert(plain, kind)
        _check(plain, parsed, file, "", most)
    except msgspec.ValidationError as error:
        message, _, place = str(error).partition(" - at `$")
        text = f"{message[:1].lower()}{message[1:]}".replace("`", "")
        raise InputError(f"{file}: {place.strip('.`') or 'the file'}: {printable(text)[:300]}") from None
    except RecursionError:
        raise InputError(f"{file}: expected fewer objects within objects") from None
    except UnicodeEncodeError:  # msgspec compares keys and choices as UTF-8, which has no lone surrogate
        raise InputError(f"{file}: expected Unicode text, got half of a surrogate pair") from None
    return parsed


def _check(plain: Any, parsed: Any, file: str, place: str, most: int) -> None:
    """Check what types do not say: that no key is left over, and that numbers and texts can be written and shown."""
    prefix = f"{file}: {place or 'the file'}"
    if isinstance(plain, dict | list) and len(plain) > most:
        raise InputError(f"{prefix}: expected at most {most:,} entries, got {len(plain):,}")
    if isinstance(plain, dict):
        fields = {field.name for field in dataclasses.fields(parsed)} if dataclasses.is_dataclass(parsed) else None
        for key, value in plain.items():
            _check(key, key, file, place, most)
            if fields is not None and key not in fields:
                raise InputError(f"{prefix}: unknown key {key[:80]!a}. {did_you_mean(key, fields)}")
            inner = parsed[key] if fields is None else getattr(parsed, key)
            _check(value, inner, file, f"{place}.{key}".lstrip("."), most)
    elif isinstance(plain, list):
        for i, (value, inner) in enumerate(zip(plain, parsed, strict=True)):
            _check(value, inner, file, f"{place}[{i}]", most)
    elif isinstance(plain, str) and not plain.isascii():
        try:
            plain.encode()
        except UnicodeEncodeError:  # a lone surrogate, which JSON can escape
            raise InputError(f"{prefix}: expected Unicode text, got {plain[:80]!a}") from None
    elif isinstance(plain, float) and not abs(plain) <= LARGEST:
        raise InputError(f"{prefix}: expected a finite number of at most {LARGEST:g}, got {plain}")
    elif isinstance(plain, int) and abs(plain) >= 2**63:  # tables cannot store larger integers
        raise InputError(f"{prefix}: expected an integer below 2^63, got one of {len(str(plain))} digits")

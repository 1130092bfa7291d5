"""Check that Hydra reads an override as it was typed, and put values in quotes that it would not read so."""

import re
import shlex
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Quote, QuotedString
from hydra.errors import HydraException

from gsbench.config_roles import facts
from gsbench.errors import InputError

_TEXTS = (str, str | None)  # the types of keys whose values are texts


def check_override(word: str) -> None:
    """Raise InputError if Hydra cannot read an override, or would read another text, such as 20240102 for 2024_01_02.

    The message has the override as it is to be typed in a shell, with quotes around the value.
    """
    key, _, text = word.partition("=")
    kind = facts(key.lstrip("+")).kind  # the type of the key's values
    read = _read(word)
    if isinstance(read, HydraException) or not key:
        if not key or isinstance(_read(f"{key}=x"), HydraException) or "=" not in word:  # never an override
            raise InputError(f"{word!r:.300}: expected KEY=VALUE, such as model=7dgs or +exp=mini")
        raise InputError(
            f"{key}: expected quotes around {text}, as some of its characters have another meaning for "
            f"Hydra: type {typed(key, text, several=kind not in _TEXTS)}"
        )
    # A sweep a,b has several values, and so has a list [a,b], unless the key has a text, such as "[a,b]".
    several = isinstance(read, ChoiceSweep) or (isinstance(read, list) and kind not in _TEXTS)
    values = list(read.list) if isinstance(read, ChoiceSweep) else read if several else [read]
    texts = _parts(text) if several else [text]  # as they were typed
    if kind in (*_TEXTS, list[str]) and any(
        isinstance(value, int | float | list | dict) and str(value) != part
        for value, part in zip(values, texts, strict=False)  # a comma in quotes makes more parts than values
    ):
        raise InputError(
            f"{key}: expected a text, Hydra reads {text} as {', '.join(map(str, values))}: type "
            f"{typed(key, text, several)}"
        )


def quoted_value(text: str) -> str:
    """Return a text for Hydra: as it is, or in quotes if Hydra would read another value or none."""
    return text if text and _read(f"x={text}") == text else QuotedString(text, Quote.single).with_quotes()


def typed(key: str, text: str, several: bool) -> str:
    """Return an override for a shell, with its value, or each of several values, in quotes that Hydra removes."""
    values = ",".join(map(quoted_value, _parts(text) if several else [text]))
    word = f"{key}=[{values}]" if several and _is_list(text) else f"{key}={values}"
    return shlex.quote(word) if "!" in word else '"' + re.sub(r'(["$`\\])', r"\\\1", word) + '"'


def _read(word: str) -> Any:
    """Return the value of an override as Hydra reads it, or Hydra's error."""
    try:
        return OverridesParser.create().parse_override(word).value()
    except HydraException as error:
        return error


def _is_list(text: str) -> bool:
    return text.startswith("[") and text.endswith("]")


def _parts(text: str) -> list[str]:
    """Return the values of a list or a sweep, which commas separate."""
    return [part.strip() for part in (text[1:-1] if _is_list(text) else text).split(",")]

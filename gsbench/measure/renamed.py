"""Translate config keys that were renamed, in the published records of older versions."""

import re
from collections.abc import Mapping
from typing import Any

RENAMED: Mapping[tuple[str, str], str] = {  # (group, name) -> name
    ("data", "modulation"): "initial_lambda",
    ("train", "modulation_from"): "lambda_from",
    ("model.lr", "modulation"): "lambda",
}
_CANDIDATE = re.compile(r"^model\.candidates\.[^.]+")  # of model=auto: a model config


def with_present_keys(plain: dict[str, Any], group: str = "") -> dict[str, Any]:
    """Return a nested config with the present names of all keys.

    `group` is the dotted key at which `plain` belongs in the whole config, such as "train"; "" for a whole config.
    """
    present: dict[str, Any] = {}
    for name, value in plain.items():
        inner = with_present_keys(value, f"{group}.{name}".lstrip(".")) if isinstance(value, dict) else value
        present[RENAMED.get((_CANDIDATE.sub("model", group), name), name)] = inner
    return present

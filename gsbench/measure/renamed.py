"""Know the keys of the config that were renamed: older command lines, records and checkpoints hold their old names.

Nothing else knows an old name of a key. The module needs no torch.
"""

import re
from collections.abc import Mapping
from typing import Any

Names = Mapping[tuple[str, str], str]  # (group, name) -> name

RENAMED: Names = {
    ("data", "modulation"): "initial_lambda",
    ("train", "modulation_from"): "lambda_from",
    ("model.lr", "modulation"): "lambda",
}
_OLD: Names = {(group, new): old for (group, old), new in RENAMED.items()}
_CANDIDATE = re.compile(r"^model\.candidates\.[^.]+")  # of model=auto: a model config
_OVERRIDE = re.compile(r"([+~]*)([\w.]+)(.*)", re.DOTALL)
_REFERENCE = re.compile(r"(?<=\$\{)[\w.]+(?=\})")


def present_key(key: str) -> str:
    """Return the name that a dotted key has now."""
    return _renamed(key, RENAMED)


def old_key(key: str) -> str:
    """Return the first name of a dotted key: hashes are taken of it, so that a new name changes no older run's."""
    return _renamed(key, _OLD)


def present_override(override: str) -> str:
    """Return an override of a command line with the names that its key and its `${keys}` have now."""
    match = _OVERRIDE.fullmatch(override)
    if match is None:
        return override
    signs, key, value = match.groups()
    return f"{signs}{present_key(key)}{_REFERENCE.sub(lambda found: present_key(found.group()), value)}"


def with_present_keys(plain: dict[str, Any], group: str = "") -> dict[str, Any]:
    """Return a nested config, or one group of it, with the names that its keys have now."""
    found: dict[str, Any] = {}
    for name, value in plain.items():
        inner = with_present_keys(value, f"{group}.{name}".lstrip(".")) if isinstance(value, dict) else value
        found[_name(group, name, RENAMED)] = inner
    return found


def _renamed(key: str, names: Names) -> str:
    parts = key.split(".")
    return ".".join(_name(".".join(parts[:i]), part, names) for i, part in enumerate(parts))


def _name(group: str, name: str, names: Names) -> str:
    return names.get((_CANDIDATE.sub("model", group), name), name)

"""Translate config keys that were renamed, so that command lines, records and checkpoints with old keys still work.

No other module knows an old key. The module does not import torch.
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
    """Return the present name of a dotted config key, such as `train.lambda_from` for `train.modulation_from`."""
    return _renamed(key, RENAMED)


def old_key(key: str) -> str:
    """Return the oldest name of a dotted config key.

    Hashes of configs use the oldest names, so that renaming a key does not change the hashes of earlier runs.
    """
    return _renamed(key, _OLD)


def present_override(override: str) -> str:
    """Return a command-line override with the present names of its key and of the keys in `${...}`."""
    match = _OVERRIDE.fullmatch(override)
    if match is None:
        return override
    signs, key, value = match.groups()
    return f"{signs}{present_key(key)}{_REFERENCE.sub(lambda found: present_key(found.group()), value)}"


def with_present_keys(plain: dict[str, Any], group: str = "") -> dict[str, Any]:
    """Return a nested config with the present names of all keys.

    `group` is the dotted key at which `plain` belongs in the whole config, such as "train"; "" for a whole config.
    """
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

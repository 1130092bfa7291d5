"""Tell from a run's config what its training is, what is only measured otherwise, and compare two configs.

What depends on a key stands in its field (`gsbench.config_key.Role`). Configs are in plain JSON, as they are recorded.
"""

import functools
import hashlib
import json
from collections.abc import Iterator, Sequence
from typing import Any

from gsbench.config import Config
from gsbench.config_key import Key, described

Plain = dict[str, Any]  # a resolved config in plain JSON

ADDED = ("exp", "recipe", "trial", "ablation")  # config groups that a command line adds; a later one replaces values
OWN_NAMES = ("exp", "model", "scene")  # the config groups that have a place in a run's path
_MOST_NAMED = 5  # the most differences that a message contains


@functools.cache
def facts(dotted: str) -> Key:
    """Return the facts of a dotted config key; a key that no dataclass declares counts as its group."""
    return described(Config, dotted)


def flat(plain: Plain, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the leaves of a nested config as (dotted key, value)."""
    for key, value in plain.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def training_keys(plain: Plain) -> Plain:
    """Return the keys of a config on which its training depends, as a flat dict."""
    whole = dict(flat(plain))

    def is_set(key: str) -> bool:  # to another value than null and `Key.absent`
        return whole.get(key, facts(key).absent) not in (None, facts(key).absent)

    return {
        key: value
        for key, value in whole.items()
        if facts(key).role == "training" and ((needed := facts(key).needs) is None or is_set(needed))
    }


def names_variant(group: str) -> bool:
    """Tell whether the choice of a config group is part of the name of a run's variant."""
    return group not in OWN_NAMES and not group.startswith(("hydra", "launch"))


def training_hash(plain: Plain) -> str:
    """Return the SHA-256 of all settings that change the training; a checkpoint with an equal hash can be resumed."""
    return config_hash(_decided(training_keys(plain)))


def config_hash(plain: Plain) -> str:
    """Return the SHA-256 of a config; the order of its keys does not matter."""
    return hashlib.sha256(json.dumps(plain, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def training_differences(before: Plain, after: Plain) -> list[str]:
    """Describe the settings that change the training and differ; [] if both configs have the same training."""
    return _differences(training_keys(before), training_keys(after))


def measuring_differences(before: Plain, after: Plain) -> list[str]:
    """Describe the settings that change only what is measured, and differ between two configs."""
    return _differences(
        *({key: value for key, value in flat(plain) if facts(key).role == "measuring"} for plain in (before, after))
    )


def listed(differences: list[str]) -> str:
    """Join descriptions of differences to one line, which contains only the first few and the number of others."""
    more = len(differences) - _MOST_NAMED
    return "; ".join(differences[:_MOST_NAMED]) + (f"; and {more} more" if more > 0 else "")


def recorded(plain: Plain) -> Plain:
    """Return a config without the keys that only say how a run is launched."""
    return {key: value for key, value in plain.items() if facts(key).role != "launching"}


def repeating(overrides: Sequence[str]) -> list[str]:
    """Return the sorted overrides of a command line that are needed to repeat a run; equal runs have equal lists."""
    return sorted(override for override in overrides if facts(key_of(override)).role != "launching")


def launches(override: str) -> bool:
    """Return whether an override only sets how a run is launched, for instance on Slurm."""
    return key_of(override).partition(".")[0] == "launch"


def key_of(override: str) -> str:
    """Return the dotted key of an override of a command line, such as "seed" of "+seed=3"."""
    return override.partition("=")[0].lstrip("+~")


def in_order(words: Sequence[str]) -> list[str]:
    """Return the words of a command line with added configs in the order of ADDED, and then by name.

    So the order in which they were typed does not matter: a record, whose words must repeat the run, does not keep it.
    """

    def place(word: str) -> tuple[int, str]:
        name = key_of(word)
        return (ADDED.index(name), "") if name in ADDED else (len(ADDED), name)

    added = sorted((word for word in words if word.startswith("+")), key=place)
    return [*added, *(word for word in words if not word.startswith("+"))]


def without_agr(label: str) -> str:
    """Return the name of the model of a label, which says whether it has AGR: 7dgs of 7dgs_noagr."""
    return label.removesuffix("_noagr").removesuffix("_agr")


def _decided(keys: Plain) -> Plain:
    """Return the keys of a flat config whose value is not that of runs from before there was the key."""
    return {key: value for key, value in keys.items() if value is not None and value != facts(key).absent}


def _differences(before: Plain, after: Plain) -> list[str]:
    """Describe the keys whose values differ in two flat configs, in which a key that is not set is missing."""
    # Hashes are compared, not values: 1, 1.0 and True are equal to Python, but they are other settings. []: not set.
    before, after = _decided(before), _decided(after)
    return [
        f"{key} {_shown(after, key)} instead of {_shown(before, key)}"
        for key in sorted(before.keys() | after.keys())
        if config_hash({"": before.get(key, [])}) != config_hash({"": after.get(key, [])})
    ]


def _shown(config: Plain, key: str) -> str:
    return f"{config[key]!s:.80}" if key in config else "not set"

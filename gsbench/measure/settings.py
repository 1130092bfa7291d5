"""Separate settings that change the training from settings that only change measurements, and compare two configs.

The module does not import torch.
"""

from collections.abc import Collection, Iterator
from typing import Any

from gsbench.measure.provenance import config_hash
from gsbench.measure.renamed import old_key

Plain = dict[str, Any]  # a resolved config in plain JSON

# Settings of measuring, and the places of data and results, change no training. `best_on_test` and `eval_split` are
# not here: the best iteration is found while the model trains.
MEASURING = (
    "experiment", "results", "resume", "log", "launch", "data.dataset", "data.paper_dataset", "data.published",
    "data.root", "data.scenes", "init.ply", "scene.released_as", "train.checkpoint_minutes", "protocol.name",
    "protocol.quantise", "protocol.lpips_alex", "protocol.lpips_vgg", "protocol.renders", "protocol.pictures",
)  # fmt: skip
# The places among them: no number of a record depends on them, as LPIPS weights are checked by their hash.
PLACES = (
    "results", "resume", "log", "launch", "data.root", "data.published", "data.scenes", "init.ply",
    "scene.released_as", "train.checkpoint_minutes", "protocol.lpips_alex", "protocol.lpips_vgg",
)  # fmt: skip
# Keys that are missing in older configs, with the value that all older runs had.
ALWAYS = {
    "train.densify.kind": "gradient",
    "train.densify.noise": 5e5,  # older runs had no `mcmc`, which it is for
    "effects.compare": False,
    **{f"train.penalties.{name}.{key}": 0 for name in ("opacity", "size", "strain") for key in ("weight", "start")},
}
_MOST_NAMED = 5  # the most differences that a message contains


def training_part(plain: Plain) -> Plain:
    """Return the settings of a config that change the training."""
    part: Plain = {key: dict(value) if isinstance(value, dict) else value for key, value in plain.items()}
    effects = part.get("effects", {})
    compares = effects.get("compare", False)
    if effects.get("gate") == "off":
        del part["effects"]
        if compares:
            part["effects"] = {"compare": compares}
    if isinstance(part.get("model"), dict):
        part["model"].pop("gate", None)  # only the default of effects.gate
        if not compares:
            part["model"].pop("compared", None)
    for dotted in MEASURING:
        head, _, tail = dotted.partition(".")
        if not tail:
            part.pop(head, None)
        elif isinstance(part.get(head), dict):
            part[head].pop(tail, None)
    return part


def training_hash(plain: Plain) -> str:
    """Return the SHA-256 of all settings that change the training; a checkpoint with an equal hash can be resumed."""
    return config_hash({old_key(key): value for key, value in given(training_part(plain)).items()})


def given(plain: Plain) -> Plain:
    """Return a config as a flat dict with dotted keys, without null values and without the values in ALWAYS.

    ALWAYS holds keys that older configs lack, with the value that all older runs used. Leaving these values out keeps
    the hashes of old and new configs equal.
    """
    return {key: value for key, value in flat(plain) if value is not None and ALWAYS.get(key) != value}


def flat(plain: Plain, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the leaves of a nested config as (dotted key, value)."""
    for key, value in plain.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def training_differences(theirs: Plain, mine: Plain) -> list[str]:
    """Return descriptions of the settings that change the training and differ between two configs.

    The list is empty if both configs describe the same training.
    """
    return _differences(given(training_part(theirs)), given(training_part(mine)))


def measuring_differences(theirs: Plain, mine: Plain) -> list[str]:
    """Return descriptions of the settings that only change measurements and differ between two configs."""
    read = [given(training_part(config)).keys() for config in (theirs, mine)]
    return _differences(*(
        {key: value for key, value in given(config).items() if key not in keys and not _is_of(key, PLACES)
         and not key.startswith(("effects.", "model."))} for config, keys in zip((theirs, mine), read, strict=True)
    ))  # fmt: skip


def listed(differences: list[str]) -> str:
    """Join descriptions of differences to one line, which contains only the first few and the number of others."""
    more = len(differences) - _MOST_NAMED
    return "; ".join(differences[:_MOST_NAMED]) + (f"; and {more} more" if more > 0 else "")


def _differences(theirs: Plain, mine: Plain) -> list[str]:
    return [f"{key} {_shown(mine, key)} instead of {_shown(theirs, key)}"
            for key in sorted(theirs.keys() | mine.keys())
            if config_hash({"": theirs.get(key, [])}) != config_hash({"": mine.get(key, [])})]  # fmt: skip


def _shown(config: Plain, key: str) -> str:
    return f"{config[key]!s:.80}" if key in config else "not set"


def _is_of(key: str, settings: Collection[str]) -> bool:
    """Return whether `settings` contains a dotted key or a group of keys to which it belongs."""
    return any(key == one or key.startswith(f"{one}.") for one in settings)

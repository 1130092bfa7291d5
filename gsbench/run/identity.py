"""Name a run by the settings that change its training: a label, a variant and a folder."""

import hashlib
import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig, OmegaConf

from gsbench.config import CONF, Config
from gsbench.config_roles import OWN_NAMES, Plain, flat, in_order, names_variant, recorded, repeating, training_keys
from gsbench.errors import InputError, deleted_key
from gsbench.measure import record as records
from gsbench.reading import read_file
from gsbench.run.grammar import quoted_value
from gsbench.run.settings import label_of
from gsbench.scenes.files import digest
from gsbench.scenes.ply import MAX_FILE

LONGEST_VARIANT = 80  # characters; longer names could exceed the limits of a path


@dataclass(frozen=True)
class RunSpec:
    """The training and measurement of one model on one scene with one seed: settings, names and folder."""

    config: Config
    plain: Plain  # the settings as they are recorded, plain values
    folder: Path  # the folder of the record, the checkpoint and the images
    label: str  # the model's name, with _agr or _noagr if it differs from the published method
    variant: str = ""  # settings of its training that differ from the experiment's, such as "iterations=10"
    overrides: list[str] = field(default_factory=list)  # arguments of `python -m gsbench` that repeat the run

    @property
    def name(self) -> str:
        """Return the name of the run in messages: scene, model label, variant (changed settings) and seed."""
        variant = f" {self.variant}" if self.variant else ""
        return f"{self.config.scene.name} {self.label}{variant} seed{self.config.seed}"


def identify(composed: DictConfig, choices: Mapping[str, str] | None = None, overrides: Sequence[str] = ()) -> RunSpec:
    """Resolve the settings of one run, and give the run its label, variant and folder.

    Args:
        composed: the config of one scene, as Hydra composed it.
        choices: the choice of each config group (HydraConfig.runtime.choices); None for a run without variant.
        overrides: the overrides of the command line.

    Raises:
        InputError: a name is not a valid folder name, or the file of trained Gaussians does not exist.
    """
    config: Config = OmegaConf.to_object(composed)  # type: ignore[assignment]
    for dotted, name in (("experiment", config.experiment), ("scene.name", config.scene.name)):
        if name == records.PUBLISHED:
            raise InputError(f"{dotted}: expected another name than {name!r}: tables pass by a folder of this name")
    plain: Plain = OmegaConf.to_container(composed, resolve=True)  # type: ignore[assignment]
    if not config.results:
        raise InputError("results: expected a folder, got '': results=. is this one")
    if config.init.ply is not None:  # a training is told from others by the content of the file, not by its path
        config.init.ply_sha256 = plain["init"]["ply_sha256"] = config.init.ply_sha256 or hash_of(config.init.ply)
    label = label_of(config)
    variant = name_variant(plain, choices) if choices else ""
    folder = records.run_path(
        Path(config.results), config.experiment, config.scene.name, label, config.seed, variant=variant
    )
    plain = _storable(recorded(plain))
    return RunSpec(config, plain, folder, label, variant, repeating(overrides))


def hash_of(ply: str) -> str:
    """Return the SHA-256 of the PLY file from which a training starts.

    Raises:
        InputError: the file cannot be read.
    """
    return digest(read_file(Path(os.path.expanduser(ply)), f"init.ply={ply!a:.200}", MAX_FILE))


def name_variant(plain: Plain, choices: Mapping[str, str]) -> str:
    """Return a name for the settings that change the training and differ from the experiment's; "" if there are none.

    A changed config group appears as its choice (`recipe=paper`), and a changed key as its value (`iterations=10`).
    Model, scene and seed are not part of the name. A long name is cut after a whole word and ends in a hash.

    Raises:
        InputError: a setting of the model was deleted, which no name could tell.
    """
    defaults: Any = OmegaConf.to_container(OmegaConf.load(CONF / "config.yaml").defaults)
    standard = {group: choice for entry in defaults if isinstance(entry, dict) for group, choice in entry.items()}
    groups = {group: choice for group, choice in choices.items() if choice and names_variant(group)}
    words = [f"{group}={_printed(choice)}" for group, choice in groups.items() if standard.get(group) != choice]
    # The overrides that compose the experiment as it is, with this model, scene and seed, to compare with.
    base = [
        f"{'' if group in standard else '+'}{group}={quoted_value(choice)}"
        for group, choice in [*((name, choices[name]) for name in OWN_NAMES), *groups.items()]
    ]
    base += [f"seed={plain['seed']}", f"agr={str(plain['agr']).lower()}"]
    base += [f"scene.name={quoted_value(plain['scene']['name'])}"]
    before = dict(flat(OmegaConf.to_container(hydra.compose("config", in_order(base)), resolve=True)))  # type: ignore[arg-type]
    after = dict(flat(plain))
    for key in before:
        if key.startswith("model.") and key not in after:
            raise deleted_key(key)
    changed = {key: value for key, value in training_keys(plain).items() if key not in before or value != before[key]}
    # Keys without their first group, or without "model.options": densify.every of train.densify.every.
    shorts = [key.removeprefix("model.options.").partition(".")[2] or key.rpartition(".")[2] for key in changed]
    for (key, value), short in zip(changed.items(), shorts, strict=True):
        words.append(f"{short if shorts.count(short) == 1 else key}={_printed(value)}")
    return _cut(words)


def _storable(value: Any) -> Any:
    """Convert values that a record cannot hold, such as NaN, to text; a run with such values is refused."""
    if isinstance(value, dict):
        return {key: _storable(member) for key, member in value.items()}
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    return value if not isinstance(value, int) or abs(value) < 2**63 else str(value)


def _printed(value: Any) -> str:
    """Format a value for a folder name: a SHA-256 as its first digits, unsafe characters as a hash."""
    text = value if isinstance(value, str) else json.dumps(value)
    if re.fullmatch("[0-9a-f]{64}", text):
        return text[:8]
    text = text.replace("/", ".")
    return text if re.fullmatch(r"[A-Za-z0-9_.+-]+", text) else _digest(text)


def _cut(words: list[str]) -> str:
    """Join words by commas; if the result is too long, keep the first words and append a hash of all words."""
    variant = ",".join(words)
    if len(variant) <= LONGEST_VARIANT:
        return variant
    ending = f",{_digest(variant)}"
    while words and len(",".join(words) + ending) > LONGEST_VARIANT:
        words = words[:-1]
    return (",".join(words) + ending).lstrip(",")


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:8]

"""Check what a user asks for, before a file is read and before torch is imported; name the models of model=auto."""

import dataclasses
import importlib.resources
import itertools
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsbench.config import Config, LearningRate, ModelConfig
from gsbench.config_roles import facts, flat
from gsbench.errors import InputError, did_you_mean
from gsbench.train.hooks import check_step, hook_types

AUTO = "auto"
CANDIDATES = ("moving", "static")  # with and without time, of which model=auto trains one
PACKAGE = "pkg://"  # in front of the module whose files data.root names
EMBEDDED = f"{PACKAGE}gsbench.scenes.sample"  # the data that gsbench brings
HOW_TO = "effects.md#comparing-models-on-val"


def check_settings(config: Config) -> None:
    """Raise InputError if a setting of a run is invalid on every machine; of model=auto each candidate is checked."""
    check_values(config)
    check_compare(config)
    check_choices(config)
    if not is_auto(config):
        return
    of_screen = {name: with_candidate(config, name) for name in CANDIDATES}  # the time screen chooses one of these
    for name, candidate in (candidates(config) if config.effects.compare else of_screen).items():
        try:
            check_values(candidate)
        except InputError as error:
            raise InputError(f"model={AUTO}, candidate {name}: {error}") from None


def check_choices(config: Config) -> None:
    """Raise InputError if the settings have candidates that nothing reads."""
    model = config.model
    if not is_auto(config) and (model.candidates or model.compared):
        name = "candidates" if model.candidates else "compared"
        raise InputError(f"model.{name}: expected model=auto, which chooses, got model={model.name}: leave it out")
    for name in model.candidates:
        if name not in CANDIDATES:
            raise InputError(f"model.candidates.{name:.80}: {did_you_mean(name, CANDIDATES)}")


def check_compare(config: Config) -> None:
    """Raise InputError if the settings ask to compare models on val and cannot have this."""
    if not config.effects.compare:
        for name in ("most_seconds", "most_frame_ms"):
            if getattr(config.effects, name) is not None:
                raise InputError(
                    f"effects.{name}: expected effects.compare=true, whose candidates it limits", docs=HOW_TO
                )
        return
    if not is_auto(config):
        raise InputError(
            f"effects.compare=true: expected model=auto, whose candidates it compares, got "
            f"model={config.model.name}: leave effects.compare out, or use model=auto",
            docs=HOW_TO,
        )
    if config.scene.eval_split == "val":
        raise InputError(
            "effects.compare=true: expected results on test, got scene.eval_split=val: results on the "
            "views by which the model is chosen would be too high; name a model instead"
        )


def check_values(config: Config) -> None:
    """Raise InputError if a setting is invalid on every machine, for instance out of its range."""
    _check_keys(config)
    for dotted, value in flat(dataclasses.asdict(config)):
        facts(dotted).check(dotted, value)
    check_device_name(config.device)
    check_step("train.cooldown_from", config.train.cooldown_from, config)
    for hook in hook_types(elsewhere=()):  # others import torch
        hook.check(config)
    _check_coarse(config.train.coarse or [])
    for name, rate in config.model.lr.items():
        _check_rate(f"model.lr.{name}", rate)


def check_device_name(name: str) -> None:
    """Raise InputError unless `name` is that of a device: cpu, cuda, or one of several, such as cuda:1."""
    if not re.fullmatch(r"cpu|cuda(:\d{1,3})?", name):
        raise InputError(f"device '{name}' is not known. {did_you_mean(name, ['cpu', 'cuda', 'cuda:1'])}")


def _check_keys(value: Any, place: str = "") -> None:
    """Raise InputError if the settings have an unknown key, which Hydra's `+key=` adds without an error."""
    # The keys of a dict are free. The attributes of a dataclass must be its fields.
    fields = {field.name for field in dataclasses.fields(value)} if dataclasses.is_dataclass(value) else None
    members = value if isinstance(value, dict) else vars(value) if fields else {}
    for name, member in members.items():
        dotted = f"{place}.{name}".lstrip(".")
        if fields is not None and name not in fields:
            raise InputError(f"config key '{dotted}' is not known. {did_you_mean(name, fields)}")
        _check_keys(member, dotted)


def _check_rate(key: str, rate: LearningRate) -> None:
    """Raise InputError if a learning rate is negative, or if a log-linear decay starts or ends at zero, or nowhere."""
    if rate.until is not None and rate.end is None:
        raise InputError(f"{key}: expected an end with until={rate.until}, got end null: set {key}.end")
    if rate.start < 0 or (rate.end is not None and (rate.end <= 0 or rate.start == 0)):
        raise InputError(
            f"{key}: expected start >= 0, and start > 0 with end > 0 or null, got start {rate.start}, end {rate.end}"
        )


def _check_coarse(coarse: list[list[int]]) -> None:
    """Raise InputError unless `coarse` is a valid list of (downscaling factor, last step) pairs.

    An example is [[4, 3000], [2, 15000]]: factors decrease and steps increase.
    """
    are_pairs = all(len(pair) == 2 for pair in coarse)
    factors, steps = ([pair[i] for pair in coarse] if are_pairs else [] for i in (0, 1))
    fall = all(a > b for a, b in itertools.pairwise([*factors, 1]))  # the last factor is above 1
    rise = all(a < b for a, b in itertools.pairwise([0, *steps]))  # the first step is above 0
    if not are_pairs or not fall or not rise:
        raise InputError(
            f"train.coarse: expected pairs (factor above 1, step of the recipe until which images are so "
            f"much smaller), factors falling and steps rising, such as [[4,3000],[2,15000]], "
            f"got {coarse}"
        )


def is_auto(config: Config) -> bool:
    """Return whether the settings have model=auto, so that a test of the scene must still choose the model."""
    return config.model.name == AUTO


def with_candidate(config: Config, name: str) -> Config:
    """Return the settings of model=auto with its candidate "moving" or "static" as the model."""
    return _with_model(config, config.model.candidates.get(name), f"model.candidates.{name}")


def candidates(config: Config) -> dict[str, Config]:
    """Return the settings of each model to compare, by its label; the first is the one that model=auto trains alone.

    Raises:
        InputError: a candidate is no model config, or two of them have one label.
    """
    more = [_with_model(config, model, f"model.compared.{key}") for key, model in config.model.compared.items()]
    by_label: dict[str, Config] = {}
    for each in (with_candidate(config, "moving"), *more, with_candidate(config, "static")):
        candidate = replace(each, model=replace(each.model, agr=each.agr))  # agr=false: 7dgs is 7dgs_noagr
        label = label_of(candidate)
        if by_label.setdefault(label, candidate) != candidate:
            raise InputError(f"model.compared: expected models of different names, two are {label!r:.80}")
    return by_label


def _with_model(config: Config, model: Any, key: str) -> Config:
    """Return settings with another model, from the config key `key`, with AGR only if the model's settings have it.

    `model.gate`, the default of effects.gate, stays that of the run's model, such as auto.

    Raises:
        InputError: `model` is not a model config.
    """
    try:
        typed = OmegaConf.merge(OmegaConf.structured(ModelConfig), model or {})
        chosen: ModelConfig = OmegaConf.to_object(typed)  # type: ignore[assignment]
    except (OmegaConfBaseException, ValueError, TypeError) as error:
        raise InputError(f"{key}: {str(error).splitlines()[0]}") from None
    return replace(config, model=replace(chosen, gate=config.model.gate), agr=config.agr and chosen.agr)


def label_of(config: Config) -> str:
    """Return the model's name, with _agr or _noagr if its use of AGR (a network) differs from the published method."""
    as_published = config.agr == config.model.published_with_agr
    return config.model.name + ("" if as_published else "_agr" if config.agr else "_noagr")


def lpips_weights(config: Config) -> dict[str, Path]:
    """Return the weight files of LPIPS networks in the settings, by network ("alex", "vgg")."""
    files = {"alex": config.protocol.lpips_alex, "vgg": config.protocol.lpips_vgg}
    return {backbone: Path(os.path.expanduser(file)) for backbone, file in files.items() if file}


def data_root(root: str) -> Path:
    """Return the folder of a data set, given as a path or as `pkg://module` for data inside a Python package.

    Raises:
        InputError: the module does not exist, or the path is invalid.
    """
    if "\0" in root:
        raise InputError(f"data.root: expected a path, got {root!r:.200}")
    if not root.startswith(PACKAGE):
        return Path(os.path.expanduser(root))
    try:
        return Path(str(importlib.resources.files(root.removeprefix(PACKAGE))))
    except (ImportError, ValueError, TypeError) as error:
        raise InputError(f"data.root: expected pkg://MODULE of an installed package, got {root!r}: {error}") from None

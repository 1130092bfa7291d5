"""Expand a command line before Hydra reads it: scene=all becomes a sweep with one run for each scene.

A command that names a launcher is a sweep too: without `--multirun`, Hydra ignores launchers, and trains here.
"""

import itertools
import re
from collections.abc import Sequence

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsbench.config import CONF
from gsbench.errors import InputError, did_you_mean
from gsbench.run.grammar import check_override, quoted_value

MULTIRUN = ("-m", "--multirun")
SCENES_DEPEND_ON = ("exp", "data.scenes")  # the overrides on which the list of scenes depends
COMPLETE = ("exp", "scene", "experiment", "scene.name", "data.root")  # the overrides on which `check_complete` depends
OTHER_CONFIG = ("--config-name", "-cn", "--config-path", "-cp")
INFORM = ("-h", "--help", "--hydra-help", "--version", "-c", "--cfg", "-i", "--info", "-sc", "--shell-completion")

NO_NAME = re.compile(r"true|false|null|nan|[-+]?inf|[-+]?[\d.]+(e[-+]?\d+)?|[\[{].*|''|\"\"|")  # values for Hydra


def expand(words: Sequence[str]) -> list[str]:
    """Return the words of a command line with `--multirun` first, and with all scene names instead of scene=all.

    Nothing is changed in a command line that names one scene, asks for information or has an error; Hydra explains it.

    Raises:
        InputError: Hydra cannot read an override, the choice of a config group is a number, the experiment has no
            scenes, or scene=all is combined with several experiments.
    """
    multirun = any(word in MULTIRUN for word in words)
    words = [word for word in words if word not in MULTIRUN]
    for before, word in itertools.pairwise(["", *words]):
        if not any(one.startswith("-") for one in (before, word)):  # an option, or its value, such as a folder
            check_override(word)
            _check_group(*word.lstrip("+").partition("=")[::2])
    keys = {_key(word): word.partition("=")[2] for word in words if "=" in word}
    informs = any(word in INFORM for word in words)
    multirun = multirun or (keys.get("launch", "local") != "local" and not informs)
    wants_all = keys.get("scene", "all") == "all" and "exp" in keys
    if wants_all and not informs:
        if "," in keys["exp"]:
            raise InputError(f"scene=all: expected one experiment, got exp={keys['exp']}: name the scenes, scene=A,B")
        scenes = scenes_of([word for word in words if _key(word) in SCENES_DEPEND_ON])
        if scenes is not None:
            if not scenes:
                raise InputError("data.scenes: expected the names of scenes, got an empty list: set them, or "
                                 "scene=custom scene.name=FOLDER")  # fmt: skip
            chosen = ",".join(map(quoted_value, scenes))
            words = [*(word for word in words if not word.startswith("scene=")), f"scene={chosen}"]
            multirun = True
    return ["--multirun", *words] if multirun else words


def check_words(words: Sequence[str]) -> None:
    """Raise InputError if a command line names no experiment, scene or data, before a plan of its runs is written.

    Each run is checked again by `check_complete`, as here a sweep counts by its first values, and a user's own config
    not at all.
    """
    if any(word in INFORM or word.startswith(OTHER_CONFIG) for word in words):
        return
    composed = _composed([_first_of(word) for word in words if _key(word) in COMPLETE and word != "scene=all"])
    if composed is not None:
        check_complete(composed)


def check_complete(composed: DictConfig) -> None:
    """Raise InputError if a composed config names no experiment, no scene or no folder of data, with what to type."""
    if OmegaConf.is_missing(composed, "experiment"):
        known = ", ".join(sorted(path.stem for path in (CONF / "exp").glob("*.yaml")))
        raise InputError(f"expected an experiment: add +exp=NAME, for instance python -m gsbench +exp=mini. Valid: "
                         f"{known}. What each is: python -m gsbench --help")  # fmt: skip
    if OmegaConf.is_missing(composed.scene, "name"):
        raise InputError("scene=custom: expected the name of a scene: add scene.name=FOLDER, a folder in data.root")
    if OmegaConf.is_missing(composed.data, "root"):
        raise InputError(f"data.root is not set: add data.root=PATH, the folder that holds the scenes of "
                         f"{composed.data.dataset} ({', '.join(composed.data.scenes)}), each with "
                         f"transforms_{{train,val,test}}.json and the images they name. "
                         f"Published at: {composed.data.published}", docs="data.md#what-is-read")  # fmt: skip


def _key(word: str) -> str:
    return word.partition("=")[0].lstrip("+")


def _first_of(word: str) -> str:
    """Return an override with the first of the values that commas separate."""
    return word if re.search("=['\"[]", word) else word.partition(",")[0]


def _check_group(name: str, choices: str) -> None:
    """Raise InputError if the choice of a config group is not a name, for example a number.

    Hydra's own error message does not explain this mistake.
    """
    if not name or not (CONF / name).is_dir():
        return
    for choice in choices.split(","):
        if NO_NAME.fullmatch(choice.lower()):
            known = sorted(path.stem for path in (CONF / name).glob("*.yaml"))
            raise InputError(f"{name} '{choice}' is not known. {did_you_mean(choice, known)}")


def scenes_of(overrides: list[str]) -> list[str] | None:
    """Return the scenes of an experiment, and make each one a choice of the config group `scene`.

    The result is None if Hydra cannot compose the config.
    """
    composed = _composed(overrides)
    if composed is None:
        return None
    scenes: list[str] = list(composed.data.scenes)
    for scene in scenes:
        if not (CONF / "scene" / f"{scene}.yaml").exists():
            ConfigStore.instance().store(group="scene", name=scene, node={"name": scene})
    return scenes


def _composed(overrides: Sequence[str]) -> DictConfig | None:
    """Return the config of some overrides; None if Hydra cannot compose it."""
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            return compose("config", list(overrides))
    except (HydraException, OmegaConfBaseException):
        return None

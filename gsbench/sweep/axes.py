"""Expand a command line before Hydra reads it: scene=all becomes a sweep with one run for each scene.

A command that names a launcher is a sweep too: without `--multirun`, Hydra ignores launchers, and trains here.
"""

import itertools
import re
import warnings
from collections.abc import Sequence

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from gsbench.config import CONF
from gsbench.errors import InputError, did_you_mean
from gsbench.measure.renamed import present_override

MULTIRUN = ("-m", "--multirun")
SCENES_DEPEND_ON = ("exp", "data.scenes")  # the overrides on which the list of scenes depends
INFORM = ("-h", "--help", "--hydra-help", "--version", "-c", "--cfg", "-i", "--info", "-sc", "--shell-completion")

NO_NAME = re.compile(r"true|false|null|nan|[-+]?inf|[-+]?[\d.]+(e[-+]?\d+)?|[\[{'\"].*|")  # values for Hydra


def expand(words: Sequence[str]) -> list[str]:
    """Return the words of a command line with `--multirun` first, and with all scene names instead of scene=all.

    Config keys that were renamed are replaced by their present names. Nothing else is changed in a command line that
    names one scene, asks for information or has an error; Hydra explains the error.

    Raises:
        InputError: the choice of a config group is a number, the experiment has no scenes, or scene=all is combined
            with several experiments.
    """
    multirun = any(word in MULTIRUN for word in words)
    words = [_with_present_names(word) for word in words if word not in MULTIRUN]
    for before, word in itertools.pairwise(["", *words]):
        if not before.startswith("-"):  # else it is the value of an option, such as a folder
            _check_group(*word.lstrip("+").partition("=")[::2])
    keys = {word.partition("=")[0].lstrip("+"): word.partition("=")[2] for word in words if "=" in word}
    informs = any(word in INFORM for word in words)
    multirun = multirun or (keys.get("launch", "local") != "local" and not informs)
    wants_all = keys.get("scene", "all") == "all" and "exp" in keys and keys["exp"] != "stability"
    if wants_all and not informs:
        if "," in keys["exp"]:
            raise InputError(f"scene=all: expected one experiment, got exp={keys['exp']}: name the scenes, scene=A,B")
        scenes = scenes_of([word for word in words if word.partition("=")[0].lstrip("+") in SCENES_DEPEND_ON])
        if scenes is not None:
            if not scenes:
                raise InputError("data.scenes: expected the names of scenes, got an empty list: set them, or "
                                 "scene=custom scene.name=FOLDER")  # fmt: skip
            words = [*(word for word in words if not word.startswith("scene=")), f"scene={','.join(scenes)}"]
            multirun = True
    return ["--multirun", *words] if multirun else words


def _with_present_names(word: str) -> str:
    """Return a word of the command line with the present names of config keys; warn if a key was renamed."""
    present = present_override(word)
    if present != word:
        warnings.warn(f"{word}: a key of it was renamed, read as {present}", stacklevel=1)
    return present


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
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            scenes: list[str] = list(compose("config", overrides).data.scenes)
    except (HydraException, OmegaConfBaseException):
        return None
    for scene in scenes:
        if not (CONF / "scene" / f"{scene}.yaml").exists():
            ConfigStore.instance().store(group="scene", name=scene, node={"name": scene})
    return scenes

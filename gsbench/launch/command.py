"""Expand a command line to the overrides of each run, and compose the config of each by Hydra.

`scene=all` becomes a run for each scene of the experiment. A wrong word is explained in one line.
"""

import argparse
import copy
import dataclasses
import itertools
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from hydra import compose, initialize_config_dir
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.errors import MissingConfigException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf, open_dict, read_write
from omegaconf.errors import OmegaConfBaseException

from gsbench.config import CONF, PATHS, Config, register_schema
from gsbench.config_roles import ADDED, config_hash, facts, in_order, key_of, names_variant, training_hash
from gsbench.errors import InputError, deleted_key, did_you_mean
from gsbench.run.grammar import check_override, quoted_value, typed
from gsbench.run.settings import EMBEDDED, check_settings, data_root

NO_NAME = re.compile(r"true|false|null|nan|[-+]?inf|[-+]?[\d.]+(e[-+]?\d+)?|[\[{].*|''|\"\"|")  # values for Hydra
QUESTIONS = ("--hydra-help", "--cfg", "--info", "-i", "--shell-completion", "-sc")  # options that Hydra answers


@dataclass(frozen=True)
class Command:
    """The words of a command line by their kind."""

    overrides: list[str]
    multirun: bool  # -m
    config_dir: Path | None  # the folder of the user's own configs
    asks: bool  # whether it has one of QUESTIONS


@dataclass(frozen=True)
class RunConfig:
    """The composed config of one run."""

    overrides: list[str]
    config: DictConfig  # without Hydra's own
    choices: Mapping[str, str]  # the choice of each config group


class UserConfigs(SearchPathPlugin):
    """Tell Hydra to look for configs in the folder of --config-dir too."""

    folder: ClassVar[Path | None] = None

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Add the folder after gsbench's own."""
        if self.folder is not None:
            search_path.append("command-line", f"file://{self.folder}")


def parse(words: Sequence[str]) -> Command:
    """Separate the overrides of a command line from its options.

    Raises:
        InputError: an option is not known, or is one of Hydra that starts a run in another way.
    """
    parser = argparse.ArgumentParser("python -m gsbench", add_help=False, allow_abbrev=False)
    parser.add_argument("-m", "--multirun", action="store_true")
    parser.add_argument("-cd", "--config-dir", type=Path)
    whole = ["--cfg" if word == "-c" else word for word in words]  # argparse takes -c for the beginning of -cd
    options, others = parser.parse_known_args(whole)
    unknown = [word for word in others if word.startswith("-")]
    asks = any(word in QUESTIONS for word in unknown)
    if unknown and not asks:
        raise InputError(
            f"{unknown[0]}: expected -m, --config-dir=FOLDER or a question, as in python -m gsbench +exp=mini --cfg job"
        )
    return Command(others, options.multirun, options.config_dir, asks)


@contextmanager
def hydra_with(config_dir: Path | None) -> Iterator[None]:
    """Let Hydra compose gsbench's configs, and those of the user, while the block runs.

    Raises:
        InputError: the folder of the user's configs does not exist, or has a file in whose place gsbench's is read.
    """
    if config_dir is not None and not config_dir.is_dir():
        raise InputError(f"--config-dir: expected a folder of YAML files, got '{config_dir}', which is none")
    for shipped in CONF.rglob("*.yaml") if config_dir else ():
        file = Path(config_dir or "", shipped.relative_to(CONF))
        if file.is_file() and file.read_bytes() != shipped.read_bytes():
            raise InputError(f"--config-dir: {file}: expected another name than that of a file of gsbench's: rename it")
    register_schema()
    Plugins.instance().register(UserConfigs)
    UserConfigs.folder = config_dir.absolute() if config_dir else None
    with initialize_config_dir(str(CONF), job_name="gsbench", version_base="1.3"):
        yield


def runs_of(command: Command) -> tuple[list[list[str]], bool]:
    """Return the overrides of each run of a command, and whether it is a sweep; use it in `hydra_with`.

    A command is a sweep if it has -m, a launcher, scene=all or an experiment with axes of its own. Later axes vary
    faster; the scenes of scene=all vary fastest.

    Raises:
        InputError: an override is wrong, the experiment has no scenes, or the command names several experiments.
    """
    for word in command.overrides:
        check_override(word)
        name, _, choices = word.lstrip("+").partition("=")
        _check_group(name, choices)
        if re.split(r"[./]", name.lstrip("~"))[0] == "hydra":
            raise InputError(f"{name}: expected a key of gsbench's, which reads none of Hydra's own: leave it out")
    parser = OverridesParser.create(GlobalHydra.instance().config_loader())
    pairs = list(map(_values, parser.parse_overrides(command.overrides)))
    values = dict(pairs)
    keys = {name.lstrip("+"): words for name, words in values.items()}
    if len(keys.get("exp", ())) > 1:
        raise InputError(f"+exp: expected one experiment, got {len(keys['exp'])}: type a command for each")
    _check_once([name for name, _ in pairs])
    if "protocol.name" in keys:
        raise InputError("protocol.name: expected protocol=NAME, which sets what is measured too, not its name alone")
    scenes = keys.get("scene", ["scene=all"])  # all is the default
    all_scenes = "scene=all" in scenes and "exp" in keys
    if all_scenes and len(scenes) > 1:
        raise InputError("scene: expected all or names of scenes, got both: leave all or the names out")
    base = _compose([words[0] for name, words in values.items() if name != "scene"])
    _check_launcher(list(keys), base.launch)
    axes = [f"{name}={text}" for name, text in (base.hydra.sweeper.params or {}).items()]
    words_by_key = dict(map(_values, parser.parse_overrides(axes))) | values
    _check_models(words_by_key)
    if not (command.multirun or all_scenes or axes or base.launch.by != "local"):
        _check_single(values)
        return [[word for (word,) in values.values()]], False  # of a key that comes twice, the last word
    if all_scenes:
        if not base.data.scenes:
            raise InputError(
                "data.scenes: expected the names of scenes, got an empty list: set them, or "
                "scene=custom scene.name=FOLDER"
            )
        words_by_key.pop("scene", None)  # to be the last
        words_by_key["scene"] = [f"scene={quoted_value(scene)}" for scene in base.data.scenes]
    return [list(run) for run in itertools.product(*words_by_key.values())], True


def _check_models(words_by_key: Mapping[str, Sequence[str]]) -> None:
    """Raise InputError if a model is named beside an added config that chooses one, such as +ablation=time_only."""
    models = {word.partition("=")[2] for word in words_by_key.get("model", ())}
    added = [word for name in ADDED[1:] for word in words_by_key.get(f"+{name}", ())]
    if not models or not added:
        return
    experiment = words_by_key.get("+exp", ())
    default = _compose(experiment).hydra.runtime.choices.model
    for word in added:
        chosen = _compose([*experiment, word]).hydra.runtime.choices.model
        if chosen != default and models != {chosen}:
            raise InputError(
                f"{word}: expected no other model beside it than {chosen}, which it chooses: leave one out"
            )


def _check_once(names: Sequence[str]) -> None:
    """Raise InputError if a config is added twice, of which a sweep would drop one; a launcher may replace another."""
    for name, count in Counter(names).items():
        if count > 1 and name.startswith("+") and facts(name.lstrip("+")).role != "launching":
            raise InputError(f"{name}: expected it once, got it {count} times: leave out the others")


def _check_launcher(keys: Sequence[str], launch: DictConfig) -> None:
    """Raise InputError if a key belongs to a launcher that was not chosen, and so would do nothing."""
    for name in keys:
        readers = ["parallel", "slurm"] if name == "launch.at_once" else ["slurm"]
        is_default = name == "launch.at_once" and launch.at_once == 1  # as without a launcher
        if name.startswith("launch.") and name != "launch.by" and launch.by not in readers and not is_default:
            choices = " or ".join(f"+launch={reader}" for reader in readers)
            raise InputError(f"{name}: expected {choices}, which reads it: add it, or leave {name} out")


def compose_run(overrides: Sequence[str]) -> RunConfig:
    """Compose the config of a run; use it in `hydra_with`.

    Raises:
        InputError: an override is wrong, or the run has no experiment, scene or folder of data.
    """
    _register_scene(overrides)
    config = _compose(overrides)
    choices: Any = OmegaConf.to_container(config.hydra.runtime.choices)
    with read_write(config), open_dict(config):
        del config["hydra"]
        if not (OmegaConf.is_interpolation(config, "results") or OmegaConf.is_missing(config, "results")):
            config.results = os.path.expanduser(config.results)
    check_complete(config)
    try:
        check_settings(OmegaConf.to_object(_with_paths(config)))  # type: ignore[arg-type]
    except OmegaConfBaseException as error:
        raise InputError(explain(error)) from None
    return RunConfig(list(overrides), config, choices)


def check_runs(runs: Sequence[RunConfig]) -> None:
    """Raise InputError if an override does nothing in any of the runs, if two are one run, or if there are no data."""
    for key in sorted({key_of(word) for run in runs for word in run.overrides}):
        needed = facts(key).needs
        if needed and all(OmegaConf.select(run.config, needed) in (None, facts(needed).absent) for run in runs):
            raise InputError(f"{key}: expected {needed} too, without which it does nothing: set it, or leave {key} out")
    _check_distinct(runs)
    for run in runs:
        data = run.config.data
        # A folder of a Slurm job may exist on its nodes only; to look for the embedded data would import torch.
        if run.config.launch.by != "slurm" and data.root != EMBEDDED and not data_root(data.root).is_dir():
            raise _no_data(data, f"data.root={data.root}: there is no such folder: set")


def _check_distinct(runs: Sequence[RunConfig]) -> None:
    """Raise InputError if two runs of a sweep are one run, in one folder, although their command lines differ.

    This happens if an override such as scene.name=X takes away what a sweep varies, or if a sweep varies a key that has
    no place in a run's folder, such as data.root.
    """
    before: dict[str, RunConfig] = {}
    for run in runs:
        config = _with_paths(run.config)
        plain: Any = OmegaConf.to_container(config, resolve=True)
        groups = {group: choice for group, choice in run.choices.items() if names_variant(group)}
        # The hash of an initial PLY is of its content, which is read when the run begins.
        where = [OmegaConf.select(config, key) for key in ("results", "experiment", "init.ply")]
        key = config_hash({"": [*where, training_hash(plain), groups]})
        other = before.setdefault(key, run)
        if other is run:
            continue
        words = [" ".join(each.overrides) for each in (other, run)]
        is_named = any("scene.name=" in word for word in run.overrides)
        instead = "add scene=custom, or leave scene.name out" if is_named else "leave one of them out"
        raise InputError(
            f"expected runs of different trainings, these two would be one run in one folder: '{words[0]}' and "
            f"'{words[1]}': {instead}"
        )


def _with_paths(config: DictConfig) -> DictConfig:
    """Return a config with texts for paths that only the node of a Slurm job can resolve, as they name its TMPDIR."""
    config = copy.deepcopy(config)
    for key in PATHS if config.launch.by == "slurm" else ():
        try:
            OmegaConf.select(config, key)
        except OmegaConfBaseException:
            OmegaConf.update(config, key, "known on the node")
    return config


def check_complete(config: DictConfig) -> None:
    """Raise InputError if a composed config names no experiment, no scene or no folder of data, with what to type."""
    if OmegaConf.is_missing(config, "experiment"):
        experiments = ", ".join(sorted(path.stem for path in (CONF / "exp").glob("*.yaml")))
        raise InputError(
            f"expected an experiment: add +exp=NAME, for instance python -m gsbench +exp=mini. Valid: "
            f"{experiments}. What each is: python -m gsbench --help. One of your own needs a line experiment: NAME"
        )
    if OmegaConf.is_missing(config.scene, "name"):
        raise InputError("scene=custom: expected the name of a scene: add scene.name=FOLDER, a folder in data.root")
    if OmegaConf.is_missing(config.data, "root"):
        raise _no_data(config.data, "data.root is not set: add")


def _no_data(data: DictConfig, wrong: str) -> InputError:
    """Return the error that `data.root` names no folder of data; `wrong` is the beginning of its message."""
    scenes = f" ({', '.join(data.scenes)})" if data.scenes else ""
    published = f". Published at: {data.published}" if data.published else ""
    return InputError(
        f"{wrong} data.root=PATH, the folder that holds the scenes of {data.dataset}{scenes}, each with "
        f"transforms_{{train,val,test}}.json and the images they name{published}",
        docs="data.md#what-is-read",
    )


def explain(error: Exception) -> str:
    """Explain an error of Hydra or OmegaConf in one line, with the wrong key and the most similar one."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file and error.options:
        group, _, name = error.missing_cfg_file.rpartition("/")
        return f"{group} '{name}' is not known. {did_you_mean(name, error.options)}"
    if isinstance(error, UnicodeDecodeError):
        return f"--config-dir: expected YAML files in UTF-8, one is not: {error}: save it as UTF-8"
    file = re.match("In '(.+)': ", str(error))  # the error is in this config, and its context is OmegaConf's
    where, raised = (f"{file[1]}.yaml: ", error.__context__) if file else ("", error.__cause__)
    cause = raised if isinstance(raised, OmegaConfBaseException) else error
    if isinstance(cause, OmegaConfBaseException) and cause.key is not None and cause.parent_node is not None:
        keys = [str(key) for key in cause.parent_node] if isinstance(cause.parent_node, DictConfig) else []
        if file and file[1].split("/")[-2:-1] == [cause.key]:
            return f"{where}expected `# @package _global_` as its first line, as it has keys of several groups: add it"
        if keys and cause.key not in keys:
            return f"{where}config key '{cause.full_key}' is not known. {did_you_mean(str(cause.key), keys)}"
        return f"{where}config key '{cause.full_key}': {_explain_value(cause, str(cause).splitlines()[0])}"
    if "is not a subclass of LearningRate" in str(cause):
        return (
            f"{error}: expected the name of a rate of the model, or a new rate as '+model.lr={{NAME: {{start: 1e-3}}}}'"
        )
    return " ".join(str(error).split()) + (f": {str(cause).splitlines()[0]}" if cause is not error and not file else "")


def _explain_value(error: OmegaConfBaseException, message: str) -> str:
    """Explain what is wrong with the value of a key that is known, by the first line of OmegaConf's message."""
    if "is not a subclass of" in message:
        return f"expected values of its keys, {', '.join(error.parent_node[error.key])}, got a value of the group"
    if message.startswith("Cannot convert 'dict'"):
        return "expected a value, it has no keys"
    if "missing mandatory value" in message:
        return "expected a value, got none: set it"
    if message.endswith("is not in struct"):
        return f"expected + before a key that you add: type +{error.full_key}"
    return message


def _compose(overrides: Sequence[str]) -> DictConfig:
    try:
        config = compose("config", in_order(overrides), return_hydra_config=True)
    except Exception as error:  # Hydra and OmegaConf raise errors of many types for a wrong word
        raise InputError(explain(error)) from None
    for field in dataclasses.fields(Config):
        if field.name not in config.keys():  # noqa: SIM118  a key that has no value yet is there
            raise deleted_key(field.name)
    return config


def _values(override: Any) -> tuple[str, list[str]]:
    """Return the key of a parsed override with its sign, and the override with each value of its sweep."""
    name = override.get_key_element()
    if not override.is_sweep_override():
        return name, [override.input_line]
    if not override.is_discrete_sweep():
        raise InputError(f"{override.input_line}: expected values, such as {name}=1,2,3, got an interval")
    return name, [f"{name}={value}" for value in override.sweep_string_iterator()]


def _check_single(values: Mapping[str, Sequence[str]]) -> None:
    for name, words in values.items():
        if len(words) > 1:
            text = ",".join(word.partition("=")[2] for word in words)
            raise InputError(
                f"{name}={text}: commas separate the values of a sweep: type -m too for a run of each, or "
                f"{typed(name, text, several=False)} for one value"
            )


def _check_group(name: str, choices: str) -> None:
    """Raise InputError if the choice of a config group is not a name, such as a number; Hydra does not explain it."""
    if not name or not (CONF / name).is_dir():
        return
    for choice in choices.split(","):
        if NO_NAME.fullmatch(choice.lower()):
            valid = sorted(path.stem for path in (CONF / name).glob("*.yaml"))
            raise InputError(f"{name} '{choice}' is not known. {did_you_mean(choice, valid)}")


def _register_scene(overrides: Sequence[str]) -> None:
    """Let Hydra accept a scene of `data.scenes`: it takes only choices that have a file or a stored node."""
    scenes = [word.partition("=")[2].strip("'\"") for word in overrides if word.startswith("scene=")]
    scene = scenes[-1] if scenes else "all"  # as Hydra chooses: the last one, or the default, conf/scene/all.yaml
    folders = [CONF, *([UserConfigs.folder] if UserConfigs.folder else [])]
    if any((folder / "scene" / f"{scene}.yaml").exists() for folder in folders):
        return
    if scene in _compose([word for word in overrides if not word.startswith("scene=")]).data.scenes:
        ConfigStore.instance().store(group="scene", name=scene, node={"name": scene})

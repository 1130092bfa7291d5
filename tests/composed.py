"""Keep what Hydra composes from the same files and choices: tests ask for the same again, for 0.1 s each time.

What is kept is found by everything it is made of: the choices of groups, the files, the stored schema. Overrides of
single keys are applied by Hydra every time, to a copy.
"""

import os
import pickle
from pathlib import Path
from typing import Any

from hydra._internal import config_loader_impl
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.defaults_list import DefaultsList, Overrides, create_defaults_list
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig

_kept: dict[object, bytes] = {}
_compose = ConfigLoaderImpl._compose_config_from_defaults_list


def keep() -> None:
    """Let Hydra keep what it composes in this process, and in forks of it."""
    config_loader_impl.create_defaults_list = _kept_defaults_list
    ConfigLoaderImpl._compose_config_from_defaults_list = _kept_config


def _sources(repo: Any) -> object:
    """Everything from which configs are read, with the time and the size of each file."""
    files = []
    for source in repo.get_sources():
        folder = source.path.removeprefix("file://")
        for where, folders, names in os.walk(folder) if source.scheme() == "file" else ():
            folders.sort()
            files += [(where, name, (status := os.stat(Path(where, name))).st_mtime_ns, status.st_size)
                      for name in sorted(names)]  # fmt: skip
    return (*((source.scheme(), source.path) for source in repo.get_sources()), *files,
            pickle.dumps(ConfigStore.instance().repo))  # fmt: skip


def _kept_defaults_list(
    repo: Any, config_name: str | None, overrides_list: list[Any], prepend_hydra: bool, skip_missing: bool
) -> DefaultsList:
    chosen = Overrides(repo, overrides_list)
    choices = (chosen.override_choices, chosen.append_group_defaults, chosen.deletions)
    key = (config_name, repr(choices), prepend_hydra, skip_missing, _sources(repo))
    if key not in _kept:
        whole = create_defaults_list(repo, config_name, overrides_list, prepend_hydra, skip_missing)
        _kept[key] = pickle.dumps((whole.defaults, whole.overrides.known_choices))
    defaults, chosen.known_choices = pickle.loads(_kept[key])
    return DefaultsList(defaults, None, chosen.config_overrides, chosen)  # the tree is only drawn, by --info


def _kept_config(self: ConfigLoaderImpl, defaults: list[Any], repo: Any) -> DictConfig:
    key = (repr(defaults), _sources(repo))
    if key not in _kept:
        _kept[key] = pickle.dumps(_compose(self, defaults, repo))
    config: DictConfig = pickle.loads(_kept[key])
    return config

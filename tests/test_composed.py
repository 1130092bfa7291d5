"""What tests keep of Hydra's compositions is what Hydra composes."""

import os
from pathlib import Path

import composed
import hydra
import pytest
from hydra._internal import config_loader_impl
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.defaults_list import create_defaults_list
from omegaconf import DictConfig, OmegaConf

from gsbench.config import CONF, register_schema

WORDS = ("+exp=mini", "scene=suzanne", "model=7dgs", "seed=3", "model.options.scheme=schur")


def composition(folder: Path, *words: str) -> DictConfig:
    with hydra.initialize_config_dir(str(folder), version_base="1.3"):
        return hydra.compose("config", list(words), return_hydra_config=True)


def test_what_is_kept_is_what_hydra_composes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a config of other words, one that a test has changed, and types or interpolations that are lost."""
    register_schema()
    kept = [composition(CONF, *WORDS) for _ in range(2)]
    kept[0].train.iterations = 7
    kept.append(composition(CONF, *WORDS[:-1]))
    monkeypatch.setattr(config_loader_impl, "create_defaults_list", create_defaults_list)
    monkeypatch.setattr(ConfigLoaderImpl, "_compose_config_from_defaults_list", composed._compose)
    for composed_now, words in ((kept[1], WORDS), (kept[2], WORDS[:-1])):
        expected = composition(CONF, *words)
        assert OmegaConf.to_yaml(composed_now) == OmegaConf.to_yaml(expected)
        assert OmegaConf.get_type(composed_now, "train") is OmegaConf.get_type(expected, "train")
        assert OmegaConf.is_struct(composed_now) == OmegaConf.is_struct(expected)


def test_a_file_that_changed_is_read_again(tmp_path: Path) -> None:
    """Catches a test that changes a YAML and is given the config of before."""
    (tmp_path / "config.yaml").write_text("steps: 1\n")
    assert composition(tmp_path).steps == 1
    (tmp_path / "config.yaml").write_text("steps: 2\n")
    os.utime(tmp_path / "config.yaml", ns=(1, 1))
    assert composition(tmp_path).steps == 2

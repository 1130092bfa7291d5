"""Keys of the config that were renamed, in all that older versions wrote: command lines, records, hashes, YAMLs."""

import copy
import json
from pathlib import Path
from typing import Any

import hydra
import pytest
from hydra.errors import HydraException
from omegaconf import OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from gsbench.config import CONF, LearningRate, register_schema
from gsbench.measure import record
from gsbench.measure.renamed import RENAMED, present_override, with_present_keys
from gsbench.measure.settings import training_differences, training_hash
from gsbench.run.identity import identify
from gsbench.run.overrides import deciding
from gsbench.sweep.axes import expand
from gsbench.sweep.explain import explain

PUBLISHED = Path(__file__).resolve().parents[2] / "results" / "published"
OLD: dict[str, Any] = {
    "data": {"modulation": 0.5, "root": "here"},
    "train": {"modulation_from": 15000, "densify": {"every": 100}},
    "model": {
        "lr": {"modulation": {"start": 1e-3}, "means": {"start": 1e-4}},
        "options": {"modulation": "no key that was renamed"},
        "candidates": {"moving": {"lr": {"modulation": {"start": 1e-3}}}},
    },
}


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("train.modulation_from=100", "train.lambda_from=100"),
        ("train.modulation_from=100,200", "train.lambda_from=100,200"),
        ("++data.modulation=0.1", "++data.initial_lambda=0.1"),
        ("~model.lr.modulation", "~model.lr.lambda"),
        ("model.lr.modulation.start=0", "model.lr.lambda.start=0"),
        ("+model.candidates.moving.lr.modulation.start=0", "+model.candidates.moving.lr.lambda.start=0"),
        ("model.options.lambda_t=${data.modulation}", "model.options.lambda_t=${data.initial_lambda}"),
        ("scene=modulation", "scene=modulation"),
        ("model.options.modulation=1", "model.options.modulation=1"),
        ("--cfg", "--cfg"),
        ("", ""),
    ],
)
def test_overrides(old: str, new: str) -> None:
    """Catches an old key of a command line, of a plan or of a record that is no longer the new one, or another word."""
    assert present_override(old) == new
    assert deciding([old]) == deciding([new])


def test_a_command_line_of_before_is_read_with_a_line_that_says_so() -> None:
    """Catches an old key that is refused, or accepted in silence."""
    with pytest.warns(UserWarning, match=r"^train\.modulation_from=9: .* read as train\.lambda_from=9$"):
        assert expand(["+exp=mini", "scene=suzanne", "train.modulation_from=9"])[-1] == "train.lambda_from=9"


def test_nested_keys() -> None:
    """Catches a group that is passed by, a value that is lost, and a key of the same name elsewhere that is changed."""
    before, new = copy.deepcopy(OLD), with_present_keys(OLD)
    assert before == OLD
    assert new["data"] == {"initial_lambda": 0.5, "root": "here"}
    assert new["train"] == {"lambda_from": 15000, "densify": {"every": 100}}
    assert new["model"]["lr"] == {"lambda": {"start": 1e-3}, "means": {"start": 1e-4}}
    assert new["model"]["candidates"]["moving"]["lr"] == {"lambda": {"start": 1e-3}}
    assert new["model"]["options"] == OLD["model"]["options"]
    assert with_present_keys(new) == new


def test_a_new_name_is_no_other_training() -> None:
    """Catches finished runs and checkpoints of before that would be trained again."""
    assert training_hash(OLD) == training_hash(with_present_keys(OLD))
    other = with_present_keys(OLD)
    other["train"]["lambda_from"] = 7
    assert training_hash(other) != training_hash(OLD)
    assert training_differences(with_present_keys(OLD), other) == ["train.lambda_from 7 instead of 15000"]


def test_a_published_record_has_the_present_keys() -> None:
    """Catches an old record that differs from the same run of now in nothing but names."""
    path = PUBLISHED / "tuning.recipe/suzanne/7dgs/seed0/record.json"
    written, found = json.loads(path.read_text())["provenance"]["config"], record.read(path).provenance.config
    assert "modulation" in written["data"]
    assert found == with_present_keys(written) != written
    assert found["model"]["lr"]["lambda"]["start"] == 1e-3


def test_the_yaml_of_a_model_from_elsewhere() -> None:
    """Catches a model outside of gsbench whose learning rate of lambda has the old name and no longer counts."""
    register_schema()
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        words = ["+exp=mini", "scene=suzanne", "model=7dgs"]
        new = hydra.compose("config", words)
        old = hydra.compose("config", words)
        with open_dict(old.model.lr):
            old.model.lr["modulation"] = LearningRate(start=0.25)
        with pytest.warns(UserWarning, match="read as model.lr.lambda"):
            run = identify(old)
        assert "modulation" not in run.config.model.lr
        assert run.config.model.lr["lambda"].start == run.plain["model"]["lr"]["lambda"]["start"] == 0.25
        assert run.config.model.lr.keys() == identify(new).config.model.lr.keys()
        with pytest.raises(HydraException) as caught:  # a key of the schema cannot be read by its old name from a YAML
            hydra.compose("config", [*words, "data.modulation=1"])
    assert isinstance(caught.value.__cause__, OmegaConfBaseException)
    assert explain(caught.value) == "config key 'data.modulation' was renamed: write data.initial_lambda"


def test_every_new_name_is_in_the_schema() -> None:
    """Catches a new name with a typo, which would turn each old key into an unknown one."""
    register_schema()
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        config = hydra.compose("config", ["+exp=mini", "scene=suzanne", "model=7dgs"])
    for (group, old), new in RENAMED.items():
        assert new in OmegaConf.select(config, group)
        assert old not in OmegaConf.select(config, group)

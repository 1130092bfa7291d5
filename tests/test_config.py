"""The facts of config keys: refusals, hashes and comparisons that follow from them, and the files of conf/."""

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pytest
import yaml
from forked import python
from tiny_run import ROOT
from tiny_training import compose

from gsbench.config import CONF, Config
from gsbench.config_key import Key, declared, described, extended, joins, key
from gsbench.config_roles import facts, flat, measuring_differences, training_differences, training_hash
from gsbench.errors import InputError
from gsbench.measure.record import MAX_POINTS
from gsbench.run.settings import check_settings
from gsbench.run.setup import BACKGROUNDS, LEAST_GAUSSIANS
from gsbench.scenes import RESIZES
from gsbench.train.density.control import RULES

KEYS = declared(Config)
OF_HYDRA = ("defaults", "hydra")  # keys of YAML files that are not keys of a config
OPEN = ("model.options.", "model.candidates.", "model.compared.", "launch.sbatch.")  # groups that may have any key
GROUPS = {name.partition(".")[0] for name in KEYS}


@pytest.fixture(scope="module")
def config() -> Config:
    return compose("7dgs", 10)


def wrong(facts: Key) -> Iterator[Any]:
    """Values that a key refuses."""
    if facts.choices:
        yield "nothing"
    if facts.low > -math.inf:
        yield from (facts.low - 1, 2 * facts.high + 1, math.nan)


@pytest.mark.parametrize("dotted", [name for name in KEYS if [*wrong(KEYS[name])] and "NAME" not in name])
def test_values_out_of_a_range_or_no_choice_are_refused(dotted, config):
    """Catches a key that is not looked at: its run would fail in the middle, or train as if nothing were said."""
    for value in wrong(KEYS[dotted]):
        broken = copy.deepcopy(config)
        *groups, name = dotted.split(".")
        part: Any = broken
        for group in groups:
            part = getattr(part, group)
        setattr(part, name, value)
        with pytest.raises(InputError, match=rf"^{dotted}( 'nothing' is not known|: expected)"):
            check_settings(broken)
    check_settings(config)


def test_facts_are_those_of_the_code():
    """Catches a choice that the code does not have, and one that is refused though it has it."""
    choices = {"data.background": BACKGROUNDS, "scene.resize": RESIZES, "train.densify.kind": RULES}
    for name, known in choices.items():
        assert set(KEYS[name].choices) == set(known), name
    assert KEYS["train.curve_points"].high == MAX_POINTS
    assert KEYS["train.densify.max_gaussians"].low == KEYS["data.initial_points"].low == LEAST_GAUSSIANS


PLAIN: dict[str, Any] = {
    "experiment": "a",
    "train": {"iterations": 9, "checkpoint_minutes": 2, "noise": None},
    "model": {"lr": {"means": {"start": 1}}, "compared": {"a": 1}},
    "protocol": {"renders": 30, "best_on_test": False},
    "effects": {"gate": "off", "budget_db": 0.05},
    "launch": {"cpus": 4},
}


def changed(dotted: str, value: Any) -> dict[str, Any]:
    """PLAIN with another value."""
    plain = copy.deepcopy(PLAIN)
    *groups, name = dotted.split(".")
    part = plain
    for group in groups:
        part = part[group]
    part[name] = value
    return plain


@pytest.mark.parametrize(
    ("dotted", "value", "trains", "measures"),
    [
        ("train.iterations", 8, True, False),
        ("train.a_key_of_a_later_version", 8, True, False),
        ("model.lr.means.start", 2, True, False),
        ("protocol.best_on_test", True, True, False),
        ("protocol.renders", 60, False, True),
        ("experiment", "b", False, True),
        ("train.checkpoint_minutes", 3, False, False),
        ("launch.cpus", 8, False, False),
        ("effects.gate", "end", True, False),
        ("effects.budget_db", 1, False, False),  # the gate is off
        ("model.compared.a", 2, False, False),  # nothing is compared
        ("effects.compare", False, False, False),  # as before there was the key
        ("train.patience", None, False, False),
    ],
)
def test_what_depends_on_a_key(dotted, value, trains, measures):
    """Catches a finished run that is trained again for nothing, and one that is kept though its numbers are others."""
    other = changed(dotted, value)
    assert (training_hash(other) != training_hash(PLAIN)) == trains == bool(training_differences(PLAIN, other))
    assert bool(measuring_differences(PLAIN, other)) == measures


def test_where_a_run_lies_and_how_it_is_launched_changes_nothing():
    """Catches a run that is trained again because its data, its results or its name in tables have moved."""
    by_role: dict[str, set[str]] = {}
    for name, of_key in KEYS.items():
        by_role.setdefault(of_key.role, set()).add(name)
    assert by_role["place"] == {
        *("model.gate", "scene.released_as", "data.root", "data.published", "data.scenes", "init.ply"),
        *("train.checkpoint_minutes", "protocol.lpips_alex", "protocol.lpips_vgg"),
    }
    assert by_role["launching"] == {"results", "resume", "log", *(name for name in KEYS if name.startswith("launch."))}
    assert by_role["measuring"] - {name for name in KEYS if name.startswith("protocol.")} == {
        *("experiment", "data.dataset", "data.paper_dataset")
    }


def test_differences_are_named():
    """Catches a difference with the two values exchanged."""
    assert training_differences(PLAIN, changed("train.iterations", 8)) == ["train.iterations 8 instead of 9"]
    assert measuring_differences(changed("experiment", None), PLAIN) == ["experiment a instead of not set"]


def test_files_of_conf_have_known_keys_and_allowed_values():
    """Catches a key of a YAML that is refused only when someone chooses it."""
    for path in CONF.rglob("*.yaml"):
        text, group = path.read_text(), path.relative_to(CONF).parts[0]
        content = {name: value for name, value in (yaml.safe_load(text) or {}).items() if name not in OF_HYDRA}
        is_of_group = group in GROUPS and "@package _global_" not in text
        for dotted, value in flat({group: content} if is_of_group else content):
            assert facts(dotted).kind is not None or dotted.startswith(OPEN), f"{path}: {dotted}"
            if not (isinstance(value, str) and "${" in value):
                facts(dotted).check(f"{path}: {dotted}", value)


def test_a_dataclass_of_another_module_joins_a_group():
    """Catches a hook whose keys are not in the schema, or in front of those that names of runs begin with."""

    @joins("test")
    @dataclass
    class Hook:
        flat_for: int | None = key(None, "most measurements without a better loss", low=1)

    @extended("test")
    @dataclass
    class Group:
        steps: int = key(1, "of a run")

    assert [*declared(Group)] == ["steps", "flat_for"]
    assert isinstance(Group(), Hook)
    assert described(Group, "flat_for").low == 1
    assert Group.__module__ == __name__


def test_the_schema_needs_no_library():
    """Catches a hook that imports torch, which takes seconds, or gsbench.config, which then lacks its keys."""
    program = (
        "import sys, {}; from gsbench import config, config_key; print(*config_key.declared(config.Config));"
        "assert not {{'torch', 'hydra', 'omegaconf'}} & sys.modules.keys()"
    )
    hooks = [f"gsbench.train.hooks.{path.stem}" for path in (ROOT / "gsbench/train/hooks").glob("[!_]*.py")]
    for first in ("gsbench.config", *hooks):
        ran = python("-c", program.format(first))
        assert ran.stdout.split() == [*KEYS], f"{first}: {ran.stderr}"
        assert ran.returncode == 0, f"{first}: {ran.stderr}"

"""The recipes in conf/: rates that mean the same for a run of any length, and the published ones as published."""

import functools

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from gsbench.config import CONF, Config, register_schema
from gsbench.errors import InputError
from gsbench.run.setup import build, scene_folder
from gsbench.scenes.points import random_points
from gsbench.schedule import Schedule
from gsbench.train.optim import Optimizer, rate_at


@functools.cache  # of trials, most compare with one recipe
def composed(*overrides: str) -> Config:
    register_schema()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        names = [*([] if "+exp=tuning" in overrides else ["+exp=mini"]), "scene=suzanne", *overrides]
        config: Config = OmegaConf.to_object(compose("config", names))  # type: ignore[assignment]
    return config


def rates(config: Config, progress: float) -> dict[str, float]:
    """By parameter, after a part of the run, in a scene of extent 5."""
    model, random = build(config), torch.Generator().manual_seed(0)
    model.initialise(random_points(10, 1.0, random), 5.0, random)
    optimizer = Optimizer(model, config.model, config.train, 5.0)
    step = round(progress * config.train.iterations)
    return {name: rate_at(rate, step, config.train, 5.0) for name, rate in optimizer.rates.items()}


PAPER = {"times": 2.5e-2, "directions": 2.5e-2, "log_diagonal": 5e-2, "shape": 1e-2, "motion": 1e-2, "coupling": 1e-2}
AUTHORS = {"log_diagonal": 5e-3, "shape": 1e-3, "motion": 1e-3, "lambda": 0}


@pytest.mark.parametrize(
    ("recipe", "iterations", "expected", "agr", "options"),
    [
        ("paper", 1000, PAPER, True, {"factor_order": "paper", "off_diagonal": "raw"}),
        ("paper", 30_000, PAPER, True, {"factor_order": "paper", "off_diagonal": "raw"}),
        ("authors", 30_000, AUTHORS, False, {"lambda_t": 0.01, "lambda_d": 0.01, "off_diagonal": "row_scaled"}),
    ],
)
def test_rates_are_those_published(recipe, iterations, expected, agr, options):
    """Catches a published rate that falls, or that depends on the run's length or the scene's size; with the authors'
    code AGR, which it does not have, a lambda that learns, and entries that are not row-scaled."""
    config = composed("model=7dgs", f"+recipe={recipe}", f"train.iterations={iterations}")
    for progress in (0.0, 0.5):
        of_run = rates(config, progress)
        assert {name: of_run[name] for name in expected} == expected
    assert config.model.options.items() >= options.items()
    assert (config.agr, config.model.agr_octaves if agr else 10) == (agr, 10)
    assert Schedule(config.train, 3, config.agr).densify_every == 100


# Rates at all times; those that fall, by the share of the steps; warm-up, and start, stop and every of densification.
# The positions' rates are those of an extent of 5.
AUTHORS_RATES = {
    "deformable": (
        {"scales": 5e-3, "quats": 1e-3},
        {
            0.0: {"means": 8e-4, "field": 8e-4},
            0.375: {"means": 8e-5},
            0.75: {"means": 8e-6},
            1.0: {"means": 8e-6, "field": 1.6e-6},
        },
        (3000, 500, 15_000, 100),
    ),
    "hexplane": (
        {"scales": 5e-3, "quats": 1e-3},
        {
            n / 23: {"planes": 5 * rate, "network": 5 * rate / 10}
            for n, rate in ((3, 1.6e-3), (13, 1.6e-4), (23, 1.6e-5))
        },
        (3000, 500, 18_000, 100),
    ),
    "scgs": (
        {"nodes": 8e-4, "features": 2.5e-3, "scales": 5e-3},
        {
            0.0: {"means": 8e-4, "field": 8e-4},
            0.375: {"means": 8e-6},
            0.5: {"means": 8e-6, "field": 1.6e-6},
            1.0: {"means": 8e-6, "field": 1.6e-6},
        },
        (10_000, 500, 50_000, 100),
    ),
    "stg": ({"path": 1.75 * 8e-4, "times": 1e-4, "turns": 1e-4, "durations": 3e-2, "scales": 1.5e-3}, {}, None),
    "ex4dgs": (
        {"velocities": 1e-4, "key_quats": 1e-3, "windows": 1e-3, "fades": 1e-4, "quats": 1e-5, "scales": 5e-3}
        | {"key_means": 8e-4},
        {},
        None,
    ),
}


@pytest.mark.parametrize("words", [(), ("train.iterations=4000",)])
@pytest.mark.parametrize("model", AUTHORS_RATES)
def test_a_model_learns_as_its_authors_have_it(model, words):
    """Catches rates of another length of run, in static steps or of another extent, rates that fall where the authors'
    do not or go on falling where theirs end, and densification or a warm-up that ends elsewhere."""
    fixed, falling, steps = AUTHORS_RATES[model]
    config = composed(f"model={model}", f"+recipe=authors_{model}", *words)
    for share in (0.0, 0.5, 1.0, *falling):
        of_run, expected = rates(config, share), fixed | falling.get(share, {})
        assert {name: of_run[name] for name in expected} == pytest.approx(
            expected, rel=1e-3 if model == "hexplane" else 1e-6
        )
    if steps and not words:
        s = Schedule(config.train, 3, config.agr, build(config).warm_up)
        assert (s.warm_up, s.densify_start, s.densify_stop, s.densify_every) == steps


def test_rounds_are_those_of_the_authors():
    """Catches rounds at other steps, another number of dynamic Gaussians at the end, and opacities that are reset."""
    stg = composed("model=stg", "+recipe=authors_stg", "train.iterations=15000", "train.recipe_iterations=15000")
    s = Schedule(stg.train, stg.model.sh_degree, stg.agr)
    assert [step + 1 for step in range(15_000) if s.densifies(step)] == [600, 700, 800, 900, 1000, 1100]
    config = composed("model=ex4dgs", "+recipe=authors_ex4dgs")
    s = Schedule(config.train, 3, config.agr)
    rounds = [step for step in range(40_000) if s.densifies(step)]
    assert (rounds[0] + 1, rounds[-1] + 1, len(rounds), list(s.resets_after)) == (600, 30_000, 99, [])
    assert (1 - config.model.options["dynamic_share"]) ** len(rounds) == pytest.approx(0.98**36, abs=0.01)
    assert config.raster.antialias


def test_an_authors_recipe_is_for_their_model():
    """Catches a field's rate that another model silently ignores."""
    with pytest.raises(InputError, match="model '4dgs' has no '"):
        rates(composed("model=4dgs", "+recipe=authors_deformable"), 0.0)


def test_a_narrow_field_differs_in_size_only():
    """Catches a rate of one width that the other lacks, and records that mix them."""
    wide, narrow = composed("model=deformable").model, composed("model=deformable_narrow").model
    assert (narrow.name, narrow.lr) == ("deformable_narrow", wide.lr)
    assert narrow.options == wide.options | {"width": 64, "depth": 4}


def test_7dgs_without_direction_learns_as_7dgs_does():
    """Catches a price of direction that is one of rates or of options: what both have is the same."""
    whole, less = composed("model=7dgs"), composed("model=7dgs_nodir")
    assert whole.model.lr.keys() - less.model.lr.keys() == {"directions", "coupling"}
    assert all(whole.model.lr[name] == rate for name, rate in less.model.lr.items())
    assert whole.model.options.keys() - less.model.options.keys() == {"lambda_d", "directional_half"}
    assert all(whole.model.options[name] == value for name, value in less.model.options.items())
    assert whole.model.min_opacity == less.model.min_opacity


def test_every_model_goes_as_far_in_a_short_run():
    """Catches a model whose geometry keeps the rates of 30,000 steps at 300: all are ten times faster, colours not. The
    harmonics of 3DGS and 6DGS are, which was chosen on static scenes."""
    for model in ("3dgs", "4dgs", "6dgs", "7dgs", "7dgs_nodir"):
        short, long = (rates(composed(f"model={model}", f"train.iterations={n}"), 0.0) for n in (300, 30_000))
        for name in long.keys() - {"lambda"}:
            fixed = ("opacities", "sh0", "refinement", *(() if model in ("3dgs", "6dgs") else ("shN",)))
            expected = 1 if name in fixed else 10
            assert abs(short[name] / long[name] - expected) < 1e-9, f"{model}: {name}"


TRIALS = sorted((CONF / "trial").rglob("*.yaml"))


@pytest.mark.parametrize("path", TRIALS, ids=lambda path: str(path.relative_to(CONF / "trial")))
def test_trials_change_what_they_say(path):
    """Catches a trial that names a parameter its model lacks, or that changes nothing."""
    trial = str(path.relative_to(CONF / "trial").with_suffix(""))
    model = trial.split("/")[0] if "/" in trial else "7dgs"
    tuning = (f"model={model}", "+exp=tuning", "data.root=here")
    config, recipe = composed(*tuning, f"+trial={trial}"), composed(*tuning)
    rates(config, 0.0)
    changed = (config.model.lr, config.train) != (recipe.model.lr, recipe.train)
    assert changed == (trial != "recipe")


def test_every_model_has_the_same_number_of_trials():
    """Catches a model that was tuned more than another."""
    folders = [folder for folder in (CONF / "trial").iterdir() if folder.is_dir()]
    settings = {folder.name: sorted(path.name for path in folder.glob("*.yaml")) for folder in folders}
    of_effects = {"3dgs", "4dgs", "6dgs", "7dgs", "dgs", "dbs", "freetime", "ubs"}
    assert settings.keys() == of_effects | {"deformable", "ex4dgs", "hexplane", "scgs", "stg", "stg_full"}
    assert {len(names) for names in settings.values()} == {5}


def test_the_suite_names_every_scene_once():
    """Catches a scene that `scene=all` leaves out, one of no kind, and one that overrides the experiment."""
    register_schema()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        listed = list(compose("config", ["+exp=suite", "scene=suite/trex100"]).data.scenes)
        assert sorted(listed) == sorted(f"suite/{path.stem}" for path in (CONF / "scene" / "suite").glob("*.yaml"))
        for name in listed:
            value = compose("config", ["+exp=suite", f"scene={name}"])
            assert f"suite/{value.scene.name}" == name
            assert value.data.dataset in ("monocular", "rig", "array", "static")
            assert (value.experiment, value.train.iterations, value.train.batch_size) == ("suite", 1000, 2)


@pytest.mark.parametrize("folder", ["../other", "/etc", "a/../../b"])
def test_a_published_name_stays_below_the_data_root(folder):
    """Catches a config that reads files outside of data.root."""
    with pytest.raises(InputError, match="scene: expected a name"):
        scene_folder(composed(f"scene.released_as={folder}"))

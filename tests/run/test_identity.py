"""A run's name: made of what its training reads, equal for equal trainings, and fit for a folder."""

import functools
import hashlib
from pathlib import Path

import pytest
from tiny_run import spec_of

from gsbench.config_roles import training_hash
from gsbench.errors import InputError
from gsbench.run.identity import LONGEST_VARIANT, RunSpec


@functools.cache  # most tests compare with the plain run
def named(*words: str) -> RunSpec:
    """The run of `python -m gsbench +exp=mini scene=suzanne` and these words."""
    return spec_of(["+exp=mini", "scene=suzanne", *words])


@pytest.mark.parametrize(
    ("words", "folder"),
    [
        ([], "7dgs"),
        (["model=4dgs", "seed=3"], "4dgs"),
        (["agr=false"], "7dgs_noagr"),
        (["train.iterations=1000"], "7dgs"),  # the experiment's own number
        (["train.iterations=10"], "7dgs,iterations=10"),
        (["train.densify.reset_every=50", "model.options.scheme=schur"], "7dgs,scheme=schur,densify.reset_every=50"),
        (["model.lr.means.start=1e-3"], "7dgs,lr.means.start=0.001"),
        (["scene.downscale=4", "optim=sparse_adam"], "7dgs,optim=sparse_adam,downscale=4"),
        (["+recipe=paper"], "7dgs,recipe=paper"),
        (["+trial=7dgs/fast", "train.batch_size=1"], "7dgs,trial=7dgs.fast,batch_size=1"),
        (["raster.antialias=true"], "7dgs,antialias=true"),
        (["protocol=published"], "7dgs,protocol=published"),
        (["protocol=dgs2026"], "7dgs,protocol=dgs2026"),
        (["effects.gate=end", "effects.budget_db=0.2"], "7dgs,gate=end,budget_db=0.2"),
        (["model=auto", "effects.gate=off"], "auto,gate=off"),
        (["model=auto", "effects.compare=true"], "auto,compare=true"),
        (["model=auto", "effects.gate=off", "effects.compare=true"], "auto,gate=off,compare=true"),
        (
            ["model=auto", "effects.compare=true", "model.compared.moving_4dgs.options.time_degree=1"],
            "auto,compared.moving_4dgs.options.time_degree=1,compare=true",
        ),
    ],
)
def test_a_folder_says_what_is_not_the_experiments_own(words, folder):
    """Catches two runs in one folder, and a folder named after what the experiment does anyway."""
    run = named(*words)
    assert run.folder == Path(f"results/mini/suzanne/{folder}/seed{run.config.seed}")
    assert run.folder.parent.name == run.label + (f",{run.variant}" if run.variant else "")


MEASURING = (
    *("protocol.pictures=1", "protocol.quantise=true", "protocol.renders=60", "protocol.lpips_alex=weights.npz"),
    *("data.published=there", "data.root=/x", "train.checkpoint_minutes=9"),
    *("results=elsewhere", "resume=false", "log=wandb"),
)
TRAINING = (
    *("seed=1", "train.iterations=9", "model.lr.means.end=1e-5", "data.initial_points=9", "raster.backend=reference"),
    *("scene.eval_split=val", "scene.resize=pillow", "protocol.best_on_test=true"),
)


@pytest.mark.parametrize("word", [*MEASURING, *TRAINING])
def test_what_changes_the_training_changes_its_hash_and_nothing_else_does(word):
    """Catches a training repeated because it is measured in another way, and another run's checkpoint that is taken."""
    assert (training_hash(named(word).plain) == training_hash(named().plain)) == (word in MEASURING)
    assert word in TRAINING or named(word).variant == ""


def test_a_file_to_start_from_is_training(tmp_path):
    """Catches a run that is taken for one that started from another file, and one that depends on the file's place."""
    runs = []
    for name, content in (("a", b"1"), ("b", b"2"), ("c", b"1")):
        (tmp_path / f"{name}.ply").write_bytes(content)
        runs.append(named(f"+init.ply={tmp_path / name}.ply"))
    a, b, c = runs
    assert training_hash(a.plain) != training_hash(b.plain) != training_hash(named().plain)
    assert training_hash(a.plain) == training_hash(c.plain)
    assert a.variant == f"ply_sha256={hashlib.sha256(b'1').hexdigest()[:8]}" == c.variant != b.variant
    assert a.plain["init"]["ply_sha256"] == a.config.init.ply_sha256 == hashlib.sha256(b"1").hexdigest()


def test_the_protocol_of_dgs_is_whole_and_its_parts_can_be_set():
    """Catches a name that stands over another filter, rounding, batch or number of tests than its authors'."""
    words = ["+exp=dnerf", "data.root=/d", "scene=lego", "model=dgs", "protocol=dgs2026"]
    config = spec_of(words).config
    assert (config.scene.resize, config.scene.downscale, config.scene.eval_split) == ("pillow", 2, "val")
    assert (config.protocol.quantise, config.protocol.best_on_test, config.data.background) == (True, True, "black")
    assert config.train.batch_size == 4
    assert config.train.iterations / config.train.curve_points == 500
    assert spec_of([*words, "+recipe=mcmc", "train.batch_size=1"]).config.train.batch_size == 1


def test_a_comparison_is_training_and_its_candidates_count_only_with_it():
    """Catches model=auto that trains every finished run again, as its settings have candidates to compare."""
    words, other = ("model=auto", "effects.compare=true"), "model.compared.moving_4dgs.options.time_degree=1"
    runs = [named("model=auto"), named(*words), named(*words, "effects.gate=off"), named(*words, other)]
    assert len({training_hash(run.plain) for run in runs}) == 4
    assert training_hash(named("model=auto", other).plain) == training_hash(runs[0].plain)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            "model=6dgs ~model.options.directional_half",
            r"'model\.options\.directional_half': expected a value, it was deleted",
        ),
        ("experiment=published", "another name than 'published'"),
        ("scene.name=published", "another name than 'published'"),
    ],
)
def test_what_cannot_name_a_run_is_refused(words, message):
    """Catches another training in the folder of the default, as a class has other defaults than YAML, and a run whose
    record every table passes by, as it lies among those that are published."""
    with pytest.raises(InputError, match=message):
        named(*words.split())


def test_long_names_are_cut_at_a_word_and_stay_different():
    """Catches folders that no file system takes, and two runs that are cut to one name."""
    keys = ("means", "times", "directions", "shape", "motion")
    many = [f"model.lr.{key}.start={i}e-3" for i, key in enumerate(keys, 1)]
    first, other = named(*many), named(*many[:-1], "model.lr.motion.start=9e-3")
    for run in (first, other):
        assert len(run.variant) <= LONGEST_VARIANT
        assert run.variant.startswith("lr.means.start=0.001,lr.times.start=0.002,")
    assert first.variant != other.variant
    assert named(*many[::-1]).variant == first.variant  # whatever the order of the words


def test_the_words_repeat_the_run(tmp_path):
    """Catches a record whose command line does another run than its own."""
    run = named("train.iterations=10", f"results={tmp_path}", "seed=2")
    assert run.overrides == ["+exp=mini", "scene=suzanne", "seed=2", "train.iterations=10"]
    assert named(*run.overrides[2:]).plain == run.plain

"""The runs of a command line: scenes as an axis, sweeps without a flag, ablations that change what they name."""

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf
from tiny_run import main_here

from gsbench.config import CONF
from gsbench.config_roles import flat
from gsbench.errors import InputError
from gsbench.launch.command import check_runs, compose_run, hydra_with, parse, runs_of
from gsbench.launch.plan import identity
from gsbench.run.identity import identify

JOB = "+exp=mini scene=suzanne +launch=slurm"
MINI = ("moving-matte", "pendulum", "suzanne")
ABLATIONS = {  # what each changes of 7DGS as it is; of another model, only its name
    "none": {},
    "no_agr": {"agr": False},
    "fixed_lambda": {"model.lr.lambda.start": 0.0},
    "no_time_split": {"model.options.split_in_time": False},
    "time_only": {"model.name": "4dgs"},
    "direction_only": {"model.name": "6dgs"},
    "no_effects": {"model.name": "3dgs"},
    "paper_order": {"model.options.factor_order": "paper"},
    "schur": {"model.options.scheme": "schur"},
    "cholesky": {"model.options.scheme": "cholesky"},
    "raw_off_diagonal": {"model.options.off_diagonal": "raw"},
    "row_scaled": {"model.options.off_diagonal": "row_scaled"},
    "deep_agr_encoded": {
        "model.options.agr_depth": 4,
        "model.options.agr_width": 64,
        "model.options.agr_mean_octaves": 10,
        "model.lr.refinement.start": 8e-4,
        "model.lr.refinement.end": 1.6e-6,
        "model.lr.refinement.per_run": True,
    },
}


@pytest.fixture(autouse=True)
def hydra() -> Iterator[None]:
    with hydra_with(None):
        yield


@pytest.mark.parametrize(
    ("words", "runs"),
    [
        ("+exp=mini", [f"+exp=mini scene={scene}" for scene in MINI]),
        ("scene=all +exp=mini seed=1", [f"+exp=mini seed=1 scene={scene}" for scene in MINI]),
        ("+exp=mini model=4dgs,7dgs -m scene=dust", [f"+exp=mini model={m} scene=dust" for m in ("4dgs", "7dgs")]),
        ("+exp=mini data.scenes=[new,dust]", [f"+exp=mini data.scenes=[new,dust] scene={s}" for s in ("new", "dust")]),
        ("+exp=mini scene=suzanne", None),
        ("+exp=mini scene=suzanne +launch=local", None),
        ("+exp=mini scene=dust +launch=slurm", ["+exp=mini scene=dust +launch=slurm"]),
        (
            "+exp=ablation scene=dust +ablation=none,schur",
            ["+ablation=none +exp=ablation scene=dust", "+ablation=schur +exp=ablation scene=dust"],
        ),
    ],
)
def test_the_runs_of_a_command(words, runs):
    """Catches scenes that one job does one after the other, axes in another order, a run for Slurm that trains on the
    login node, axes of an experiment that a command line cannot replace, and a plan for a run that is of no sweep."""
    assert runs_of(parse(words.split())) == ([run.split() for run in runs or [words]], runs is not None)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("+exp=mini data.scenes=[]", "empty list"),
        ("+exp=mini,dnerf", "expected one experiment"),
        ("+exp=mini -m seed=0,1 +exp=dnerf", r"\+exp: expected it once, got it 2 times"),
        ("+exp=mini protocol.name=published", "protocol.name: expected protocol=NAME"),
        ("+exp=mini launch.at_once=2", r"launch.at_once: expected \+launch=parallel or \+launch=slurm"),
        ("+exp=mini +launch=parallel launch.cpus=2", r"launch.cpus: expected \+launch=slurm, which reads it"),
        ("+exp=mini +model.lr.mean.start=1", "lr.mean.start=1: expected the name of a rate"),
        ("+exp=mini model=7dgs effects.budget_db=1", "effects.budget_db: expected effects.gate too"),
        ("+exp=mini model=7", "model '7' is not known"),
        ("+exp=mini -m seed=interval(0,3)", "expected quotes|expected values"),
        ("+exp=mini --config-name=x", "--config-name=x: expected -m"),
        ("+exp=mini --multi", "--multi: expected -m"),
        ("+exp=mini ~data", "config key 'data': expected a value, it was deleted: leave '~data' out"),
        ("+exp=mini data.scenes=[new] scene=newer", "scene 'newer' is not known"),
        ("+exp=mini scene.name=suzanne", "one run in one folder: .* scene=moving-matte' and .*: add scene=custom"),
        ("+exp=mini -m scene=dust data.root=a,b", "one run in one folder: .*: leave one of them out"),
        ("+exp=mini -m scene=all,dust", "scene: expected all or names of scenes, got both"),
        ("+exp=mini scene=dust hydra.run.dir=x", "hydra.run.dir: expected a key of gsbench's"),
        ("+exp=mini scene=dust hydra/launcher=basic", "hydra/launcher: expected a key of gsbench's"),
        (
            "+exp=mini scene=dust +ablation=time_only model=7dgs",
            "time_only: expected no other model beside it than 4dgs",
        ),
        ("+exp=ablation scene=dust model=6dgs", "time_only: expected no other model beside it than 4dgs"),
        ("+exp=mini scene=dust train.coarse=[4,300]", r"coarse=\[4,300\]: Invalid value assigned: int is not"),
        ("+exp=mini scene=dust ~protocol", "'protocol.name': expected a value, got none: set it"),
        (
            "+exp=dnerf data.root=/nowhere",
            r"root=/nowhere: there is no such folder: set data.root=PATH, .* D-NeRF \(bounc",
        ),
        (f"{JOB} launch.sbatch.qos=x", r"'launch.sbatch.qos': expected \+ .*: type \+launch.sbatch.qos"),
        *(
            (f"{JOB} launch.{word}", rf"launch\.{word.partition('=')[0]}: expected .*\d")
            for word in (
                "at_once=-2",
                "minutes=0",
                "cpus=0",
                "gpus=-1",
                "requeues=-1",
                "signal_seconds=0",
                "signal_seconds=65536",
            )
        ),
    ],
)
def test_a_command_without_runs_is_refused(words, message):
    """Catches a sweep of no run that ends well, options of Hydra, a word or a launcher's key that would be dropped in
    silence, a key without the one that it needs, a scene that is no scene, one folder that several runs share, and a
    job that is submitted and fails, or is never requeued, for a number out of its range; an ablation without its model,
    a scene called all, and a failed run for each scene of a folder that does not exist."""
    with pytest.raises(InputError, match=message):
        check_runs([compose_run(run) for run in runs_of(parse(words.split()))[0]])


def test_a_sweep_of_different_runs_is_allowed():
    """Catches a sweep over protocols, results or PLYs refused as one run, a key that one run does not read, and data
    that only the nodes of a cluster have."""
    several = ["protocol=gsbench,published", "results=a,b", "+init.ply=a,b", "effects.budget_db=1 effects.gate=end,off"]
    several += ["+launch=slurm data.root=/nowhere"]
    for words in several:
        runs = runs_of(parse(["+exp=mini", "-m", "scene=dust", *words.split()]))[0]
        check_runs([compose_run(run) for run in runs])


def composed(*words: str) -> dict[str, Any]:
    """The settings of the one run of a command."""
    (run,), _ = runs_of(parse(["+exp=mini", "scene=dust", *words]))
    return dict(flat(OmegaConf.to_container(compose_run(run).config, resolve=True)))


def test_the_order_of_words_does_not_matter(capsys):
    """Catches an experiment that takes back what a recipe says, as it was typed last, and a record, whose words are
    sorted, that repeats another run: that of a recipe which takes an ablation back, or of the first of two seeds."""
    for added in ("+recipe=quick", "+ablation=row_scaled +recipe=paper"):
        words = ["+exp=mini", "scene=dust", *added.split()]
        first, second = (compose_run(order) for order in (words, words[::-1]))
        assert first.config == second.config
        assert identify(first.config, first.choices).variant == added.replace("+", "").replace(" ", ",")
    assert first.config.model.options.off_diagonal == "row_scaled"
    assert main_here("+recipe=quick", "+exp=mini", "scene=dust", "--cfg", "job") == 0
    assert "  iterations: 7500\n" in capsys.readouterr().out
    with hydra_with(None):
        assert runs_of(parse(["seed=2", "+exp=mini", "scene=dust", "seed=1"]))[0] == [
            ["seed=1", "+exp=mini", "scene=dust"]
        ]


def test_what_a_message_advises_works():
    """Catches a new rate that the advised words do not add, and a home that is a folder called ~ in this one."""
    assert composed("+model.lr={new: {start: 1e-3}}")["model.lr.new.start"] == 1e-3
    assert composed("results='~/a b'")["results"] == str(Path.home() / "a b")


def test_a_question_is_left_to_hydra():
    """Catches a question that is refused as an option, such as for the config of a run, and a run taken for one."""
    assert [parse(["+exp=mini", *words]).asks for words in ([], ["--cfg", "job"], ["-c", "job"])] == [False, True, True]


def test_scenes_of_the_user_are_choices():
    """Catches a retry or a job that cannot compose a scene without a file."""
    assert compose_run(["+exp=mini", "data.scenes=[new]", "scene=new"]).config.scene.name == "new"


def test_configs_of_the_user_are_found_in_their_folder(tmp_path):
    """Catches --config-dir that is read for the help alone, that stays for the next command, or that is mistyped."""
    (tmp_path / "launch").mkdir()
    (tmp_path / "launch" / "cluster.yaml").write_text("# @package _global_\nlaunch: {by: slurm, partition: gpu}\n")
    words = ["+exp=mini", "scene=suzanne", "+launch=cluster"]
    GlobalHydra.instance().clear()
    with hydra_with(tmp_path):
        assert compose_run(words).config.launch.partition == "gpu"
    with pytest.raises(InputError, match="which is none"), hydra_with(tmp_path / "none"):
        pass
    with hydra_with(None), pytest.raises(InputError, match="launch 'cluster' is not known"):
        compose_run(words)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"name: x\nsh_degre: 2\n", r"^model/mine.yaml: config key 'model.sh_degre' is not known. Did you mean 'sh_d"),
        (b"name: x\nlr: {a: {start: fast}}\n", r"^model/mine.yaml: config key 'model.lr.a.start': Value 'fast' of"),
        (b"model: {name: x}\n", r"^model/mine.yaml: expected `# @package _global_` as its first line"),
        ("name: x\n".encode("utf-16"), r"^--config-dir: expected YAML files in UTF-8"),
    ],
)
def test_a_wrong_config_of_the_user_is_explained(content, message, tmp_path):
    """Catches lines of OmegaConf's without the key that was meant, or the line that is missing."""
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "mine.yaml").write_bytes(content)
    GlobalHydra.instance().clear()
    with hydra_with(tmp_path), pytest.raises(InputError, match=message):
        compose_run(["+exp=mini", "scene=dust", "model=mine"])


def test_a_config_of_the_user_is_not_passed_by(tmp_path):
    """Catches an edited copy of a model's YAML in whose place gsbench's own was read, without a word."""
    name = Path("model", "7dgs.yaml")
    (tmp_path / "model").mkdir()
    (tmp_path / name).write_bytes((CONF / name).read_bytes())
    GlobalHydra.instance().clear()
    with hydra_with(tmp_path):
        pass
    with (tmp_path / name).open("a") as file:
        file.write("sh_degree: 0\n")
    with pytest.raises(InputError, match=r"model/7dgs.yaml: expected another name than"), hydra_with(tmp_path):
        pass


@functools.cache
def settings(ablation: str) -> dict[str, Any]:
    config = compose_run(["+exp=ablation", "scene=suzanne", f"+ablation={ablation}"]).config
    return dict(flat(OmegaConf.to_container(config, resolve=True)))


@pytest.mark.parametrize("name", ABLATIONS)
def test_an_ablation_changes_what_it_names_and_nothing_else(name):
    """Catches an ablation that is the whole model, or one that changes a second thing."""
    whole, changed, named = settings("none"), settings(name), ABLATIONS[name]
    differs = {key: value for key, value in changed.items() if whole.get(key) != value}
    assert (differs | named == differs) if "model.name" in named else (differs == named)
    assert "model.name" not in named or changed["agr"] is True  # AGR stays, so that only the effects differ


def test_the_ablation_sweeps_over_all_ablations_by_itself():
    """Catches an ablation that is shipped and not in the sweep, and a plan that forgets the experiment's own axes."""
    runs, is_sweep = runs_of(parse(["+exp=ablation", "scene=suzanne"]))
    assert is_sweep
    assert sorted(run[0] for run in runs) == sorted(f"+ablation={name}" for name in ABLATIONS)
    assert {path.stem for path in (CONF / "ablation").glob("*.yaml")} == set(ABLATIONS)


def test_launch_settings_change_no_number():
    """Catches a partition, or a results folder, that makes another run of the same run."""
    words = ["model=7dgs", "+launch=slurm", "launch.partition=gpu", "+launch.sbatch.qos=x", "results=r", "resume=false"]
    assert identity([*words, "+exp=mini"]) == ("+exp=mini", "model=7dgs")

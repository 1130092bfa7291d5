"""The command line as a user meets it: help, one run, sweeps, and everything that can be typed wrong."""

import importlib
import itertools
import json
import re

import pytest
import torch
from forked import python
from tiny_run import ROOT, gsbench, main_here, overrides, write_moving_square

from gsbench import __main__ as command
from gsbench.config import CONF
from gsbench.errors import TooLargeError
from gsbench.measure import record
from gsbench.train import step
from gsbench.usage import DESCRIBED, first_sentence


def test_help_describes_what_there_is_without_torch():
    """Catches a help that imports torch or composes a config, describes no model or experiment, or lists trials, and
    a long name that moves its sentence out of the column."""
    code = (
        "import sys; sys.argv = ['gsbench', '--help']\n"
        "import hydra._internal.hydra as composer; composer.Hydra.create_main_hydra2 = None\n"
        "from gsbench.__main__ import main\n"
        "try: main()\n"
        "finally: sys.stderr.write('torch imported' if 'torch' in sys.modules else 'no torch')"
    )
    done = python("-c", code, cwd=ROOT)
    assert done.stderr == "no torch"
    assert "  4dgs               4DGS (Yang et al. 2023): Gaussians in space and time\n" in done.stdout
    assert "\n  deformable_narrow  Deformable-3DGS with" in done.stdout
    assert "  mini          The three embedded scenes, on a laptop\n" in done.stdout
    for word in ("suzanne", "+recipe=NAME", "agr=true|false", "gsbench doctor"):
        assert word in done.stdout
    for word in ("late_harmonics", "row_scaled", "trex100"):
        assert word not in done.stdout
    assert max(map(len, done.stdout.splitlines())) <= 120
    assert [f"{title}:" for title in DESCRIBED.values() if f"\n{title}:\n" not in done.stdout] == []


@pytest.mark.parametrize("path", sorted(p for group in DESCRIBED for p in (CONF / group).glob("*.yaml")), ids=str)
def test_every_choice_in_the_help_has_a_sentence(path):
    """Catches a model or an experiment without a description, or one that is cut behind 'et al.'."""
    sentence = first_sentence(path)
    assert len(sentence.split()) > 2
    assert sentence.count("(") == sentence.count(")")


def test_the_help_lists_models_of_the_user(tmp_path, capsys):
    """Catches `--config-dir` that is not read, as Hydra's own help does."""
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "balls.yaml").write_text("# Balls of one size. Not much.\nname: balls\n")
    for words in (["--config-dir", str(tmp_path), "--help"], ["-h", f"--config-dir={tmp_path}"]):
        assert main_here(*words) == 0
        assert re.search("^  balls +Balls of one size$", capsys.readouterr().out, re.MULTILINE)


def test_the_help_explains_keys(capsys):
    """Catches a key without its range, one that another key's name begins, and a prefix of no key."""
    assert main_here("train.densify", "--help") == 0
    lines = capsys.readouterr().out.splitlines()
    assert "train.densify.start=500             first step; at least 0" in lines
    assert all(line.startswith(("train.densify.", "  ")) for line in lines)
    assert main_here("--help", "train.dens") == 2
    assert "train.dens: expected a config key. Did you mean 'train'?" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["+exp=mini", "model=7dg"], ["model '7dg'", "Did you mean '7dgs'"]),
        (["+exp=dnrf"], ["exp 'dnrf'", "Did you mean 'dnerf'"]),
        (["+exp=mini", "scene=suzane"], ["scene 'suzane'", "Did you mean 'suzanne'"]),
        (["+exp=mini", "train.iteratons=5"], ["train.iteratons", "Did you mean 'iterations'"]),
        (["+exp=mini", "trian.iterations=5"], ["trian", "Did you mean 'train'"]),
        (["+exp=mini", "train.iterations=many"], ["train.iterations", "many"]),
        (["+exp=mini", "scene=suzanne", "device=gpu"], ["device 'gpu'", "Valid: cpu, cuda"]),
        (["+exp=mini", "scene=suzanne", "device=cuda:99"], ["device 'cuda:99'", "device=cpu"]),
        (["+exp=mini", "scene=suzanne", "scene.eval_split=tset"], ["eval_split 'tset'", "Did you mean 'test'"]),
        (["+exp=mini", "scene=suzanne", "model.options.schem=schur"], ["model.options.schem", "Did you mean 'scheme'"]),
        (["+exp=mini", "scene=suzanne", "model.options.scheme=shur"], ["scheme 'shur'", "Did you mean 'schur'"]),
        (["+exp=mini", "scene=suzanne", "+init.ply=/nowhere.ply"], ["init.ply", "/nowhere.ply"]),
        (["+exp=mini", "scene=suzanne", f"+init.ply={__file__}"], ["test_command_line.py", "expected a PLY"]),
        (["+exp=mini", "model=1e400"], ["model '1e400'", "Valid: 3dgs"]),
        (["+exp=mini", "scene=suzanne,pendulum"], ["scene=suzanne,pendulum: commas", "\"scene='suzanne,pendulum'\""]),
        (["results/mini"], ["'results/mini': expected KEY=VALUE"]),
        (["Küche=1"], ["'Küche=1': expected KEY=VALUE"]),
        (["=3"], ["'=3': expected KEY=VALUE"]),
        (["model=7dgs"], ["+exp=NAME", "ablation, colmap, dnerf, frontier", "mini, n3v, panoptic, pbr"]),
        (["+exp=dnerf", "scene=trex"], ["data.root", "transforms_", "albertpumarola/D-NeRF"]),
        (["+exp=dnerf", "scene=trex", "data.root=/nowhere"], ["data.root=/nowhere", "transforms_", "D-NeRF"]),
        (["+exp=mini", "scene=custom", "scene.name=../sample"], ["scene: expected a name", "../sample"]),
    ],
)
def test_what_is_typed_wrong_is_told_in_one_line(arguments, expected, tmp_path, capsys):
    """Catches a stack trace, or a message that does not name the key, the nearest valid one, or what to do; or two."""
    assert main_here(*arguments, *([f"results={tmp_path}"] if "+exp" in arguments[0] else [])) != 0
    printed = capsys.readouterr()
    errors = [line for line in printed.err.splitlines() if line.startswith("gsbench: error:")]
    assert errors, printed.err
    assert "Traceback" not in printed.err
    for part in expected:
        assert part in errors[0]
    for run in map(record.read, record.find(tmp_path)):  # a run that has a name leaves a row that says why it failed
        assert (run.status, run.metrics) == ("failed", None)
        assert (printed.err + printed.out).count(str(run.reason)) == 1, "a terminal shows it twice"
        assert "record.json" in printed.out


@pytest.mark.parametrize(
    "words", [[], ["+exp=dnerf"], ["-m", "+exp=dnerf", "scene=trex,lego"], ["-m", "data.root=.,???", "+exp=dnerf"]]
)
def test_a_command_without_an_experiment_or_data_is_refused_in_one_line(words, tmp_path, capsys):
    """Catches lines of Hydra and warnings around the reason, and runs that are planned and then lost for ever."""
    assert main_here(*words, *([f"results={tmp_path}"] if words else [])) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"gsbench: error: {'data.root is not set' if words else 'expected an experiment'}")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["train.iterations=0"], "train.iterations: expected at least 1, got 0"),
        (["-m", "train.iterations=1,0"], "train.iterations: expected at least 1, got 0"),
        (["train.coarse=[[1,3000]]"], "train.coarse: expected pairs"),
        (["model=auto", "model.candidates.static.min_opacity=1"], "model=auto, candidate static: model.min_opacity: "),
    ],
)
def test_a_wrong_value_is_refused_before_the_first_run(words, reason, tmp_path, capsys):
    """Catches a sweep whose wrong run fails after hours, and a folder of a run that never was."""
    assert main_here("+exp=mini", "scene=suzanne", *words, f"results={tmp_path}") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"gsbench: error: {reason}")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("place", "root"), [("a/b/square", ""), ("a/square", ""), ("a/square", "a/square")])
def test_a_data_root_too_high_or_too_low_names_the_right_one(place, root, square, tmp_path, capsys):
    """Catches a message that lists where the scene is not, while it lies in a folder beside."""
    (tmp_path / place).parent.mkdir(parents=True)
    (tmp_path / place).symlink_to(square / "square")
    words = overrides(tmp_path / root, tmp_path / "r", "model=3dgs", "train.iterations=1")
    assert main_here(*words) == 1
    assert f'type "data.root={(tmp_path / place).parent}"' in capsys.readouterr().err


def test_a_sweep_writes_a_record_a_run_and_keeps_what_is_finished(square, tmp_path):
    """Catches runs that overwrite each other, AGR that cannot be switched, and finished runs that are done again."""
    sweep = ["-m", *overrides(square, tmp_path), "model=4dgs,3dgs", "agr=true,false"]
    first = gsbench(*sweep)
    assert first.returncode == 0, first.stderr
    runs = {run.model: run for run in map(record.read, record.find(tmp_path))}
    assert set(runs) == {"3dgs", "3dgs_agr", "4dgs", "4dgs_agr"}
    for label, run in runs.items():
        assert run.status == "ok"
        assert run.effects.refinement == label.endswith("_agr")
        assert run.effects.time == label.startswith("4dgs")
        assert len(run.curve) == 2
        assert run.metrics["psnr"] is not None
        assert set(run.cost.stage_s) >= {"slice", "raster", "loss", "backward", "optimizer"}
        (pictures,) = (tmp_path / "dnerf" / "square").glob(f"{label},*/seed0/pictures.png")
        assert pictures.is_file()
    written = {p: p.stat().st_mtime_ns for p in record.find(tmp_path)}
    again = gsbench(*sweep)
    assert again.returncode == 0
    assert again.stdout.count("finished before, kept") == 4
    assert {p: p.stat().st_mtime_ns for p in record.find(tmp_path)} == written


def test_one_bad_scene_does_not_stop_the_others(tmp_path):
    """Catches a broken scene that ends or hides behind exit code 0, and a 4DGS fitted to a made-up time."""
    names = ("broken", "square", "static")
    for name in names:
        write_moving_square(tmp_path / "data", name)
    for source in (tmp_path / "data").glob("*/transforms_*.json"):
        content = json.loads(source.read_text())
        for frame in content["frames"]:
            if source.parent.name == "static":
                del frame["time"]
            elif source.parent.name == "broken":
                frame["file_path"] = "./train/gone"
        source.write_text(json.dumps(content))
    words = [word for word in overrides(tmp_path / "data", tmp_path / "r") if not word.startswith(("scene", "data.sc"))]
    done = gsbench(
        "-m", *words, "scene=all", "scene.downscale=1", f"data.scenes=[{','.join(names)}]", "model=4dgs,6dgs"
    )
    assert done.returncode == 1
    assert "gsbench: error: broken: " in done.stderr
    runs = {(run.scene, run.model): run for run in map(record.read, record.find(tmp_path / "r"))}
    failed = {name for name, run in runs.items() if run.status == "failed"}
    assert failed == {("broken", "4dgs"), ("broken", "6dgs"), ("static", "4dgs")}
    assert len(runs) == 6
    assert "gone" in str(runs["broken", "4dgs"].reason)
    assert "use 3dgs or 6dgs" in str(runs["static", "4dgs"].reason)


def test_divergence_ends_as_a_record_and_the_rest_goes_on(square, tmp_path):
    """Catches a diverged run that is lost, hidden, or takes the sweep with it: one line, a record, exit code 1. Without
    harmonics, the largest of no coefficients took the record with it."""
    sweep = ["-m", *overrides(square, tmp_path), "model=3dgs", "seed=0,1", "model.sh_degree=0"]
    done = gsbench(*sweep, "model.lr.means.start=1e38")
    assert done.returncode == 1
    runs = [record.read(path) for path in record.find(tmp_path)]
    assert [(run.status, str(run.reason)[:8], run.metrics) for run in runs] == [("diverged", "step 1: ", None)] * 2
    assert done.stderr.count("gsbench: error: square: diverged: step 1: ") == 2
    assert all("Gaussian" in str(run.reason) for run in runs)  # it is explained


@pytest.mark.parametrize("error", [torch.OutOfMemoryError, TooLargeError])
def test_out_of_memory_ends_as_a_record_and_the_rest_goes_on(error, square, tmp_path, monkeypatch):
    """Catches memory that runs out and ends the process, counts as diverged, or has a record without advice."""
    render = step.render_slices

    def full(*_: object) -> None:
        monkeypatch.setattr(step, "render_slices", render)  # the next run has memory again
        raise error("pictures need 9.0 MiB: lower the picture's size")

    monkeypatch.setattr(step, "render_slices", full)
    assert main_here("-m", *overrides(square, tmp_path), "model=3dgs", "seed=0,1") == 1
    statuses = {run.seed: (run.status, run.reason) for run in map(record.read, record.find(tmp_path))}
    reason = "out of memory: pictures need 9.0 MiB: lower the picture's size"
    assert statuses == {0: ("failed", reason), 1: ("ok", None)}


def test_a_warning_of_gsbench_is_one_line():
    """Catches the line of code that Python adds, and a warning of another package under gsbench's name."""
    assert command._in_one_line("slow", UserWarning, str(ROOT / "gsbench/a.py"), 3) == "gsbench: warning: slow\n"
    assert command._in_one_line("slow", UserWarning, "/a.py", 3) == "/a.py:3: UserWarning: slow\n"


@pytest.mark.parametrize(
    "module", ["export", "score", *(f"{name}.__main__" for name in ("fetch", "gates", "launch", "stability", "view"))]
)
def test_the_help_is_what_a_user_types_and_needs(module, capsys):
    """Catches a usage with a file's name, a help that does not say what for, and an argument without a text."""
    command = importlib.import_module(f"gsbench.{module}")
    with pytest.raises(SystemExit, match="0"):
        command.main(["--help"])
    text = capsys.readouterr().out
    assert text.startswith(f"usage: python -m gsbench.{module.removesuffix('.__main__')} [-h]")
    assert "".join(command.__doc__.partition(".")[0].split()) in "".join(text.split())
    *_, listed = text.partition("\n\n")[2].partition(":\n")
    for argument, after in itertools.pairwise([*listed.splitlines(), ""]):
        if argument.startswith("  ") and argument[2] != " ":
            assert "  " in argument[2:] or after.startswith("    "), argument

"""Folders and scenes of any name are trained: what Hydra cannot read is refused with what to type, and that works."""

import re
import subprocess

import pytest
from tiny_run import main_here, overrides, write_moving_square

from gsbench.measure import record

NAMES = ("my data (1)", "Küche", "100%%#x", "a=1,b=2", '$HOME `x` "it\'s"', "日本 [3]", "a,b", "x!\\y", "~&;<|>")


@pytest.mark.parametrize("name", NAMES)
def test_a_folder_of_any_name_is_given_as_the_error_says(name, square, tmp_path, capsys):
    """Catches an error of Hydra's grammar that does not name the argument, and a cure that a shell reads otherwise.
    gsbench's run folders themselves have = and commas in their names."""
    (tmp_path / name).symlink_to(square)
    words = overrides(square, tmp_path / "r", "model=3dgs", "train.iterations=1")
    words = [word for word in words if not word.startswith("data.root")]
    assert main_here(*words, f"data.root={tmp_path}/{name}") == 2
    line = capsys.readouterr().err.strip()
    assert line.startswith("gsbench: error: data.root")
    cure = re.search(r"type (?:-m too for a run of each, or )?(.*?)(?: for one value)?$", line)
    shell = subprocess.run(["bash", "-c", f"printf %s {cure[1]}"], capture_output=True, text=True, check=True)
    assert main_here(*words, shell.stdout) == 0, shell.stdout


@pytest.mark.parametrize("scene", ["Küche", "2024_01_02", "1e3", "日本"])
def test_a_scene_of_any_name_is_trained(scene, tmp_path, capsys):
    """Catches a date that Hydra reads as a number, and letters that a run's folder may not have."""
    data = write_moving_square(tmp_path / "data", scene)
    words = [*overrides(data, tmp_path / "r", "model=3dgs", "train.iterations=1"), f"scene.name={scene}"]
    words.remove("scene.name=square")
    assert main_here(*words) == 2
    assert f"type \"scene.name='{scene}'\"" in capsys.readouterr().err
    assert main_here(*words[:-1], f"scene.name='{scene}'") == 0
    (path,) = record.find(tmp_path / "r")
    assert record.read(path).scene == scene
    assert "name=" not in record.read(path).variant
    listed = [word for word in words[:-1] if not word.startswith(("scene=", "data.scenes"))]
    assert main_here(*listed, f"data.scenes=[{scene},{scene}]") == 2
    assert f"type \"data.scenes=['{scene}','{scene}']\"" in capsys.readouterr().err
    assert main_here(*listed, f"data.scenes=['{scene}']") == 0
    assert "finished before, kept" in capsys.readouterr().out

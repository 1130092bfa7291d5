"""Models from anywhere: a module that the user names, an installed package, and never what a checkpoint says."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from gsbench import export
from gsbench.config import CONF, register_schema
from gsbench.errors import InputError
from gsbench.gates import __main__ as gates
from gsbench.kernels.slices import slice_static
from gsbench.models import CameraTime, registry
from gsbench.models.gaussians3d import Gaussians3DModel
from gsbench.models.registry import build, find
from gsbench.run.load import typed_config
from gsbench.scenes.points import random_points
from gsbench.stability import __main__ as stability
from gsbench.view import __main__ as view

MODEL = """
from gsbench.models.gaussians3d import Gaussians3DModel
from gsbench.models.registry import register

@register("NAME")
class Elsewhere(Gaussians3DModel):
    pass
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder on Python's path, outside of the package; what is registered from it is forgotten again."""
    assert registry.is_registered("3dgs")  # all of gsbench's own are in before the table is copied
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(registry, "_REGISTRY", dict(registry._REGISTRY))
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if name.startswith("models_of_"):
            del sys.modules[name]


def test_a_module_that_the_user_names(folder):
    """Catches a name of a module that is not imported, or imported after the model was looked for."""
    (folder / "models_of_mine.py").write_text(MODEL.replace("NAME", "mine"))
    with pytest.raises(InputError, match="model 'mine' is not known"):
        find("mine")
    assert type(build("mine", module="models_of_mine")).__name__ == "Elsewhere"
    assert find("mine").__module__ == "models_of_mine"


def test_an_installed_package_lists_its_models(folder):
    """Catches an entry point that no one reads."""
    (folder / "models_of_a_package.py").write_text(MODEL.replace("NAME", "packaged"))
    about = folder / "of_others-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: of-others\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[gsbench.models]\nany = models_of_a_package\n")
    assert find("packaged").__module__ == "models_of_a_package"


class Hidden:
    """Mixed into a model: its slices show nothing."""

    def condition(self, raw: Any, query: Any) -> Any:
        sliced = super().condition(raw, query)
        return sliced._replace(opacity_factor=0 * sliced.opacity_factor)


@pytest.mark.parametrize(("members", "is_visible"), [({}, False), ({"kernel": slice_static}, True)])
def test_a_condition_of_its_own_is_called(members, is_visible):
    """Catches a derived model whose `condition` is ignored, since its base slices by a kernel."""
    model = type("Derived", (Hidden, Gaussians3DModel), members)()
    model.initialise(random_points(5, 1.0, torch.Generator().manual_seed(0)), 1.0, torch.Generator())
    for of in (model, type("Again", (type(model),), {})()):
        of.splats = model.splats
        assert bool(of.slice(CameraTime.at(torch.zeros(3), None)).opacities.any()) == is_visible


def test_a_name_that_is_taken(folder):
    """Catches a stranger's model that stands in the place of 7DGS in silence; the same class twice is no clash."""
    (folder / "models_of_a_thief.py").write_text(MODEL.replace("NAME", "7dgs"))
    with pytest.raises(InputError, match=r"'7dgs': expected a name of its own, gsbench\.models\.cholesky has"):
        find("7dgs", "models_of_a_thief")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            None,
            "model.module='models_of_none': expected a Python module that can be imported: ModuleNotFoundError: "
            "No module named 'models_of_none': run the command in its folder",
        ),
        ("x = 1\ny = x / 0\n", "models_of_none.py, line 2: ZeroDivisionError"),
        ("def broken(:\n", "SyntaxError"),
    ],
)
def test_a_module_that_cannot_be_imported(folder, text, message):
    """Catches a stack trace for a typo in the name, and one line that does not say where the user's own code fails."""
    if text is not None:
        (folder / "models_of_none.py").write_text(text)
    with pytest.raises(InputError) as caught:
        find("none", "models_of_none")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("command", [view, export, gates, stability])
def test_a_command_imports_the_module_of_a_runs_model(command, folder, capsys):
    """Catches a command that cannot read the run of a user's model."""
    words = ["--checkpoint"] if command is gates else ["--video", str(folder / "x.webm")] if command is export else []
    assert command.main([*words, str(folder), "--model-module", "models_of_none"]) == 2
    assert "--model-module: expected a Python module that can be imported" in capsys.readouterr().err


def test_a_checkpoint_imports_nothing(folder):
    """Catches a config from a file that runs code: its module is named in the message, and not imported."""
    (folder / "models_of_a_stranger.py").write_text("raise SystemExit('imported')")
    register_schema()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        plain = OmegaConf.to_container(compose("config", ["+exp=mini", "scene=suzanne"]), resolve=True)
    plain["model"] |= {"name": "strange", "module": "models_of_a_stranger"}
    with pytest.raises(InputError, match="'models_of_a_stranger', which a checkpoint cannot import"):
        typed_config(plain, Path("checkpoint.pt"))
    plain["model"]["name"] = "7dgs"
    assert typed_config(plain, Path("checkpoint.pt")).model.module is None

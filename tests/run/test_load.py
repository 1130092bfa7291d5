"""A model comes back from its folder: with the images that it had, and only from a checkpoint of its own."""

from pathlib import Path

import pytest
import torch
from tiny_run import overrides, run_here

import gsbench as package
from gsbench.errors import InputError
from gsbench.measure import record
from gsbench.models.render import render
from gsbench.run.load import load_run
from gsbench.run.setup import load_scene
from gsbench.train import checkpoint
from gsbench.train.checkpoint import Checkpoint


@pytest.fixture(scope="module")
def folder(square: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_here(*overrides(square, tmp_path_factory.mktemp("r"), "model=7dgs", "train.iterations=20"))[1]


def test_the_loaded_model_renders_what_was_measured(folder):
    """Catches a model that comes back without its active components, its background, AGR or lambda."""
    run = package.load_run(folder)
    measured = record.read(folder / record.FILE_NAME)
    scene = load_scene(run.config)
    assert (run.scene.name, run.scene.fingerprint, run.step) == ("square", measured.provenance.data_hash, 20)
    assert (run.scene.width, run.scene.height) == (16, 16)
    for view, score in zip(scene.test, measured.per_view, strict=True):
        image = render(run.model, view.camera, view.time, torch.tensor(run.scene.background))
        mse = (image.clamp(0, 1).double() - view.image.double()).square().mean()
        assert float(-10 * mse.log10()) == pytest.approx(score.psnr, abs=1e-4)


def test_a_folder_without_a_checkpoint_is_refused(tmp_path):
    """Catches a stack trace for a wrong path."""
    for path in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(InputError, match="expected the folder of a run with a checkpoint"):
            load_run(path)


def test_a_checkpoint_whose_config_is_of_another_model_is_refused(folder, tmp_path):
    """Catches parameters of one model that are rendered as another's, and a config that is no config."""
    saved = checkpoint.read(folder / checkpoint.FILE_NAME)
    other = {**saved.config, "agr": False}
    for config, message in ((other, "not of this model"), ({}, "config"), ({**saved.config, "foo": 1}, "foo")):
        checkpoint.save(tmp_path / checkpoint.FILE_NAME, Checkpoint("t", "d", saved.state, config, saved.scene))
        with pytest.raises(InputError, match=message):
            load_run(tmp_path)

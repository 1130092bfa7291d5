"""The folder of a scene is found by the paper's name or by that of the published release."""

from collections.abc import Iterator
from pathlib import Path

import hydra
import pytest
import torch
from omegaconf import OmegaConf
from scenes.tiny_scene import edit, write_tiny

from gsbench.config import CONF, Config, register_schema
from gsbench.errors import InputError
from gsbench.run.checks import scene_folder
from gsbench.run.setup import load_scene


@pytest.fixture(scope="module", autouse=True)
def composer() -> Iterator[None]:
    register_schema()
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        yield


def config(root: Path, scene: str) -> Config:
    """The config of `python -m gsbench +exp=pbr scene=SCENE data.root=ROOT`."""
    composed = hydra.compose("config", ["+exp=pbr", f"scene={scene}", f"data.root={root}"])
    return OmegaConf.to_object(composed)  # type: ignore[return-value]


@pytest.mark.parametrize(
    ("scene", "folder"),
    [("heart1", "heart"), ("heart1", "heart1"), ("heart2", "heart_1600"), ("heart2", "heart2"), ("cloud", "cloud")],
)
def test_either_name_is_found(scene: str, folder: str, tmp_path: Path) -> None:
    """Catches a release as it is downloaded that has to be renamed first, and heart1 taken for the larger heart."""
    for other in ("dust", "heart_800"):
        write_tiny(tmp_path / other)
    write_tiny(tmp_path / folder)
    edit(tmp_path / folder, lambda content: content.update(camera_angle_x=0.5))  # tells it from the others
    loaded = load_scene(config(tmp_path, scene))
    assert loaded.name == folder
    assert (loaded.train[0].camera.width, loaded.train[0].camera.height) == (4, 3)  # half resolution
    assert float(loaded.train[0].camera.K[0, 0]) == pytest.approx(2 / 0.25534, rel=1e-4)  # tan(0.25)


def test_images_are_reduced_by_the_filter_of_the_settings(tmp_path: Path) -> None:
    """Catches a run that trains on images of another filter than its record says."""
    write_tiny(tmp_path / "cloud")
    pillow = config(tmp_path, "cloud")
    pillow.scene.resize = "pillow"
    assert not torch.equal(load_scene(pillow).train[0].image, load_scene(config(tmp_path, "cloud")).train[0].image)


def test_both_hearts_of_a_release_are_told_apart(tmp_path: Path) -> None:
    """Catches the paper's two scenes read from one folder."""
    for folder in ("heart", "heart_1600"):
        write_tiny(tmp_path / folder)
    assert [scene_folder(config(tmp_path, scene)).name for scene in ("heart1", "heart2")] == ["heart", "heart_1600"]


@pytest.mark.parametrize(("scene", "other"), [("heart1", "heart"), ("heart2", "heart_1600")])
def test_a_missing_scene_is_told_by_both_names_in_one_line(scene: str, other: str, tmp_path: Path) -> None:
    """Catches a message that sends a reader of the paper, or of the release, after a folder that is not there."""
    with pytest.raises(InputError) as caught:
        scene_folder(config(tmp_path, scene))
    message = str(caught.value)
    assert f"'{scene}' or '{other}'" in message
    assert f"{tmp_path / scene} and {tmp_path / other}" in message
    assert "gaozhongpai.github.io/7dgs" in message
    assert "\n" not in message


def test_a_scene_of_one_name_is_missing_by_one_name(tmp_path: Path) -> None:
    """Catches "or 'None'" in the message for all other scenes."""
    with pytest.raises(InputError, match="expected a folder 'dust' with"):
        scene_folder(config(tmp_path, "dust"))

"""The scene, the images and the Gaussians that a run starts from are those of its settings, and its record says so."""

import hashlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scenes.test_technicolor import COUNT, HEADER, damage, row
from scenes.tiny_scene import edit, write_tiny
from tiny_run import overrides, run_here, spec_of

from gsbench.config import Config
from gsbench.errors import InputError
from gsbench.run.load import load_run
from gsbench.run.setup import load_scene, scene_folder
from gsbench.scenes.gaussian_ply import TrainedGaussians, ply_of
from gsbench.scenes.technicolor import CAMERAS


def config(root: Path, scene: str) -> Config:
    """The config of `python -m gsbench +exp=pbr scene=SCENE data.root=ROOT`."""
    return spec_of(["+exp=pbr", f"scene={scene}", f"data.root={root}"]).config


@pytest.mark.parametrize(
    ("scene", "folder"),
    [("heart1", "heart"), ("heart1", "heart1"), ("heart2", "heart_1600"), ("heart2", "heart2"), ("cloud", "cloud")],
)
def test_the_scene_has_the_name_of_the_paper_or_of_the_release(scene, folder, tmp_path):
    """Catches a downloaded release that has to be renamed first, and heart1 taken for the larger heart."""
    for other in ("dust", "heart_800"):
        write_tiny(tmp_path / other)
    write_tiny(tmp_path / folder)
    edit(tmp_path / folder, lambda content: content.update(camera_angle_x=0.5))  # unlike the others
    loaded = load_scene(config(tmp_path, scene))
    assert loaded.name == folder
    assert (loaded.train[0].camera.width, loaded.train[0].camera.height) == (4, 3)  # half resolution
    assert float(loaded.train[0].camera.K[0, 0]) == pytest.approx(2 / 0.25534, rel=1e-4)  # tan(0.25)
    pillow = config(tmp_path, scene)
    pillow.scene.resize = "pillow"
    assert not torch.equal(load_scene(pillow).train[0].image, loaded.train[0].image)


@pytest.mark.parametrize(
    ("scene", "names", "tried"),
    [("heart1", "'heart1' or 'heart'", "{0}/heart1 and {0}/heart"), ("dust", "'dust'", "{0}/dust")],
)
def test_a_missing_scene_is_named_as_in_paper_and_release(scene, names, tried, tmp_path):
    """Catches a message that sends a reader of the paper, or of the release, after a folder that is not there."""
    places = tried.format(tmp_path)
    with pytest.raises(InputError, match=rf"a folder {names} with a scene.*looked for {places};.*gaozhongpai\.github"):
        scene_folder(config(tmp_path, scene))


def test_the_record_has_the_protocol(square, tmp_path):
    """Catches images of another filter under a record that is silent about it, and a best on test that is left out."""
    words = overrides(square, tmp_path, "model=dgs", "train.iterations=2", "protocol.pictures=0")
    record, folder = run_here(*words, "protocol=dgs2026")
    assert record.status == "ok", record.reason
    assert record.protocol["resize"] == "pillow"
    assert (record.protocol["name"], record.protocol["quantise"]) == ("dgs2026", True)
    assert record.metrics["psnr_best_on_test"] is not None
    assert "protocol=dgs2026" in folder.parent.name
    plain, other = run_here(*words)
    assert "resize" not in plain.protocol
    assert other != folder
    with pytest.raises(InputError, match=r"scene\.resize"):
        run_here(*words, "scene.resize=pilow")


def test_the_record_names_a_replaced_image(tmp_path):
    """Catches an option that the run does not pass on, and numbers of a repaired scene that look like any other's."""
    folder = tmp_path / "Tiny"
    folder.mkdir()
    (folder / CAMERAS).write_text("\n".join([HEADER, *map(row, range(COUNT))]))
    image = np.random.default_rng(0).integers(0, 256, (12, 14, 3), np.uint8)
    for frame in (3, 4):
        for camera in range(COUNT):
            assert cv2.imwrite(str(folder / f"Tiny_undist_{frame:05d}_{camera:02d}.png"), image)
    words = ["+exp=technicolor", "model=3dgs", "scene=custom", "scene.name=Tiny", "data.initial_points=20"]
    words += ["train.iterations=1", "protocol.pictures=0", f"data.root={tmp_path}", f"results={tmp_path}"]
    protocol = run_here(*words)[0].protocol
    assert "repaired" not in protocol
    assert protocol["resolution"] == "14x12"
    damage(folder, "Tiny_undist_00004_09")
    assert "data.repair=[Tiny_undist_00004_09]" in (run_here(*words)[0].reason or "")
    record, results = run_here(*words, "data.repair=[Tiny_undist_00004_09]")
    assert record.status == "ok", record.reason
    assert record.protocol["repaired"] == "Tiny_undist_00004_09"
    assert record.provenance.config["data"]["repair"] == ["Tiny_undist_00004_09"]
    assert "repair" in results.parent.name


def write_trained(path: Path, count: int = 8, away: int = 0) -> TrainedGaussians:
    """Write Gaussians around the origin, the last `away` of them 500 units above it; return them."""
    g = torch.Generator().manual_seed(0)
    draws = [torch.randn(shape, generator=g) for shape in ((count, 3), (count, 3), (count, 4), (count,), (count, 3))]
    draws[0][count - away :, 1] += 500 / 0.3
    trained = TrainedGaussians(0.3 * draws[0], 0.1 * draws[1] - 1, *draws[2:], torch.zeros(count, 15, 3))
    path.write_bytes(ply_of(trained))
    return trained


@pytest.fixture
def words(square: Path, tmp_path: Path) -> list[str]:
    """The overrides of a run of one step that starts from a.ply."""
    return [*overrides(square, tmp_path / "r", "model=3dgs", "train.iterations=1"), f"+init.ply={tmp_path}/a.ply"]


@pytest.mark.parametrize("model", ["3dgs", "7dgs"])
def test_a_run_starts_from_a_ply(model, words, tmp_path):
    """Catches a file that is read and not used, a record that does not say which, and a run that is done again."""
    trained = write_trained(tmp_path / "a.ply")
    words += [f"model={model}", "model.lr.means.start=1e-6"]  # one step moves means by 1e-6 x extent x sqrt(30,000)
    record, folder = run_here(*words)
    assert record.status == "ok", record.reason
    sha256 = hashlib.sha256((tmp_path / "a.ply").read_bytes()).hexdigest()
    assert record.provenance.config["init"]["ply_sha256"] == sha256
    assert sha256[:8] in folder.parent.name
    means = load_run(folder).model.splats["means"]
    assert len(means) == len(trained)
    assert 0 < (means - trained.means).abs().max() < 1e-3
    assert run_here(*words)[0].provenance.time == record.provenance.time  # finished before, kept


@pytest.mark.parametrize(
    ("count", "away", "more", "reason"),
    [
        (3, 0, "", "at least 4 Gaussians"),
        (8, 0, f"+init.ply_sha256={64 * '0'}", "SHA-256"),
        (8, 8, "", "no training camera sees one of the 8"),
        (8, 0, "+init.ply_sha256=0 init.ply=null", "init.ply_sha256"),
        (8, 6, "", None),
        (8, 3, "", None),
    ],
)
def test_a_ply_that_cannot_be_the_start_is_refused(count, away, more, reason, words, tmp_path, capsys):
    """Catches a refusal without a record, a hash compared with nothing, black images, and few Gaussians in sight."""
    write_trained(tmp_path / "a.ply", count, away)
    record, _ = run_here(*words, *more.split())
    assert record.status == ("failed" if reason else "ok")
    assert (reason or "") in (record.reason or "")
    assert ("the training cameras see 25% of the Gaussians" in capsys.readouterr().err) == (away == 6)


def test_an_endless_file_is_refused(words):
    """Catches a file that is read before the run has a name."""
    with pytest.raises(InputError, match=r"init\.ply='/dev/zero': expected a file, found a device"):
        run_here(*words[:-1], "+init.ply=/dev/zero")

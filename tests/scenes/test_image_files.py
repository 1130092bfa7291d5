"""Images are found by the names that files give them: suffixes, backslashes, links, and what a suffix does not say."""

import shutil

import cv2
import numpy as np
import pytest
from tiny_scene import IMAGES, edit, write_image

from gsbench import scenes
from gsbench.errors import InputError
from gsbench.scenes.files import ImageFinder

SPLITS = ("train", "val", "test")


@pytest.mark.parametrize("suffix", [".jpg", ".JPG", ".jpeg", ".Jpeg", ".png", ".PNG"])
@pytest.mark.parametrize("named", ["", ".jpg", ".png"])
def test_jpegs_of_a_blender_scene(tiny, suffix, named):
    """Catches r_0.jpg.png, a JPEG that is called .png refused, and a suffix left in the names of views."""
    for path in map(tiny.joinpath, IMAGES):
        jpeg = cv2.imencode(".jpg", cv2.imread(str(path), cv2.IMREAD_COLOR))[1].tobytes()
        path.unlink()
        path.with_suffix(suffix).write_bytes(jpeg)
    edit(tiny, lambda c: [f.update(file_path=f["file_path"] + named) for f in c["frames"]], *SPLITS)
    scene = scenes.load(tiny)
    assert [view.name for view in scene.train] == ["train/r_0", "train/r_1"]
    differs = bool(named) and named != suffix
    assert scene.notes == ((f"images of another suffix are read: 4 {suffix} for {named}",) if differs else ())


def test_the_image_that_is_named_comes_first(tiny):
    """Catches another file of that name read in its place, and of two others not the PNG."""
    finder, folder = ImageFinder(tiny), tiny / "train"
    for name in ("x.jpg", "x.PNG", "x.y.jpeg", "z"):
        (folder / name).write_bytes(b"")
    expected = {
        "x.jpg": ("train/x.jpg", "train/x.JPG", "train\\x.jpg", f"{tiny}/train/x.jpg"),
        "x.PNG": ("train/x.PNG", "train/x.png", "train/x", ".\\train\\x", "./train/../train/x"),
        "x.y.jpeg": ("train/x.y",),
        "z": ("train/z",),
        "none.png": ("train/none",),
        "none.jpg": ("train/none.jpg",),
    }
    names = {path: [finder.find(name, "where").name for name in asked] for path, asked in expected.items()}
    assert names == {path: [path] * len(asked) for path, asked in expected.items()}
    read = "1 .jpg for .JPG, 1 .PNG for .png, 3 .PNG for a name of several files"
    assert finder.notes() == [f"images of another suffix are read: {read}"]


def test_names_that_macos_spells_otherwise(tiny):
    """Catches an umlaut of two characters, as macOS writes it, that is not the one of the file of cameras."""
    for split in SPLITS:
        (tiny / split / "r_0.png").rename(tiny / split / "Ku\u0308che.png")
        edit(tiny, lambda c, split=split: c["frames"][0].update(file_path=f"{split}/K\u00fcche.png"), split)
    assert scenes.load(tiny).notes == ()
    for split, kitchen in zip(SPLITS, ("K\u00fcche", "Ku\u0308che", "K\u00fcche"), strict=True):
        (tiny / split).rename(tiny / f"{kitchen} {split}")
        edit(
            tiny,
            lambda c, s=split: [f.update(file_path=f["file_path"].replace(s, f"K\u00fcche {s}")) for f in c["frames"]],
            split,
        )
    assert scenes.load(tiny).notes == ()


def test_images_without_alpha_beside_others_are_told(tiny):
    """Catches test views on the background of the run, and training views on their own."""
    write_image(tiny / "test/r_0.png", np.zeros((6, 8, 3), np.uint8))
    note = "1 of 4 images have no alpha and keep their own background, the others get (1.0, 1.0, 1.0)"
    assert scenes.load(tiny, background=(1.0, 1.0, 1.0)).notes == (note,)


def test_links_of_the_user_are_followed(tiny, tmp_path):
    """Catches images on another disk, or a whole scene there, refused, of another name or of another fingerprint."""
    expected = scenes.load(tiny)
    shutil.move(tiny / "train", tmp_path / "disk")
    (tiny / "train").symlink_to(tmp_path / "disk")
    shutil.move(tiny / "test" / "r_0.png", tmp_path / "elsewhere.png")
    (tiny / "test" / "r_0.png").symlink_to(tmp_path / "elsewhere.png")
    (tmp_path / "linked").symlink_to(tiny)
    linked = scenes.load(tmp_path / "linked")
    assert linked.name == "linked"
    assert linked.fingerprint == expected.fingerprint
    assert [view.name for view in linked.train] == [view.name for view in expected.train]
    assert all((a.image == b.image).all() for a, b in zip(linked.train, expected.train, strict=True))


def test_seconds_are_scaled_over_all_splits(tiny, capsys):
    """Catches seconds refused without a cure, or scaled apart in train and test."""
    for split, seconds in (("train", [0.0, 10.0]), ("val", [2.0]), ("test", [5.0])):
        edit(tiny, lambda c: [f.update(time=s) for f, s in zip(c["frames"], seconds, strict=True)], split)  # noqa: B023
    scene = scenes.load(tiny)
    assert [view.time for view in (*scene.train, *scene.val, *scene.test)] == [0, 1, 0.2, 0.5]
    assert "times: the field 'time', 0 to 10, scaled to [0, 1] over all splits" in capsys.readouterr().err


def test_views_that_splits_share_are_counted(tiny, capsys):
    """Catches a test that is the training, in whole or in part, and images that are alike by chance called shared."""
    assert scenes.load(tiny).notes == ()
    shutil.copy(tiny / "train/r_1.png", tiny / "test/r_0.png")  # the image of another pose
    assert scenes.load(tiny).notes == ()
    shutil.copy(tiny / "transforms_train.json", tiny / "transforms_test.json")
    edit(tiny, lambda c: c["frames"].pop(0), "test")
    (note,) = scenes.load(tiny).notes
    assert note.startswith("1 of 1 views of test are views of train too")
    shutil.copy(tiny / "transforms_test.json", tiny / "transforms_val.json")
    assert len(scenes.load(tiny).notes) == 3
    assert capsys.readouterr().err.count("\n") == 4


def test_two_images_of_one_camera_and_time_are_refused(tiny):
    """Catches contradictory times, and all times equal where the camera moves, which is a still scene."""
    edit(tiny, lambda c: [f.update(time=0.25) for f in c["frames"]], *SPLITS)
    scene = scenes.load(tiny)
    assert not scene.has_time
    assert scene.notes == ("times: none, as all times are 0.25",)
    edit(tiny, lambda c: c["frames"][1].update(transform_matrix=c["frames"][0]["transform_matrix"]))
    with pytest.raises(InputError, match=r"'train/r_0\.png' and 'train/r_1\.png': expected different times"):
        scenes.load(tiny)


def test_a_second_layout_is_not_read_in_silence(tiny):
    """Catches a folder of two layouts of which one is read without a word."""
    (tiny / "transforms.json").write_text("{}")
    assert scenes.load(tiny).notes == ("transforms_train.json is read, and not transforms.json",)


def test_points_beside_a_blender_scene_are_told(tiny):
    """Catches points of one's own that random ones replace in silence."""
    (tiny / "points3d.ply").write_bytes(b"")
    assert scenes.load(tiny).notes == ("points3d.ply is not read: the initial points are random",)

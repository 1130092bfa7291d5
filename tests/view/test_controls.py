"""The controls of a browser, without a page: each changes the picture as it says, and can be undone."""

import re
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from viser import ClientHandle
from visitor import CAMERA, Visitor, free_port, packed, until, update, visit

from gsbench import kernels
from gsbench.errors import InputError
from gsbench.kernels.backends import REFERENCE
from gsbench.run.load import load_run
from gsbench.view import controls
from gsbench.view.controls import ONE, SIDE, WIPE
from gsbench.view.frame import FrameRenderer
from gsbench.view.viewer import Viewer


@pytest.fixture(scope="module")
def viewer(folder: Path, other_folder: Path) -> Iterator[Viewer]:
    viewer = Viewer([load_run(folder), load_run(other_folder)], "localhost", free_port())
    yield viewer
    viewer.stop()


@pytest.fixture
def page(viewer: Viewer) -> Iterator[Visitor]:
    """A browser that shows one image."""
    with visit(viewer) as visitor:
        visitor.set("show", ONE)
        yield visitor


def same(*pictures: np.ndarray) -> bool:
    return all(np.array_equal(picture, pictures[0]) for picture in pictures)


def differ(*pictures: np.ndarray) -> bool:
    return len({picture.tobytes() for picture in pictures}) == len(pictures)


def test_the_clip_is_played_and_time_is_frozen(page, monkeypatch):
    """Catches a slider or a clip without effect, frozen time that goes on, and a clip that starts with a leap."""
    start, end = page.look(), page.set("time", 1.0)
    assert differ(start, end)
    page.set("freeze time", True)
    assert same(page.set("time", 0.0), end)
    assert same(page.set("freeze time", False), start)
    assert same(page.set("time", 7.0), end)  # a browser may send any value
    page.set("time", 0.0)
    monkeypatch.setattr(controls, "PLAYED_S", 1e6)
    page.controls._played_at -= 5e5  # it has stood still for long
    page.connection.send(update(page.control("play"), True))
    until(lambda: page.controls.now > 0)
    moments = [page.controls.now]
    until(lambda: moments.append(page.controls.now) or moments[-1] > moments[0])
    assert moments == sorted(moments)
    assert moments[-1] < 0.1
    page.set("play", False)


def test_controls_whose_names_do_not_suffice_have_hints(page):
    """Catches a control that nothing explains."""
    labels = ("reset", "save image", "freeze time", "freeze direction", "harmonics", "colours", "background")
    assert [label for label in labels if not page.control(label).hint] == []


def test_effects_are_switched_off_and_on(page):
    """Catches a switch without effect or that cannot be undone, and a frozen direction that follows the camera."""
    start = page.look(fov=0.7, image_width=64, image_height=65)
    without_agr = page.set("AGR", False)
    assert same(page.set("AGR", True), start)
    flat = page.set("harmonics", 0)
    assert same(page.set("harmonics", 3), start)
    assert same(page.set("freeze direction", True), start)
    there = {"position": [2, 0, -3.4], "wxyz": [0.966, 0, -0.259, 0], "image_height": 65}
    frozen = page.look(**there)
    assert differ(start, without_agr, flat, frozen, page.set("freeze direction", False))


def test_gaussians_have_the_colours_of_their_classes_or_costs(page, viewer):
    """Catches colours without a legend, a legend that stays, and a wipe elsewhere, of other colours or model."""
    image, legend = page.look(image_height=66), page.controls.legend
    assert legend.content == ""
    classes = page.set("colours", "class")
    assert "refined by AGR" in legend.content
    costs = page.set("colours", "cost")
    assert re.search(r"\d ns", legend.content)
    assert differ(image[40:], classes[40:], costs[40:])  # below the labels
    assert same(page.set("colours", "image"), image)
    assert not page.control("wipe at").visible
    page.set("show", WIPE)
    assert page.control("wipe at").visible
    assert page.control("second model").visible
    page.set("second model", viewer.renderers[0].name)
    wiped = page.set("second colours", "class")
    assert same(page.set("wipe at", 1.0)[40:], image[40:])
    assert same(page.set("wipe at", 0.0)[40:], classes[40:])
    assert same(wiped[40:, :30], image[40:, :30])
    assert same(wiped[40:, 34:], classes[40:, 34:])
    page.set("show", SIDE)
    assert not page.control("wipe at").visible


def test_two_runs_open_side_by_side(viewer):
    """Catches a second run that must be looked for, and two images of one model."""
    with visit(viewer) as page:
        assert page.controls.layout == SIDE
        names = [renderer.name for renderer in viewer.renderers]
        assert [shown.renderer.name for shown in page.controls.shown()] == names
        assert all(name in page.controls.costs.content for name in names)
        picture = page.look(image_width=200, image_height=100)
        assert picture.shape == (100, 200, 3)
        assert differ(picture[60:, :98], picture[60:, 102:])
        page.set("show", WIPE)
        second = page.set("wipe at", 0.0)
        assert same(page.set("AGR", False), second)  # the second model has none
        assert differ(page.set("wipe at", 1.0), page.set("AGR", True), second)


@pytest.mark.skipif(not kernels.available(), reason="the kernels are not built")
def test_the_bound_on_float32_is_shown_when_nothing_moves(page, viewer, monkeypatch):
    """Catches a bound that is not shown or saved, is of another view, or keeps the viewer waiting; a silent refusal."""
    start, legend = page.look(image_height=67), page.controls.legend
    bound = page.set("colours", "float32")
    assert "largest bound" in legend.content
    files: list[bytes] = []
    monkeypatch.setattr(ClientHandle, "send_file_download", lambda _, __, data, **___: files.append(data))
    assert same(page.set("save image", True), bound)
    (data,) = files
    assert same(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1], bound)
    assert differ(start, bound, page.look(position=[0, 0.5, -4], image_height=67))
    released, compute = threading.Event(), FrameRenderer.float32_error

    def slowly(*arguments: Any) -> Any:
        released.wait(20)
        return compute(*arguments)

    monkeypatch.setattr(FrameRenderer, "float32_error", slowly)
    page.connection.send(packed(CAMERA, image_height=67))
    until(lambda: "its bound follows" in legend.content)
    assert same(page.set("colours", "image"), start)  # although the bound is not ready
    assert legend.content == ""
    released.set()
    time.sleep(0.3)
    assert same(page.pictures[-1], start)
    monkeypatch.undo()
    monkeypatch.setattr(viewer.renderers[0].run.model, "backend", REFERENCE)
    page.set("colours", "float32")
    assert "no bound: expected the CPU kernels" in legend.content


def test_the_error_against_the_nearest_training_view_is_shown(page):
    """Catches a view that stays when the camera moves, and an error of another model, effects or background."""
    text = page.controls.comparison

    def captions() -> tuple[str, ...]:
        return (
            re.search(r"<b>(.*?)</b>", text.content)[1],
            *re.findall(r"<figcaption>(.*?)</figcaption>", text.content),
        )

    page.set("nearest training view", True)
    view, truth, model, error = captions()
    assert (truth, model) == ("training image", page.controls.shown()[0].renderer.name)
    assert re.fullmatch(r"[\d.]+ dB", error)
    page.set("background", (0, 200, 0))
    assert captions() == (view, truth, model, error)
    page.set("AGR", False)
    assert captions()[3] != error
    page.set("show", SIDE)
    assert len(captions()) == 1 + 6
    page.look(position=[4, 0, 0], wxyz=[0.7071, 0, -0.7071, 0])
    assert captions()[0] != view


def test_everything_is_brought_back(page):
    """Catches a background without effect, a reset that leaves something as it was, and a background of the training
    that is rounded to 8 bits, or is the first run's in an image of the second."""
    page.set("reset", True)
    assert page.controls.request("image").background is None
    start = page.pictures[-1]
    coloured = page.set("background", (0, 200, 0))
    assert (np.abs(coloured.astype(int) - (0, 200, 0)).max(-1) < 8).any()
    assert same(page.set("background", (0, 300, 0)), page.set("background", (-1, 0, 0)), start)  # a browser may send it
    for label, value in (("time", 1.0), ("show", ONE), ("AGR", False), ("colours", "class"), ("harmonics", 0)):
        page.set(label, value)
    page.browser.client.camera.position = (0.0, 1.0, -5.0)
    assert differ(start, coloured, page.pictures[-1])
    assert same(page.set("reset", True), start)
    assert page.controls.layout == SIDE


def test_the_image_is_saved_as_it_is_shown(viewer, monkeypatch):
    """Catches a file of another size or colours, without a name, two for a double click, and one nobody asked for."""
    files: list[tuple[str, bytes]] = []
    monkeypatch.setattr(ClientHandle, "send_file_download", lambda _, name, data, **__: files.append((name, data)))
    with visit(viewer) as page:
        page.set("show", WIPE)
        shown = page.set("save image", True)
        page.connection.send(update(page.control("save image"), True))
        page.look(image_height=70)
    ((name, data),) = files
    assert name == f"square {' '.join(model.name for model in viewer.renderers)}.png"
    assert same(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1], shown)


def test_training_cameras_are_shown_except_side_by_side(page):
    """Catches frusta that are not there, do not go away, or lie over two images whose cameras are others; and a click
    on one that leaves the camera or the time where they were."""
    handles = page.browser.client.scene._handle_from_node_name

    def visible() -> list[bool]:
        return [handle.visible for name, handle in handles.items() if name.startswith("/training/")]

    page.set("training cameras", True)
    assert visible() == [True] * 6
    page.set("show", SIDE)
    assert visible() == [False] * 6
    assert page.control("training cameras").disabled
    page.set("show", ONE)
    assert visible() == [True] * 6
    (click,) = handles["/training/5"]._impl.click_cb
    click.callback(None)
    until(lambda: page.controls.now == 1.0)
    frustum = handles["/training/5"]
    np.testing.assert_allclose(page.browser.client.camera.position, frustum.position)
    page.set("training cameras", False)
    assert visible() == [False] * 6


def test_two_browsers_have_controls_of_their_own_and_one_may_leave(viewer):
    """Catches a slider that moves everybody's picture, and frames for a browser that is gone."""
    with visit(viewer) as first:
        with visit(viewer) as two:
            start = two.pictures[-1]
            assert differ(first.set("time", 1.0), start)
            assert same(two.pictures[-1], start)
            assert two.controls.now == 0
        until(lambda: len(viewer.browsers) == 1)
        assert differ(first.set("time", 0.5), first.set("time", 0.0))


def test_without_data_there_are_no_cameras_and_runs_of_two_scenes_are_refused(folder, other_folder):
    """Catches a viewer that needs the data set, and models of two scenes under one camera."""
    run, other = load_run(folder), load_run(other_folder)
    run.config.data.root = "/nowhere"
    alone = Viewer([run], "localhost", free_port())
    with visit(alone) as page:
        assert page.controls.layout == ONE
        for label in ("training cameras", "nearest training view"):
            assert page.control(label).disabled
    alone.stop()
    assert "--data-root" in alone.scene
    elsewhere = replace(other, scene=replace(other.scene, fingerprint="0"), folder=Path("elsewhere"))
    with pytest.raises(InputError, match="elsewhere"):
        Viewer([run, elsewhere], "localhost", free_port())

"""The viewer in Chromium: it opens, its controls change the picture, browsers come and go, nobody else can reach it."""

import re
import socket
import threading
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from chromium import launched

from gsbench.errors import InputError
from gsbench.kernels.backends import REFERENCE
from gsbench.run.load import load_run
from gsbench.view.frame import STAGES, FrameRenderer
from gsbench.view.viewer import Viewer

pytestmark = pytest.mark.slow
WIDTH, HEIGHT = 1220, 600
PICTURE = {"x": 0, "y": 170, "width": 560, "height": 430}  # without the controls, and what viser says of WebGL
SHARP = f"x {HEIGHT}"  # of a frame with all pixels


@pytest.fixture(scope="module")
def browser():
    yield from launched("--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def free_port():
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        return probe.getsockname()[1]


@pytest.fixture(scope="module")
def viewer(folder, other_folder):
    viewer = Viewer([load_run(folder), load_run(other_folder)], "localhost", free_port())
    yield viewer
    viewer.stop()


@pytest.fixture
def visit(browser, viewer):
    """Opens the viewer and waits for its picture at rest, of one model; returns the page with what it complained of."""
    contexts = []

    def open_page(viewer=viewer, show="one image"):
        context = browser.new_context(viewport={"width": WIDTH, "height": HEIGHT})
        contexts.append(context)
        page = context.new_page()
        page.viewer, page.complaints, page.asked = viewer, [], []
        page.on("pageerror", lambda error: page.complaints.append(str(error)))
        page.on("request", lambda request: page.asked.append(request.url))
        page.goto(f"http://localhost:{viewer.server.get_port()}")
        settle(page)
        if show is not None:
            choose(page, "show", show)
            settle(page)
        return page

    yield open_page
    for context in contexts:
        context.close()


def settle(page):
    """Wait until everything is rendered with all pixels and has arrived, and return the picture."""
    page.wait_for_selector(f"text={SHARP}", timeout=60_000)
    shown = []
    for _ in range(80):
        page.wait_for_timeout(250)
        rests = all(client.rests and not client.changed.is_set() for client in page.viewer.browsers.values())
        shown = [*shown, page.screenshot(clip=PICTURE)] if rests and page.locator(f"text={SHARP}").count() else []
        if len(shown) > 2 and shown[-1] == shown[-2] == shown[-3]:
            return shown[-1]
    raise AssertionError("the picture does not come to rest")


def control(page, label, kind):
    return page.locator(f"//label[normalize-space()='{label}']/following::input[@type='{kind}'][1]")


def slide(page, label, value):
    field = control(page, label, "text")
    field.fill(str(value))
    field.press("Enter")
    page.wait_for_timeout(300)


def switch(page, label):
    control(page, label, "checkbox").click(force=True)
    page.wait_for_timeout(300)


def choose(page, label, option):
    page.locator(f"//label[normalize-space()='{label}']/following::input[@role='combobox'][1]").click()
    page.get_by_role("option", name=option, exact=True).click()
    page.wait_for_timeout(300)


def turn(page):
    """Drag the camera round."""
    page.mouse.move(450, 300)  # not on what floats above the image
    page.mouse.down()
    page.mouse.move(650, 330, steps=5)
    page.mouse.up()
    page.wait_for_timeout(300)


def test_it_opens_and_stays_on_this_machine(visit, viewer):
    """Catches a page that fails, a request that leaves the machine, and a server that others can reach."""
    page = visit()
    assert page.complaints == []
    foreign = [url for url in page.asked if not re.match(r"data:|(blob:)?(http|ws)://localhost:", url)]
    assert foreign == []
    legend = page.locator("table").first.inner_text()
    numbers = {line.split("\t")[0].strip(): line.split("\t")[-1] for line in legend.splitlines()}
    assert list(numbers) == ["ms", "slice", *STAGES["slice"], "raster", *STAGES["raster"], "FPS"]
    assert numbers.pop("ms") == viewer.renderers[0].name
    assert all(float(number) >= 0 for number in numbers.values())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))  # sends nothing; it tells this machine's own address
        address = probe.getsockname()[0]
    if not address.startswith("127."):
        with pytest.raises(OSError, match="refused"):
            socket.create_connection((address, viewer.server.get_port()), timeout=5)


def test_on_a_phone_the_panel_leaves_the_image_free(browser, viewer):
    """Catches a panel that hides the picture, and controls that a phone cannot reach."""
    context = browser.new_context(viewport={"width": 390, "height": 844})
    page = context.new_page()
    page.goto(f"http://localhost:{viewer.server.get_port()}")
    page.wait_for_selector("text=controls", timeout=60_000)
    deadline = time.monotonic() + 10
    while page.locator("text=gsbench: square").bounding_box()["y"] < 0.7 * 844:  # it unfolds, and folds
        assert time.monotonic() < deadline
        page.wait_for_timeout(100)
    assert not page.locator("text=freeze direction").is_visible()
    page.locator("text=controls").click()
    page.wait_for_selector("text=freeze direction", state="visible", timeout=10_000)
    context.close()


def test_the_clip_is_played_and_time_is_frozen(visit):
    """Catches a slider or a clip without effect, frozen time that goes on, and a picture that stays coarse."""
    page = visit()
    start = settle(page)
    slide(page, "time", 1)
    end = settle(page)
    assert start != end
    switch(page, "freeze time")
    slide(page, "time", 0)
    assert settle(page) == end
    switch(page, "freeze time")
    assert settle(page) == start
    switch(page, "play")
    page.wait_for_timeout(1000)
    switch(page, "play")
    assert control(page, "time", "text").input_value() != "0"
    settle(page)


def test_effects_are_switched_off_and_on(visit):
    """Catches a switch without effect or that cannot be undone, and a frozen direction that follows the camera."""
    page = visit()
    start = settle(page)
    switch(page, "AGR")
    without_agr = settle(page)
    switch(page, "AGR")
    slide(page, "harmonics", 0)
    flat = settle(page)
    slide(page, "harmonics", 3)
    switch(page, "freeze direction")
    assert settle(page) == start
    turn(page)
    frozen = settle(page)
    switch(page, "freeze direction")
    assert len({start, without_agr, flat, frozen, settle(page)}) == 5


def test_gaussians_have_the_colours_of_their_classes_or_costs(visit, viewer):
    """Catches colours that nothing explains, and a legend that stays when the colours are gone."""
    page = visit()
    pictures = [settle(page)]
    classes, costs = (page.get_by_text(re.compile(words)) for words in ("refined by AGR", r"\d ns"))
    for colours, legend, unsaid in (("class", classes, costs), ("cost", costs, classes)):
        choose(page, "colours", colours)
        pictures.append(settle(page))
        assert legend.count()
        assert not unsaid.count()
    choose(page, "colours", "image")
    assert settle(page) == pictures[0]
    choose(page, "show", "wipe")
    choose(page, "second model", viewer.renderers[0].name)
    assert settle(page) != pictures[0]  # but for the line of the wipe the same
    slide(page, "wipe at", 1)
    assert settle(page) == pictures[0]
    choose(page, "second colours", "class")
    assert settle(page) == pictures[0]
    slide(page, "wipe at", 0)
    assert settle(page) == pictures[1]
    choose(page, "second colours", "image")
    assert settle(page) == pictures[0]
    assert not classes.count() + costs.count()
    assert len(set(pictures)) == 3


def test_the_bound_on_float32_is_shown_when_nothing_moves(visit, viewer, monkeypatch):
    """Catches a bound that is not shown, is left of another view, or keeps the viewer waiting; and a silent refusal."""
    page = visit()
    start, legend = settle(page), page.get_by_text(re.compile("Bound on the error"))
    choose(page, "colours", "float32")
    bound = settle(page)
    assert page.get_by_text("largest bound").count()
    turn(page)
    assert len({start, bound, settle(page)}) == 3
    released, compute = threading.Event(), FrameRenderer.float32_error

    def slowly(renderer, camera, request):
        released.wait(60)
        return compute(renderer, camera, request)

    monkeypatch.setattr(FrameRenderer, "float32_error", slowly)
    turn(page)
    page.wait_for_selector("text=its bound follows", timeout=20_000)
    choose(page, "colours", "image")
    plain = settle(page)  # although the bound is not ready
    assert not legend.count()
    released.set()
    page.wait_for_timeout(1000)
    assert settle(page) == plain
    monkeypatch.undo()
    monkeypatch.setattr(viewer.renderers[0].run.model, "backend", REFERENCE)
    choose(page, "colours", "float32")
    settle(page)
    assert page.get_by_text("no bound: expected the CPU kernels").count() == 1


def nearest(page):
    """The name of the nearest training view, and the captions of its images."""
    settle(page)
    return page.locator("b").first.inner_text(), page.locator("figcaption").all_inner_texts()


def test_the_error_against_the_nearest_training_view_is_shown(visit, viewer):
    """Catches a view that stays when the camera moves on, and an error of another model or of other effects."""
    page = visit()
    switch(page, "nearest training view")
    view, (truth, model, error) = nearest(page)
    assert (truth, model) == ("training image", viewer.renderers[0].name)
    assert re.fullmatch(r"[\d.]+ dB", error)
    switch(page, "AGR")
    assert nearest(page)[1][2] != error
    choose(page, "show", "side by side")
    assert len(nearest(page)[1]) == 6
    for _ in range(6):
        turn(page)
        if nearest(page)[0] != view:
            break
    else:
        raise AssertionError(f"{view} is nearest from everywhere")


def test_two_runs_open_side_by_side(visit, viewer):
    """Catches a second run that must be looked for, a half without its label, and two images of one model."""
    page = visit(show=None)
    choice = page.locator("//label[normalize-space()='show']/following::input[@role='combobox'][1]")
    assert choice.input_value() == "side by side"
    names = page.locator("table").first.inner_text().splitlines()[0].split("\t")[1:]
    assert [name.strip() for name in names] == [renderer.name for renderer in viewer.renderers]
    image = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    width = page.evaluate("[...document.querySelectorAll('canvas')].at(-1).clientWidth")
    left, right = image[:, : width // 2], image[:, width - width // 2 : width]
    assert (left[HEIGHT // 4 :] != right[HEIGHT // 4 :]).any()
    for label in (left[:40, -60:], right[:40, :60]):
        assert label.min() < 100
        assert label.max() > 200
    choose(page, "show", "wipe")
    slide(page, "wipe at", 0)
    second = settle(page)
    switch(page, "AGR")
    assert settle(page) == second  # the second model has none
    slide(page, "wipe at", 1)
    first = settle(page)
    switch(page, "AGR")
    assert len({first, second, settle(page)}) == 3
    assert page.complaints == []


def test_a_sharp_screen_gets_all_its_pixels(browser, viewer):
    """Catches an image of half the pixels of the screen, and an address whose words are lost or mean nothing."""
    context = browser.new_context(viewport={"width": 900, "height": 500}, device_scale_factor=2)
    page = context.new_page()
    page.goto(f"http://localhost:{viewer.server.get_port()}/?initialCameraFov=0.5")
    page.wait_for_selector("text=x 1000", timeout=60_000)
    assert "fixedDpr=2" in page.url
    assert "initialCameraFov=0.5" in page.url
    page.goto(page.url.replace("fixedDpr=2", "fixedDpr=0.5"))
    page.wait_for_selector("text=x 250", timeout=60_000, state="attached")  # in a folder, as the image is narrow
    context.close()


def test_the_background_is_chosen_and_everything_is_brought_back(visit):
    """Catches a background without effect, one that changes an error, and a reset that leaves something as it was."""
    page = visit(show=None)
    start = settle(page)
    switch(page, "nearest training view")
    view = nearest(page)
    field = page.locator("//label[normalize-space()='background']/following::input[1]")
    field.fill("rgb(0, 200, 0)")
    field.press("Enter")
    page.wait_for_timeout(300)
    assert nearest(page) == view
    switch(page, "nearest training view")
    page.keyboard.press("Escape")
    coloured = settle(page)
    image = cv2.imdecode(np.frombuffer(coloured, np.uint8), cv2.IMREAD_COLOR)
    assert (np.abs(image.astype(int) - (0, 200, 0)).max(-1) < 8).any()
    slide(page, "time", 1)
    turn(page)
    choose(page, "show", "one image")
    switch(page, "AGR")
    assert settle(page) not in (start, coloured)
    page.get_by_role("button", name="reset", exact=True).click()
    assert settle(page) == start


def test_the_image_is_saved_as_it_is_shown(visit, viewer):
    """Catches a file of another size or of other colours, and one without a name."""
    page = visit(show="wipe")
    shown = cv2.imdecode(np.frombuffer(settle(page), np.uint8), cv2.IMREAD_COLOR)
    with page.expect_download() as download:
        page.get_by_role("button", name="save image").click()
    assert download.value.suggested_filename == f"square {' '.join(model.name for model in viewer.renderers)}.png"
    image = cv2.imread(str(download.value.path()))
    left, top, width, height = PICTURE.values()
    width_of_window = page.evaluate("[...document.querySelectorAll('canvas')].at(-1).clientWidth")
    assert image.shape == (HEIGHT, width_of_window, 3)
    inside = image[top : top + height, left : left + width]
    assert np.abs(inside.astype(int) - shown).mean() < 2  # of JPEG


def test_training_cameras_are_shown_except_side_by_side(visit):
    """Catches frusta that are not there, do not go away, or lie over two images whose cameras are others."""
    page = visit()
    start = settle(page)
    switch(page, "training cameras")
    page.wait_for_timeout(1000)
    shown = settle(page)
    choose(page, "show", "side by side")
    beside = settle(page)
    assert control(page, "training cameras", "checkbox").is_disabled()
    choose(page, "show", "one image")
    assert settle(page) == shown
    switch(page, "training cameras")
    assert settle(page) == start != shown
    choose(page, "show", "side by side")
    assert settle(page) == beside


def test_two_browsers_have_controls_of_their_own_and_one_may_leave(visit, viewer):
    """Catches a slider that moves everybody's picture, and frames for a browser that is gone."""
    first, two = visit(), visit()
    assert len(viewer.browsers) == 2
    start = settle(two)
    slide(first, "time", 1)
    assert settle(first) != start
    assert settle(two) == start
    first.close()
    deadline = time.monotonic() + 40
    while len(viewer.browsers) > 1:
        assert time.monotonic() < deadline, "the browser that left is still served"
        time.sleep(0.2)
    slide(two, "time", 1)
    assert settle(two) != start


def test_without_data_there_are_no_cameras_and_runs_of_two_scenes_are_refused(folder, other_folder, visit):
    """Catches a viewer that needs the data set, and models of two scenes under one camera."""
    run, other = load_run(folder), load_run(other_folder)
    run.config.data.root = "/nowhere"
    alone = Viewer([run], "localhost", free_port())
    page = visit(alone)
    for label in ("training cameras", "nearest training view"):
        assert control(page, label, "checkbox").is_disabled()
    alone.stop()
    assert "--data-root" in alone.scene
    elsewhere = replace(other, scene=replace(other.scene, fingerprint="0"), folder=Path("elsewhere"))
    with pytest.raises(InputError, match="elsewhere"):
        Viewer([run, elsewhere], "localhost", free_port())

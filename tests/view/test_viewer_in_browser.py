"""The viewer in Chromium: it opens, a control changes the picture, a phone can use it, nobody else can reach it."""

import re
import socket
import time

import cv2
import numpy as np
import pytest
from chromium import launched
from visitor import free_port

from gsbench.run.load import load_run
from gsbench.view.frame import STAGES
from gsbench.view.viewer import Viewer

pytestmark = pytest.mark.slow
WIDTH, HEIGHT = 1220, 600
PICTURE = {"x": 0, "y": 170, "width": 560, "height": 430}  # without the controls, and what viser says of WebGL
SHARP = f"x {HEIGHT}"  # of a frame with all pixels


@pytest.fixture(scope="module")
def browser():
    yield from launched("--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@pytest.fixture(scope="module")
def viewer(folder):
    viewer = Viewer([load_run(folder)], "localhost", free_port())
    yield viewer
    viewer.stop()


@pytest.fixture
def visit(browser, viewer):
    """Opens the viewer and waits for its picture at rest; returns the page with what it complained of."""
    contexts = []

    def open_page():
        contexts.append(browser.new_context(viewport={"width": WIDTH, "height": HEIGHT}))
        page = contexts[-1].new_page()
        page.viewer, page.complaints, page.asked = viewer, [], []
        page.on("pageerror", lambda error: page.complaints.append(str(error)))
        page.on("request", lambda request: page.asked.append(request.url))
        page.goto(f"http://localhost:{viewer.server.get_port()}")
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


def test_a_slider_changes_the_picture_which_is_saved_as_it_is_shown(visit, viewer):
    """Catches a control that the page does not send, and a file of another size or of other colours."""
    page = visit()
    start = settle(page)
    field = page.locator("//label[normalize-space()='time']/following::input[@type='text'][1]")
    field.fill("1")
    field.press("Enter")
    page.wait_for_timeout(300)
    assert settle(page) != start
    shown = cv2.imdecode(np.frombuffer(settle(page), np.uint8), cv2.IMREAD_COLOR)
    with page.expect_download() as download:
        page.get_by_role("button", name="save image").click()
    assert download.value.suggested_filename == f"square {viewer.renderers[0].name}.png"
    image = cv2.imread(str(download.value.path()))
    left, top, width, height = PICTURE.values()
    width_of_window = page.evaluate("[...document.querySelectorAll('canvas')].at(-1).clientWidth")
    assert image.shape == (HEIGHT, width_of_window, 3)
    inside = image[top : top + height, left : left + width]
    assert np.abs(inside.astype(int) - shown).mean() < 2  # of JPEG


def test_a_sharp_screen_gets_two_pixels_a_side(browser, viewer):
    """Catches an image of half or of all the pixels of a phone, and an address whose words are lost or mean nothing."""
    context = browser.new_context(viewport={"width": 900, "height": 500}, device_scale_factor=3)
    page = context.new_page()
    page.goto(f"http://localhost:{viewer.server.get_port()}/?initialCameraFov=0.5")
    page.wait_for_selector("text=x 1000", timeout=60_000)
    assert "fixedDpr=2" in page.url
    assert "initialCameraFov=0.5" in page.url
    page.goto(page.url.replace("fixedDpr=2", "fixedDpr=0.5"))
    page.wait_for_selector("text=x 250", timeout=60_000, state="attached")  # in a folder, as the image is narrow
    context.close()

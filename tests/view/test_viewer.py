"""A browser of the viewer without a network: resolution, camera, the order of frames, one thread for all browsers."""

import math
import threading
from concurrent.futures import Future
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from test_viewer_frame import camera_of, renderer

from gsbench.view.__main__ import main
from gsbench.view.controls import ONE, SIDE, WIPE, ViserPose
from gsbench.view.viewer import LEAST_PIXELS, MOST_PIXELS, MOVING_MS, Browser, Resolution


def test_resolution_falls_while_the_camera_moves():
    """Catches a large window that stutters, a frame at rest that stays coarse, and a size of zero."""
    resolution = Resolution(MOVING_MS)
    for _ in range(3):  # 1 us a pixel and 10 ms a slice: 30,000 pixels
        width, height = resolution.size(1000, 500, limited=True)
        resolution.took(width * height, 10.0, width * height / 1000)
    assert width * height == pytest.approx(1000 * (MOVING_MS - 10), rel=0.02)
    assert width / height == pytest.approx(2, rel=0.02)
    assert resolution.size(1000, 500, limited=False) == (1000, 500)
    width, height = resolution.size(8000, 4000, limited=False)
    assert width * height == pytest.approx(MOST_PIXELS, rel=0.01)
    resolution.took(100, 500.0, 900.0)
    width, height = resolution.size(1000, 500, limited=True)
    assert width * height == pytest.approx(LEAST_PIXELS, rel=0.02)
    assert min(resolution.size(1, 3000, limited=True)) >= 1


def test_a_browsers_camera_is_ours():
    """Catches a pose that is inverted, mirrored or with the horizontal field of view."""
    camera = replace(camera_of(0.7, renderer()), width=60, height=40)
    camera.K[0, 2], camera.K[1, 2] = 30, 20
    pose = ViserPose.of(camera)
    w, x, y, z = pose.wxyz
    assert w * w + x * x + y * y + z * z == pytest.approx(1)
    forward = 2 * np.array([x * z + w * y, y * z - w * x, 0.5 - x * x - y * y])  # third column of the rotation
    np.testing.assert_allclose(forward, camera.viewmat[2, :3], atol=1e-6)
    assert math.tan(pose.fov / 2) == pytest.approx(20 / float(camera.K[1, 1]))
    again = pose.camera(60, 40)
    torch.testing.assert_close(again.viewmat, camera.viewmat, atol=1e-5, rtol=0)
    torch.testing.assert_close(again.K, camera.K)


def browser_of(renderer: Any, layout: str) -> Browser:
    """A browser without a connection, whose camera looks along z."""
    browser: Any = object.__new__(Browser)
    camera = SimpleNamespace(position=np.array([0, 0, -4]), wxyz=np.array([1, 0, 0, 0]), fov=0.7)
    browser.client = SimpleNamespace(camera=camera)
    browser.controls = SimpleNamespace(layout=layout)
    browser._viewer = SimpleNamespace(renderers=[renderer])
    return browser  # type: ignore[no-any-return]


@pytest.mark.parametrize("window", [(1200, 900), (900, 1200), (2400, 600), (390, 844)])
@pytest.mark.parametrize("size", [(16, 16), (32, 18), (18, 32)])
def test_each_half_shows_the_whole(window, size):
    """Catches a half that is cut at its sides, pixels that are not square, and another camera for one whole image."""
    shown = SimpleNamespace(run=SimpleNamespace(scene=SimpleNamespace(width=size[0], height=size[1])))
    width, height = window[0] // 2, window[1]
    camera = browser_of(shown, SIDE)._camera(width, height)
    corners = torch.tensor([[x * size[0] / size[1], y] for x in (-1, 1) for y in (-1, 1)])  # of what 0.7 radians see
    pixels = torch.cat([np.tan(0.35) * corners, torch.ones(4, 1)], 1).double() @ camera.K.double().T
    assert float(pixels.min()) >= -1e-3
    right, bottom = width - float(pixels[:, 0].max()), height - float(pixels[:, 1].max())
    assert min(right, bottom) == pytest.approx(0, abs=1e-2)  # no smaller
    assert camera.K[0, 0] == camera.K[1, 1]
    for layout in (ONE, WIPE):
        whole = browser_of(shown, layout)._camera(*window)
        assert float(whole.K[1, 1]) == pytest.approx(window[1] / 2 / math.tan(0.35))


class Steps(Browser):
    """A browser without a connection that lists what it would render."""

    def __init__(self) -> None:
        self.done: list[str] = []
        self.changed, self.rests, self._bound, self._saves = threading.Event(), True, None, False
        self._viewer: Any = SimpleNamespace(wake=threading.Event(), scene="no data set")
        self.controls: Any = SimpleNamespace(
            costs=SimpleNamespace(content=""),
            play=SimpleNamespace(value=False),
            compare=SimpleNamespace(value=False),
            shows_float32=True,
            advance=lambda: self.done.append("advance"),
        )

    def _show(self, *, limited: bool) -> Any:
        self.done.append("limited" if limited else "whole")

    def _show_bound(self, *_: Any) -> None:
        self.done.append("bound")


def test_frames_come_in_order(monkeypatch):
    """Catches a frame of all pixels while something moves, a bound that is kept after a change, a busy wait, and an
    error of one model that stops the frames of all browsers."""
    now = 0.0
    monkeypatch.setattr("gsbench.view.viewer.time.monotonic", lambda: now)
    browser = Steps()
    bound: Future[Any] = Future()
    browser._viewer.bounds = SimpleNamespace(submit=lambda *_: bound)
    assert browser.serve() == math.inf
    browser.change()
    assert 0 < browser.serve() < 1
    assert browser.done == ["advance", "limited"]
    assert 0 < browser.serve() < 1  # something may still move
    now = 1.0
    assert browser.serve() == math.inf
    assert browser.serve() == math.inf  # the bound is not ready
    assert not browser.rests
    assert browser.done[2:] == ["whole"]
    bound.set_result((None, {}))
    browser.serve()
    assert browser.rests
    assert browser.done[3:] == ["bound"]
    now, bound = 2.0, Future()
    browser.change()
    browser.serve()
    now = 3.0
    browser.serve()
    browser.change()
    browser.serve()
    assert bound.cancelled()
    browser.change()  # of a user's model
    browser.controls.advance = lambda: (_ for _ in ()).throw(TypeError("a <bad> model"))
    assert browser.serve() == math.inf
    assert browser.controls.costs.content == "a &lt;bad&gt; model"


def test_a_wrong_command_is_answered_in_one_line(folder, tmp_path, capsys):
    """Catches a stack trace, a server that serves nothing, a wait for a port without end, and "" open to everybody."""
    hosts = ("no.such.host.invalid", "", "\0", "a" * 300, "192.0.2.1", "\x1b[31m", "1.2.3.4.5", "é..x")
    wrong = [
        ([str(tmp_path)], f"{tmp_path}: expected the folder of a run"),
        ([str(folder), "--port", "0"], "--port"),
        ([str(folder), "--page", "a.html", "--port", "9"], "--port: expected none with --page"),
        *(([str(folder), "--host", host], "--host") for host in hosts),
    ]
    for words, text in wrong:
        assert main(words) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("gsbench.view: ")
        assert text in line
        assert line.isprintable()
        assert len(line) < 400

"""Timing and the curve: what is timed, what is waited for, what a resumed run continues."""

import os
import time

import numpy as np
import pytest
import torch

from gsbench.errors import InputError
from gsbench.measure import speed
from gsbench.measure.curve import Curve, Point


@pytest.fixture
def clock(monkeypatch):
    """A clock that stands still unless seconds are added to its only entry."""
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    return now


def test_render_times_are_percentiles_after_warm_up(clock):
    """Catches warm-up in the figures or of one view, wrong percentiles, and an FPS of the mean."""
    costs = iter([100.0] * 5 + list(range(1, 32)))  # warm-up is slow, then 1..31 ms
    rendered = []

    def render(i: int) -> None:
        rendered.append(i)
        clock[0] += next(costs) / 1000

    (times,) = speed.time_in_turns([render], count=31)
    assert (times.p10, times.p50, times.p90) == pytest.approx((4, 16, 28))
    assert times.fps == pytest.approx(1000 / 16)
    assert rendered == [*range(26, 31), *range(31)]


def test_the_device_is_waited_for_inside_the_timed_region():
    """Would catch unsynchronised timing, which reports how fast work is queued rather than done."""
    events: list[str] = []
    speed.time_in_turns([lambda i: events.append(f"render {i}")], 30, lambda: events.append("wait"))
    assert events[3 * speed.WARM_UP :] == [event for i in range(30) for event in ("wait", f"render {i}", "wait")]


def test_stages_survive_a_resume_and_do_not_nest(clock):
    """Would catch a resumed run whose stages start at zero, a stage whose time is lost when its body raises, and
    seconds counted twice, so that stage_s adds up to more than train_s."""

    def work(stages, name, error=None):
        with stages(name):
            clock[0] += 1
            if error is not None:
                raise error

    stages, resumed = speed.StageClock(), speed.StageClock()
    for name in ("slice", "raster", "slice"):
        work(stages, name)
    with pytest.raises(KeyError):
        work(stages, "loss", KeyError())
    assert stages.seconds == {"slice": 2.0, "raster": 1.0, "loss": 1.0}
    resumed.load_state_dict(stages.state_dict())
    work(resumed, "slice")
    assert (resumed.seconds["slice"], stages.seconds["slice"]) == (3.0, 2.0)
    with pytest.raises(InputError, match="'b' was opened inside 'a'"), stages("a"), stages("b"):
        pass
    work(stages, "b")  # and the refusal does not leave "a" open


def test_effort_adds_up_and_survives_a_resume(monkeypatch):
    """Would catch a load that each block sets anew, blocks that count alike however long, and CPU-seconds that a resume
    or the screen before a training loses."""
    wall, cpu = iter([0.0, 1.0, 10.0, 13.0, 20.0, 21.0]), iter([5.0, 7.0, 50.0, 51.0, 60.0, 60.5])
    loads = iter([2.0, 4.0, 1.0])
    monkeypatch.setattr(time, "perf_counter", lambda: next(wall))
    monkeypatch.setattr(time, "process_time", lambda: next(cpu))
    monkeypatch.setattr(os, "getloadavg", lambda: (next(loads), 0.0, 0.0))
    effort, screen = speed.Effort(), speed.Effort()
    assert effort.load is None
    for _ in range(2):  # 1 s of 2 CPUs under a load of 2, 3 s under one of 4
        with effort:
            pass
    assert (effort.cpu_s, effort.load) == (3.0, 3.5)
    with screen:
        pass
    effort.add(screen)
    resumed = speed.Effort()
    resumed.load_state_dict(effort.state_dict())
    assert (resumed.cpu_s, resumed.load) == (3.5, pytest.approx(15 / 5))


@pytest.mark.parametrize("fault", [AttributeError, OSError])
def test_an_effort_that_is_not_known_is_none(fault, monkeypatch):
    """Would catch a system without loads that ends the training, and half of a training's seconds given as all."""

    def silent():
        raise fault

    monkeypatch.setattr(os, "getloadavg", silent)
    effort = speed.Effort()
    with effort:
        pass
    assert effort.load is None
    assert effort.cpu_s is not None
    effort.load_state_dict({"seconds": 1.0, "cpu_s": float("inf"), "load_s": float("inf")})  # which no record holds
    with effort:
        pass
    assert (effort.cpu_s, effort.load) == (None, None)


def test_laps_are_all_of_the_time(clock):
    """Would catch time between two stages that counts for neither, and a stage that comes again and starts anew."""
    stages = speed.StageClock()
    stages.start()
    for name, seconds in (("slice", 1.0), ("raster", 2.0), ("slice", 4.0), ("loss", 8.0)):
        clock[0] += seconds
        stages.lap(name)
    assert list(stages.seconds.items()) == [("slice", 5.0), ("raster", 2.0), ("loss", 8.0)]


def test_stages_wait_for_no_device_until_they_are_read(monkeypatch):
    """Would catch a GPU that is waited for at every stage, and a stage that is lost or charged to another meanwhile."""
    waits, done = [], 0

    class Event:  # of a device that is late: it passes events only when it is waited for, or told to
        count = 0

        def __init__(self, enable_timing):
            assert enable_timing

        def record(self, stream):
            Event.count += 1
            self.number = Event.count

        def query(self):
            return self.number <= done

        def synchronize(self):
            waits.append(self.number)

        def elapsed_time(self, end):
            return 1000.0 * (end.number - self.number)

    monkeypatch.setattr(torch.cuda, "Event", Event)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda _: None)
    stages = speed.StageClock("cuda")
    for name in ("slice", "raster", "slice"):
        with stages(name):
            pass
    assert waits == []
    done = 4  # the first two stages; the next to end adds them up
    with stages("loss"):
        pass
    assert waits == [2, 4]  # which have passed
    assert stages.seconds == {"slice": 2.0, "raster": 1.0, "loss": 1.0}
    assert waits == [2, 4, 6, 8]


def test_workers_share_the_time_they_took_together():
    """Would catch training minutes that are those of all threads added up, and stages that lose what they had."""
    stages = speed.StageClock()
    stages.load_state_dict({"slice": 1.0, "density": 0.5})
    stages.share([{"slice": 1.0, "raster": 3.0}, {"raster": 2.0, "loss": 2.0}], 4.0)  # 8 s of two workers in 4
    assert stages.seconds == pytest.approx({"slice": 1.5, "density": 0.5, "raster": 2.5, "loss": 1.0})
    stages.share([{}, {}], 1.0)  # of no stage: nothing is divided by zero, and nothing is lost
    assert stages.seconds[speed.OTHER] == 1.0
    assert sum(stages.seconds.values()) == pytest.approx(6.5)


def test_stages_add_up_to_the_wall_clock(clock):
    """Catches work between stages that none has, work of threads that counts twice, and time outside of `running`."""

    def work(seconds):
        clock[0] += seconds

    stages = speed.StageClock()
    for _ in range(2):
        with stages.running():
            work(0.1)
            with stages("loss"):
                work(1.0)
            work(0.2)
            with stages.side_by_side(2) as clocks:
                for worker in clocks:
                    with worker("raster"):
                        work(2.0)
                work(0.5)
            work(0.3)
            with stages("loss"):
                work(0.5)
            work(0.4)
        work(100.0)
    assert stages.seconds == pytest.approx({"other": 2.0, "loss": 3.0, "raster": 9.0})
    with stages("gate"):  # after the loop
        work(7.0)
    assert sum(stages.seconds.values()) == pytest.approx(21.0)


def test_peak_memory_sees_an_allocation_and_can_start_anew():
    """Would catch kilobytes taken for bytes, and a run that reports the peak of an earlier one in its process."""
    speed.reset_peak_memory()
    before = speed.peak_memory()
    block = np.ones(200 * 2**20, np.uint8)
    high = speed.peak_memory()
    assert high - before > 150 * 2**20
    assert high < 2**40
    del block
    speed.reset_peak_memory()
    assert speed.peak_memory() < high - 100 * 2**20


def test_a_gpu_is_waited_for(monkeypatch):
    """Would catch frames of a GPU that are timed while they are still queued, and another device that is waited for."""
    waited = []
    monkeypatch.setattr(torch.cuda, "synchronize", waited.append)
    for device in ("cpu", "cuda", "cuda:1"):
        speed.synchroniser(device)()
    assert waited == ["cuda", "cuda:1"]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")
def test_on_a_gpu_the_stage_that_caused_the_work_pays_for_it():
    """Would catch a missing synchronisation: queueing 200 large products takes far less time than doing them."""
    a = torch.rand(4096, 4096, device="cuda")
    stages = speed.StageClock("cuda")
    speed.reset_peak_memory("cuda")
    with stages("warm"):
        a @ a
    start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
    with stages("products"):
        start.record()
        for _ in range(200):
            a @ a
        end.record()
    with stages("nothing"):
        pass
    assert stages.seconds["products"] >= start.elapsed_time(end) / 1000
    assert stages.seconds["nothing"] < stages.seconds["products"] / 10
    assert speed.peak_memory("cuda") >= 4096 * 4096 * 4


def test_the_curve_answers_best_and_last(tmp_path):
    """Would catch a best that NaN wins, a resume that adds
    points twice, and a state that weights_only=True refuses to load."""
    curve, resumed = Curve(), Curve()
    assert curve.best is curve.last is None
    for iteration, seconds, psnr in ((100, 1.0, 20.0), (200, 2.0, 24.0), (300, 3.0, float("nan")), (400, 4.0, 24.0)):
        curve.add(iteration, seconds, psnr)
    assert curve.best == curve.last == Point(400, 4.0, 24.0)  # of equal ones the last
    assert curve.points[2].psnr_val is None
    torch.save(curve.state_dict(), tmp_path / "state.pt")
    resumed.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert resumed.points == curve.points
    for iteration, seconds in ((400, 5.0), (500, 3.5)):
        with pytest.raises(InputError, match="checkpoint"):
            resumed.add(iteration, seconds, 21.0)


def test_progress_tells_seconds_and_the_change_on_val():
    """Would catch a change against another point than the one before, and a number where none was measured."""
    curve = Curve()
    assert curve.progress == "val not measured yet"
    curve.add(100, 3.4, 24.0)
    assert curve.progress == "3 s of training, val 24.00 dB"
    curve.add(200, 11.6, 24.4)
    curve.add(300, 20.0, 24.15)
    assert curve.progress == "20 s of training, val 24.15 dB (-0.25)"
    curve.add(400, 31.0, float("nan"))
    assert curve.progress == "31 s of training, val -"
    curve.add(500, 40.0, 25.0)
    assert curve.progress == "40 s of training, val 25.00 dB"

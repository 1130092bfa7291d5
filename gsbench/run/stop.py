"""End a run at the end of its step when the process is told to: SIGINT, SIGTERM, and Slurm's SIGUSR2."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR2)


class Stopped(BaseException):  # like KeyboardInterrupt: not an error, and no handler of errors takes it
    """The process was told to end, and the run has saved what it had."""

    def __init__(self, number: int, message: str) -> None:
        super().__init__(message)
        self.code = 128 + number  # the exit status by which a shell knows the signal


def stop_at_once(number: int, _: FrameType | None) -> None:
    """Handle a signal where nothing is to be saved, by raising Stopped."""
    raise Stopped(number, f"stopped by {signal.Signals(number).name}")


class Request:
    """Whether a signal has asked the run to end, and which."""

    def __init__(self) -> None:
        self.signal: int | None = None
        self._before: dict[int, Any] = {}

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if self.signal is not None:  # asked for the second time: what was there before decides, mostly to end at once
            self.hand_on(number, frame)
        self.signal = number

    def hand_on(self, number: int, frame: FrameType | None = None) -> None:
        """Let the handler that was there before act: submitit's puts a job back into Slurm's queue at SIGUSR2."""
        before = self._before.get(number)
        if callable(before):
            before(number, frame)
        elif before == signal.SIG_DFL:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)


@contextmanager
def requested() -> Iterator[Request]:
    """Note signals while the block runs, which looks at the request between two steps; then as before.

    Only the main thread of a process may set handlers; elsewhere nothing is ever requested.
    """
    request = Request()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return
    for number in SIGNALS:
        before = signal.getsignal(number)
        if before == signal.SIG_IGN or (number == signal.SIGUSR2 and before == signal.SIG_DFL):
            continue  # a shell's background process ignores SIGINT; SIGUSR2 is a request only where submitit listens
        request._before[number] = signal.signal(number, request._ask)
    try:
        yield request
    finally:
        for noted, before in request._before.items():
            signal.signal(noted, before)

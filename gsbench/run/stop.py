"""Stop a run after the current step when the process gets a signal: SIGINT, SIGTERM, SIGHUP or Slurm's SIGUSR2."""

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from gsbench.errors import one_line

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR2)  # Slurm sends the last before a time limit
# Seconds after a signal in which others count as the same request. A terminal, `timeout`, systemd and the first process
# of a sweep each signal a process that may have got the signal already.
SAME_REQUEST = 2.0
_asked = -SAME_REQUEST  # when the first signal of the present request came, by time.monotonic


class Stopped(BaseException):  # like KeyboardInterrupt, so that `except Exception` does not catch it
    """A signal asked the process to end, and the run has saved its state."""

    def __init__(self, number: int, message: str | None = None) -> None:
        super().__init__(message or f"stopped by {signal.Signals(number).name}")
        self.number = number
        self.code = 128 + number  # the exit status of a process that a signal ended


def listen() -> None:
    """Let signals that ask the process to end raise Stopped, except those that it ignores, such as after `nohup`."""
    for number in SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, stop_at_once)


def stop_at_once(number: int, _: FrameType | None) -> None:
    """Handle a signal outside of training, when nothing has to be saved, by raising Stopped."""
    if _is_new():
        raise Stopped(number)


def _is_new() -> bool:
    """Return whether a signal that came just now is a new request to end."""
    global _asked  # signal handlers belong to the process, and so does this
    now = time.monotonic()
    if now - _asked < SAME_REQUEST:
        return False
    _asked = now
    return True


class Request:
    """The signal, if any, that asks the run to end."""

    def __init__(self) -> None:
        self.signal: int | None = None
        self._before: dict[int, Any] = {}

    def _ask(self, signal_number: int, frame: FrameType | None) -> None:
        """Handle a signal: the first is noted, one of a second request is left to the handler from before."""
        if self.signal is None:
            _is_new()  # remembers the time
            self.signal = signal_number
        elif time.monotonic() - _asked >= SAME_REQUEST:  # that handler usually ends the process
            before = self._before.get(signal_number)
            if callable(before):
                before(signal_number, frame)
            elif before == signal.SIG_DFL:
                signal.signal(signal_number, signal.SIG_DFL)
                signal.raise_signal(signal_number)


@contextmanager
def requested() -> Iterator[Request]:
    """Record signals while the block runs, and restore the earlier handlers afterwards.

    The training reads the recorded signal between two steps. Only the main thread may set handlers; in other threads no
    signal is recorded.

    Raises:
        Stopped: an error ended the block after a signal had come; without this, a sweep would go on to its next run.
    """
    request = Request()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return
    for signal_number in SIGNALS:
        before = signal.getsignal(signal_number)
        if before != signal.SIG_IGN:  # background processes ignore SIGINT
            request._before[signal_number] = signal.signal(signal_number, request._ask)
    try:
        yield request
    except Exception as error:
        if request.signal is None:
            raise
        raise Stopped(request.signal, f"stopped by {signal.Signals(request.signal).name}: {one_line(error)}") from error
    finally:
        for number, before in request._before.items():
            signal.signal(number, before)

"""Do the runs of a sweep here: each in this process, or in parallel processes (`+launch=parallel`).

A parallel process is a fork of one that has imported torch and computed nothing: a run does not wait for imports, and
there are no threads that a fork would lose. If one dies, for example because memory ran out, the others go on. A signal
to any of them stops the sweep: each run saves a checkpoint, and no other begins.
"""

import contextlib
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Sequence
from multiprocessing import connection, get_context
from multiprocessing.process import BaseProcess
from pathlib import Path

from omegaconf.errors import OmegaConfBaseException

from gsbench.errors import InputError, one_line, printable
from gsbench.launch import plan
from gsbench.launch.command import RunConfig, explain
from gsbench.launch.plan import Ended
from gsbench.measure.record import FILE_NAME
from gsbench.process.memory import is_out_of_memory, too_little_address_space
from gsbench.run import stop
from gsbench.run.stop import Request, Stopped

POLL = 0.2  # seconds between two looks for a signal, and of a run's process for its parent
Running = dict[BaseProcess, str]  # the processes of runs, and the overrides of each


def do_planned(config: RunConfig, folder: Path, run_number: int, at_once: int = 1) -> Ended:
    """Do run `run_number` of the sweep whose plan is in `folder`; write its outcome, and print the time left.

    `at_once` is the number of runs at a time, 0 if nobody knows, as on Slurm.
    """
    ended = do(config)
    plan.write_ended(folder, run_number, ended)
    if at_once and (line := plan.time_left(folder, at_once)):
        print(line, file=sys.stderr)
    return ended


def do(config: RunConfig) -> Ended:
    """Do a run, and return its outcome; a reason why it did not end well is printed too."""
    try:
        ended = _done(config)
    except OmegaConfBaseException as error:  # a reference in the config that leads nowhere
        ended = Ended(reason=explain(error), is_refused=True)
    except InputError as error:
        ended = Ended(reason=str(error), is_refused=True)
    except Exception as error:
        if not is_out_of_memory(error):
            traceback.print_exc()
        kind = "out of memory" if is_out_of_memory(error) else type(error).__name__
        ended = Ended(reason=f"{kind}: {one_line(error)}")
    if ended.reason is not None:
        print(f"gsbench: error: {printable(f'{config.config.scene.name}: {ended.reason}')}", file=sys.stderr)
    return ended


def _done(config: RunConfig) -> Ended:
    """Do a run, and return its outcome, with the path of its record relative to the folder of all results."""
    began, results = time.time(), Path(config.config.results).absolute()
    if (limit := too_little_address_space()) is not None:
        raise MemoryError(limit)
    from gsbench.run.execution import UnrecordedError, execute  # imports torch
    from gsbench.run.identity import identify

    spec = identify(config.config, config.choices, config.overrides)
    path = spec.folder.absolute() / FILE_NAME
    try:
        record = execute(spec)
    except UnrecordedError as error:
        return Ended(reason=str(error))
    problem = None if record is None or record.status == "ok" else f"{record.status}: {record.reason}"
    if not path.exists():  # without `record`: another process does the run
        return Ended(reason=problem or "it ended without a record") if record else Ended()
    seconds = time.time() - began if path.stat().st_mtime >= began else None  # an older record was kept
    return Ended(os.path.relpath(path, results), problem, seconds=seconds)


def launch_parallel(configs: Sequence[RunConfig], folder: Path) -> None:
    """Do the runs of the plan in `folder`, at most `launch.at_once` at a time.

    Raises:
        InputError: `launch.at_once` is invalid.
        Stopped: a signal asked this process, or that of a run, to end; all processes have ended.
    """
    at_once, cpus = configs[0].config.launch.at_once, len(os.sched_getaffinity(0))
    if at_once != -1 and at_once < 1:
        raise InputError(f"launch.at_once: expected at least 1, or -1 for one run for each CPU, got {at_once}")
    most = cpus if at_once == -1 else at_once
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, cpus // most)))
    if too_little_address_space() is None:
        # What a run needs is imported here, so that its process has it; if that fails, each run says so itself.
        with contextlib.suppress(ImportError, OSError, MemoryError):
            import gsbench.run.execution  # noqa: F401
    running: Running = {}
    try:
        with stop.requested() as request:
            for run_number, config in enumerate(configs):
                _wait(running, most - 1, request)
                if request.signal is None:
                    arguments = (config, folder, run_number, request, os.getpid(), most)
                    process = get_context("fork").Process(target=_work, args=arguments)
                    process.start()
                    running[process] = " ".join(config.overrides)
            _wait(running, 0, request)
        if request.signal is not None:
            raise Stopped(request.signal)
    except Stopped as stopped:
        _end(running, stopped.number)
        raise


def _wait(running: Running, most: int, request: Request) -> None:
    """Wait until at most `most` processes run, or until a signal asks this process or one of them to end."""
    while len(running) > most and request.signal is None:
        ended = connection.wait([process.sentinel for process in running], POLL)
        for process in [process for process in running if process.sentinel in ended]:
            process.join()
            _report_end(process.exitcode or 0, running.pop(process), request)


def _report_end(code: int, overrides: str, request: Request) -> None:
    """Print how a process ended if it was killed; if a signal asked it to end, ask this process to end too."""
    # -number: the signal killed it; 128 + number: it stopped itself (`Stopped.code`)
    signal_number = -code if code < 0 else code - 128
    if signal_number in stop.SIGNALS:
        request.signal = request.signal or signal_number
    elif code < 0:
        why = " (memory may have run out)" if signal_number == signal.SIGKILL else ""
        name = signal.Signals(signal_number).name
        print(
            f"\ngsbench: error: {printable(overrides)}: its process was ended by {name}{why}: "
            "the same command continues from its last checkpoint",
            file=sys.stderr,
        )


def _end(running: Running, signal_number: int) -> None:
    """Send a signal to all processes and wait for their end; a second signal to this process is sent to them too."""
    for process in running:
        if process.is_alive() and process.pid is not None:
            os.kill(process.pid, signal_number)
    try:
        for process in list(running):
            process.join()
            del running[process]
    except Stopped as again:
        _end(running, again.number)


def _work(config: RunConfig, folder: Path, run_number: int, request: Request, parent: int, at_once: int) -> None:
    """Do run `run_number` of the plan in `folder`, in a process of its own, which ends when process `parent` does.

    `request` tells of a signal that came before this process listens. `at_once` runs at a time give the time left.
    """
    with contextlib.suppress(OSError):  # the kernel kills a run if memory runs out, not the parent, which reports it
        Path("/proc/self/oom_score_adj").write_text("500")
    threading.Thread(target=_end_with, args=(parent,), name="gsbench-parent", daemon=True).start()
    try:
        stop.listen()
        if request.signal is not None:
            raise Stopped(request.signal)
        do_planned(config, folder, run_number, at_once)
    except Stopped as stopped:
        print(f"gsbench: {stopped}", file=sys.stderr)
        sys.exit(stopped.code)


def _end_with(parent: int) -> None:
    """Ask this process to end when its parent is gone, so that a killed sweep leaves no runs behind."""
    while os.getppid() == parent:
        time.sleep(POLL)
    os.kill(os.getpid(), signal.SIGTERM)

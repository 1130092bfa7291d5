"""End the process of a command with its exit status, also if what it printed cannot be written."""

import errno
import os
import sys
from collections.abc import Callable
from typing import NoReturn

from gsbench.errors import one_line

UNWRITABLE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)  # errors if the disk takes no more output
BAD_OUTPUT = 2  # exit status


def end_with(name: str, main: Callable[[], int | None]) -> NoReturn:
    """Run a command, and end the process with the exit status that it returns.

    A standard output that cannot be written ends in one line. If the program that reads it has ended, such as `head`,
    nothing is printed.

    Args:
        name: the command, with which the line begins.
        main: runs the command, and returns its exit status (None: 0) or raises SystemExit.
    """
    status: int | str | None = 0
    try:
        try:
            status = main()
        except SystemExit as end:
            status = end.code
        if sys.stdout is not None:  # it was closed before the process began
            sys.stdout.flush()
    except OSError as error:
        is_read = not isinstance(error, BrokenPipeError)
        if is_read and (error.filename or error.errno not in UNWRITABLE):
            raise
        if is_read:
            print(f"{name}: standard output: {error.strerror or one_line(error)}", file=sys.stderr)
            status = BAD_OUTPUT
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python writes what is left at its end
    sys.exit(status)

"""Define the errors for wrong input; a message says what was expected, what was found, and what to do."""

import difflib
from collections.abc import Collection, Iterable

DOCS = "docs"  # the folder of the docs pages, in a checkout and in an sdist


class InputError(ValueError):
    """The config, the data set or a tensor is wrong. The message is one line, printed without a stack trace.

    Args:
        message: what was expected, what was found, and what to do.
        docs: the page of the docs that explains what to do, such as "data.md#fetching"; the message ends with it.
    """

    def __init__(self, message: str = "", *, docs: str | None = None) -> None:
        super().__init__(message if docs is None else f"{message} ({DOCS}/{docs})")


class TooLargeError(InputError, MemoryError):
    """An operation would need more memory than is free; the error is raised before memory is allocated."""


def did_you_mean(name: str, valid: Iterable[str]) -> str:
    """Return a hint for an unknown name: ``Did you mean 'x'? Valid: a, b, x.``, where x is the most similar name."""
    choices = sorted(valid)
    close = difflib.get_close_matches(str(name), choices, n=1, cutoff=0.4)
    guess = f"Did you mean '{close[0]}'? " if close else ""
    return f"{guess}Valid: {', '.join(choices)}."


def check_known(what: str, name: str, valid: Collection[str]) -> None:
    """Raise InputError if a name of `what`, such as a backend, is none of the valid ones."""
    if name not in valid:
        raise InputError(f"{what} '{name}' is not known. {did_you_mean(name, valid)}")


def deleted_key(key: str) -> InputError:
    """Return the error that a command line has deleted a config key, such as by "~init"."""
    return InputError(f"config key '{key}': expected a value, it was deleted: leave '~{key}' out")


def refuse_options(options: object, names: Iterable[str], task: str) -> None:
    """Raise InputError if an option of a command line is set that a task, such as "--page", does not read."""
    for name in names:
        if getattr(options, name) is not None:
            raise InputError(f"--{name.replace('_', '-')}: expected none with {task}, which does not read it")


def how_to_install(
    extra: str,  # such as view
) -> str:
    """Return the command that installs an extra; in PyPI the name `gsbench` is another project's."""
    return f"pip install '.[{extra}]' in a checkout of gsbench, or 'WHEEL.whl[{extra}]'"


def one_line(error: BaseException) -> str:
    """Return the first line of an error's message, or the name of the error's type if it has no message.

    For an OSError on a file, return the file and the reason, such as "out/x.ply: No space left on device".
    """
    if isinstance(error, OSError) and error.filename and error.strerror:
        return printable(f"{error.filename}: {error.strerror}")
    return printable((str(error) or type(error).__name__).splitlines()[0])


def printable(value: object) -> str:
    """Convert a value to text on one line; line breaks and control characters are replaced by escapes."""
    text = str(value)
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)

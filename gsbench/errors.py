"""Report faults in the input: an error message says what was expected, what was given, and what to do."""

import difflib
from collections.abc import Iterable


class InputError(ValueError):
    """The config, the data set or a tensor has a fault; the message is one line and is shown without a stack trace."""


class TooLargeError(InputError, MemoryError):
    """A request needs more memory than there is; it is refused before anything is allocated."""


def did_you_mean(name: str, valid: Iterable[str]) -> str:
    """Return ``Did you mean 'x'? Valid: a, b, x.`` for a name that is not among `valid`."""
    choices = sorted(valid)
    close = difflib.get_close_matches(str(name), choices, n=1, cutoff=0.4)
    guess = f"Did you mean '{close[0]}'? " if close else ""
    return f"{guess}Valid: {', '.join(choices)}."


def one_line(error: BaseException) -> str:
    """Return the first line of an error's message, or its type if it has no message, in printable form.

    For an error of a file it is the file and what the system says: "out/x.ply: No space left on device".
    """
    if isinstance(error, OSError) and error.filename and error.strerror:
        return printable(f"{error.filename}: {error.strerror}")
    return printable((str(error) or type(error).__name__).splitlines()[0])


def printable(value: object) -> str:
    """Return a value as text on one line; control characters are written as escapes."""
    text = str(value)
    if text.isprintable():
        return text
    return "".join(one if one.isprintable() else one.encode("unicode_escape").decode() for one in text)

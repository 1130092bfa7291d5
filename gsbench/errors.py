"""What a user can get wrong: one exception that says what was expected, what came, and what to do."""

import difflib
from collections.abc import Iterable


class InputError(ValueError):
    """A fault in what was given (config, data set, tensor), told in one line and shown without a stack trace."""


class TooLargeError(InputError, MemoryError):
    """A request that memory would not suffice for, refused before it was made."""


def did_you_mean(name: str, valid: Iterable[str]) -> str:
    """Return ``Did you mean 'x'? Valid: a, b, x.`` for a name that is not among `valid`."""
    choices = sorted(valid)
    close = difflib.get_close_matches(name, choices, n=1, cutoff=0.4)
    guess = f"Did you mean '{close[0]}'? " if close else ""
    return f"{guess}Valid: {', '.join(choices)}."


def one_line(error: BaseException) -> str:
    """The first line of an error's message, or its type where it has no message."""
    return (str(error) or type(error).__name__).splitlines()[0]

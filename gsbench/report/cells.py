"""Make texts from records safe to be cells of CSV, which spreadsheets compute and terminals show."""

from typing import Any

from gsbench.errors import printable

_FORMULA = "=+-@"  # a spreadsheet computes a text that begins with one of these


def cell(value: Any) -> Any:
    """Return a value for CSV: a text on one line, without control characters, quoted by ' where it is a formula.

    Numbers, which may be negative, and all else stay as they are.
    """
    if not isinstance(value, str):
        return value
    text = printable(value)
    return f"'{text}" if text.startswith(tuple(_FORMULA)) else text

"""Make texts from run records safe for CSV files.

A spreadsheet would compute a text that begins like a formula, and a terminal would obey control characters in it.
"""

from typing import Any

from gsbench.errors import printable

_FORMULA = "=+-@"  # a spreadsheet computes a text that begins with one of these


def cell(value: Any) -> Any:
    """Return a value that is safe in a CSV cell.

    A text is put on one line, and its control characters are escaped. If it begins like a spreadsheet formula, a ' is
    put before it. Numbers and other values are returned unchanged.
    """
    if not isinstance(value, str):
        return value
    text = printable(value)
    return f"'{text}" if text.startswith(tuple(_FORMULA)) else text

"""Make texts from records safe as cells of CSV: spreadsheets run formulas, and terminals obey control characters."""

from typing import Any

from gsbench.errors import printable

_FORMULA = "=+-@"  # a spreadsheet computes a text that begins with one of these


def cell(value: Any) -> Any:
    """Return a value for CSV: a text is put on one line, escaped, and quoted by ' if it begins like a formula.

    Numbers, which may be negative, and other values are unchanged.
    """
    if not isinstance(value, str):
        return value
    text = printable(value)
    return f"'{text}" if text.startswith(tuple(_FORMULA)) else text

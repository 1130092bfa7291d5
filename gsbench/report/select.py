"""Select the models, scenes and columns of a report (`--select model=7dgs,4dgs scene=trex column=psnr_db,fps`)."""

from collections.abc import Iterable, Sequence

import pandas as pd

from gsbench.errors import InputError, did_you_mean, printable
from gsbench.report.frame import NUMBERS, Results

Selection = dict[str, list[str]]  # names by "model", "scene" or "column"; of a key that is missing all are selected


def parse(words: Sequence[str]) -> Selection:
    """Parse the words of `--select`, such as ["model=7dgs,4dgs", "column=psnr_db"].

    Raises:
        InputError: a word has no known key or no value, a key comes twice, or a column is unknown.
    """
    selection: Selection = {}
    for word in words:
        key, _, text = word.partition("=")
        values = [value for value in text.split(",") if value]
        if key not in ("model", "scene", "column") or not values:
            raise InputError(f"--select: expected model=.., scene=.. or column=.., got '{printable(word)[:100]}'")
        if key in selection:
            raise InputError(f"--select: expected {key}= once, got it twice: join the values by commas")
        selection[key] = list(dict.fromkeys(values))
    _check("column", selection.get("column", []), NUMBERS)
    return selection


def selected(results: Results, selection: Selection) -> Results:
    """Return the runs of the selected models and scenes.

    Raises:
        InputError: no run has a model or a scene of the selection, or no run has both.
    """
    runs = results.runs
    is_selected = pd.Series(True, runs.index)
    for key in ("model", "scene"):
        if key in selection:
            _check(key, selection[key], set(runs[key]))
            is_selected &= runs[key].isin(selection[key])
    if len(runs) and not is_selected.any():
        pairs = ", ".join(sorted({printable(pair) for pair in runs.model + " on " + runs.scene}))
        raise InputError(f"--select: expected a model and a scene with runs, got none. There is: {pairs}.")
    return results.of(is_selected)


def _check(key: str, asked: Iterable[str], valid: Iterable[str]) -> None:
    for name in asked:
        if name not in valid:
            known = did_you_mean(name, map(printable, valid))
            raise InputError(f"--select {key}={printable(name)[:100]}: no such {key}. {known}")

"""Select the models, scenes and columns of a report (`--select model=7dgs,4dgs scene=trex column=psnr_db,fps`)."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from gsbench.errors import InputError, did_you_mean, printable
from gsbench.report.frame import NUMBERS, Results

KEYS = ("model", "scene", "column")


class Selection(NamedTuple):
    """The models, scenes and columns that a report shows; an empty list stands for all of them."""

    models: list[str]
    scenes: list[str]
    columns: list[str]

    def of(self, results: Results) -> Results:
        """Return the runs of the selected models and scenes.

        Raises:
            InputError: no run has a model or a scene of the selection, or no run has both.
        """
        runs = results.runs
        _check("model", self.models, set(runs.model))
        _check("scene", self.scenes, set(runs.scene))
        is_selected = runs.model.isin(self.models or set(runs.model)) & runs.scene.isin(self.scenes or set(runs.scene))
        if len(runs) and not is_selected.any():
            pairs = ", ".join(sorted({printable(pair) for pair in runs.model + " on " + runs.scene}))
            raise InputError(f"--select: expected a model and a scene with runs, got none. There is: {pairs}.")
        return results.of(is_selected)


def parse(words: Sequence[str]) -> Selection:
    """Parse the words of `--select`, such as ["model=7dgs,4dgs", "column=psnr_db"].

    Raises:
        InputError: a word has no known key or no value, a key comes twice, or a column is unknown.
    """
    lists: dict[str, list[str]] = {}
    for word in words:
        key, _, text = word.partition("=")
        values = [value for value in text.split(",") if value]
        if key not in KEYS or not values:
            raise InputError(f"--select: expected model=.., scene=.. or column=.., got '{printable(word)[:100]}'")
        if key in lists:
            raise InputError(f"--select: expected {key}= once, got it twice: join the values by commas")
        lists[key] = list(dict.fromkeys(values))
    _check("column", lists.get("column", []), NUMBERS)
    return Selection(*(lists.get(key, []) for key in KEYS))


def _check(key: str, asked: Iterable[str], valid: Iterable[str]) -> None:
    for name in asked:
        if name not in valid:
            known = did_you_mean(name, map(printable, valid))
            raise InputError(f"--select {key}={printable(name)[:100]}: no such {key}. {known}")

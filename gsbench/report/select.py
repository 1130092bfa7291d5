"""Select the models, scenes and columns of a report (`--select model=7dgs,4dgs scene=trex column=psnr,fps`)."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from gsbench.errors import InputError, did_you_mean, printable
from gsbench.measure.record import Record
from gsbench.report.tables import CHOICES

KEYS = ("model", "scene", "column")


@dataclass(frozen=True)
class Selection:
    """The models, scenes and columns that a report shows; an empty list stands for all of them."""

    models: list[str]
    scenes: list[str]
    columns: list[str]

    def of(self, records: list[Record]) -> list[Record]:
        """Return the run records of the selected models and scenes.

        Raises:
            InputError: no record has a model or a scene of the selection, or no record has both.
        """
        _check("model", self.models, {r.model for r in records})
        _check("scene", self.scenes, {r.scene for r in records})
        kept = [
            r
            for r in records
            if (not self.models or r.model in self.models) and (not self.scenes or r.scene in self.scenes)
        ]
        if records and not kept:
            there = sorted({printable(f"{r.model} on {r.scene}") for r in records})
            raise InputError(f"--select: expected a model and a scene with runs, found none. There is: "
                             f"{', '.join(there)}.")  # fmt: skip
        return kept


def parse(words: Sequence[str]) -> Selection:
    """Parse the words of `--select`, such as ["model=7dgs,4dgs", "column=psnr"].

    Raises:
        InputError: a word has no known key or no value, a key comes twice, or a column is unknown.
    """
    found: dict[str, list[str]] = {}
    for word in words:
        key, _, text = word.partition("=")
        values = [value for value in text.split(",") if value]
        if key not in KEYS or not values:
            raise InputError(f"--select: expected model=.., scene=.. or column=.., got '{printable(word)[:100]}'")
        if key in found:
            raise InputError(f"--select: expected {key}= once, got it twice: join the values by commas")
        found[key] = list(dict.fromkeys(values))
    _check("column", found.get("column", []), CHOICES)
    return Selection(*(found.get(key, []) for key in KEYS))


def _check(key: str, asked: Iterable[str], there: Iterable[str]) -> None:
    for name in asked:
        if name not in there:
            known = did_you_mean(name, map(printable, there))
            raise InputError(f"--select {key}={printable(name)[:100]}: no such {key}. {known}")

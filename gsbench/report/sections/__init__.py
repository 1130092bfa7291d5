"""Make the sections of a report on one experiment: every module of this folder registers its own with `@section`.

All differences that sections show as significant or not are tested together, with one correction for each quantity.
"""

import importlib
import pkgutil
from collections.abc import Callable

import pandas as pd

from gsbench.report import stats
from gsbench.report.frame import Results
from gsbench.report.section import SECTIONS, Registered, Section

ORDER = [
    "budgets",
    "frontier",
    "experiment",
    "pairs",
    "effects",
    "quality",
    "curves",
    "lengths",
    "on_demand",
    "stages",
    "flicker",
    "gallery",
    "protocol",
    "runs",
]  # others come before the last two

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")


def tested(chapter: Results) -> pd.DataFrame:
    """Test all differences that sections ask for, with one correction (Holm) for each quantity of an experiment.

    Returns:
        A row for each difference: its "section", "quantity", "name", "weights", and the columns of stats.differences.
    """
    rows = [(key, *row) for key, section in SECTIONS.items() if section.asks for row in section.asks(chapter)]
    asked = pd.DataFrame(rows, columns=["section", "quantity", "name", "weights"])
    tests = []
    for quantity, group in asked.groupby("quantity", sort=False):
        group = group.reset_index(drop=True)
        tests.append(group.join(stats.differences(stats.grids(chapter, str(quantity)), list(group.weights))))
    return pd.concat(tests or [asked.join(stats.differences({}, []))], ignore_index=True)  # if none: columns alone


def built(chapter: Results, chosen: Callable[[Registered], bool] = lambda _: True) -> list[Section]:
    """Make the chosen sections of one experiment in ORDER; those that it lacks come before its last two."""
    keys = [key for key, section in SECTIONS.items() if chosen(section)]
    ordered = sorted(keys, key=lambda key: ORDER.index(key) if key in ORDER else len(ORDER) - 2.5)
    tests = tested(chapter) if any(SECTIONS[key].asks for key in keys) else pd.DataFrame(columns=["section"])
    sections = [SECTIONS[key].build(chapter, tests[tests.section == key]) for key in ordered]
    return [section for section in sections if section is not None]

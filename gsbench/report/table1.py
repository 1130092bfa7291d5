"""Make Table 1 of the 7DGS paper from run records: each measured row, the paper's row, and their difference."""

import math
from statistics import fmean
from typing import Any

from gsbench.errors import printable
from gsbench.measure.record import Record
from gsbench.report import paper, tables
from gsbench.report.conditions import conditions
from gsbench.report.configurations import Group
from gsbench.report.layout import EMPTY, QuantityColumn, Row, Section, Table
from gsbench.report.paper_protocol import MODELS, ModelRecipe, Sorted, departure, finished, model_recipe, model_recipes
from gsbench.report.seed_means import SPREAD, mean
from gsbench.report.tables import LEAKS, OF_THE_MACHINE, of_one_machine

COLUMNS = [*tables.COLUMNS[:1], QuantityColumn(LEAKS, LEAKS, 2, "psnr"), *tables.COLUMNS[1:]]
SEEDS = 3  # the fewest seeds for a valid interval

PAPER = (
    "Table 1 of the 7DGS paper (ICCV 2025). Its PSNR is the best on test seen during training, which leaks: like stands"
    f" beside like in the column {LEAKS}. Times are of a V100, so no difference is taken."
)
OTHER_DATA = "Rendered for this project in place of the paper's scenes; the paper's rows are not shown."

Runs = dict[str, list[Record]]  # finished runs by scene
Line = dict[str, Any]  # a line of the CSV file


def build(found: Sorted) -> tuple[list[Table], list[Line]]:
    """Make the tables in the format of Table 1 of the 7DGS paper, and the lines of the CSV file.

    There is a table for each data set of the paper, and one for each group of runs with another protocol or other data.
    """
    made: list[Table] = []
    lines: list[Line] = []
    for dataset, records in found.paper.items():
        table = _Table1Builder(dataset, records, lines, "paper")
        notes = [missing(dataset, records), *_left_out(found.left_out[dataset])]
        made.append(
            table.make(f"Table 1, {dataset}, at the paper's protocol", list(paper.PROTOCOLS[dataset].scenes), notes)
        )
    for kind, pools in (("other protocol", found.other_protocol), ("other data", found.other_data)):
        for pool in pools:
            scenes = sorted({r.scene for r in pool.runs})
            table = _Table1Builder(pool.dataset, pool.runs, lines, kind)
            note = OTHER_DATA if kind == "other data" else _other_protocol(pool.runs)
            made.append(table.make(f"{kind.upper()}, {printable(pool.heading)}", scenes, [note]))
    return made, lines


def _other_protocol(runs: list[Record]) -> str:
    """Return a note that says how these runs differ from the paper's protocol; the paper's rows are not shown."""
    what = sorted({word for r in runs for word in departure(r).split(", ")})
    return f"Measured otherwise than in the paper (in {', '.join(what)}), so the paper's rows are not shown."


def missing(dataset: str, records: list[Record]) -> str:
    """Return a line that lists which scenes, models and seeds of a data set still have to be run.

    The line covers only runs with the protocol of the 7DGS paper.
    """
    own = [r for r in records if r.status == "ok" and not model_recipe(r).recipe]
    scenes = paper.PROTOCOLS[dataset].scenes
    seeds = {(s, m): len({r.seed for r in own if (r.scene, r.model) == (s, m)}) for s in scenes for m in MODELS}
    none = [s for s in scenes if not any(seeds[s, m] for m in MODELS)]
    if len(none) == len(scenes):
        return f"Missing: all {len(scenes)} scenes ({', '.join(scenes)})."
    said = [f"all models of {', '.join(none)}"] if none else []
    for s in scenes:
        lacking = [m for m in MODELS if not seeds[s, m]]
        said += [f"{s}: {', '.join(lacking)}"] if lacking and s not in none else []
    few = [f"{s} {m} has {n}" for (s, m), n in seeds.items() if 0 < n < SEEDS]
    said += [f"seeds, of {SEEDS}: {', '.join(few)}"] if few else []
    return f"Missing: {'; '.join(said)}." if said else f"Complete: all scenes and models, {SEEDS} seeds or more."


def _left_out(pools: list[str]) -> list[str]:
    """List a footnote that names the runs which appear in no table; the list is empty if there are none."""
    if not pools:
        return []
    shown = "; ".join(map(printable, pools[:5])) + (f"; and {len(pools) - 5} more" if len(pools) > 5 else "")
    return [f"Left out, at another protocol than the paper's: {shown}."]


class _Table1Builder:
    """Makes the table of one data set like Table 1 of the 7DGS paper, and adds its numbers to the CSV lines."""

    def __init__(self, dataset: str, records: list[Record], lines: list[Line], kind: str) -> None:
        self.dataset = dataset
        self.records = records
        self.lines = lines
        self.kind = kind  # "paper", "other protocol" or "other data"
        self.recipes = model_recipes(records)
        self.machine = Group(records).machine if records else ""
        self.names_experiment = len({r.experiment for r in records}) > 1
        self.marks: list[str] = []

    def make(self, title: str, scenes: list[str], notes: list[str]) -> Table:
        """Make the table: a section for every scene that has a run, and an average over scenes.

        The average is over the scenes that all models finished.
        """
        sections = [self._scene(s) for s in scenes if any(r.scene == s for r in self.records)]
        if len(sections) > 1:
            sections.append(self._average(scenes))
        conditional = conditions(self.records, SPREAD) if self.records else []
        footnotes = [*notes, *of_one_machine(self.records, self.machine), *conditional]
        return Table(title, COLUMNS, sections, self.marks, footnotes)

    def _scene(self, scene: str) -> Section:
        rows: list[Row] = []
        for one in self.recipes:
            runs = finished(self.records, one, [scene])
            rows += self._rows(scene, one, runs) if runs else []
        lost = [r for r in self.records if r.scene == scene and r.status != "ok"]
        notes = [f"{self._label(model_recipe(r))} seed {r.seed} {r.status}: {printable(r.reason)}" for r in lost]
        return Section(scene, _with_best(rows), notes)

    def _average(self, scenes: list[str]) -> Section:
        own = [one for one in self.recipes if not one.recipe]  # other settings are often tried on one scene only
        runs = {one: found for one in own if (found := finished(self.records, one, scenes))}
        covered = [s for s in scenes if runs and all(s in found for found in runs.values())]
        title = f"average over {len(covered)} of {len(scenes)} scenes"
        if not covered:
            return Section(title, [], ["there is no scene that every model has finished"])
        rows: list[Row] = []
        for one, found in runs.items():
            rows += self._rows("avg", one, {s: found[s] for s in covered})
        return Section(f"{title}: {', '.join(covered)}", _with_best(rows))

    def _rows(self, scene: str, one: ModelRecipe, runs: Runs) -> list[Row]:
        """Make the measured row, the paper's row and the row of their difference, and add the numbers to the CSV."""
        here = {s: [r for r in seeds if r.provenance.machine == self.machine] for s, seeds in runs.items()}
        measured = {c.key: mean(here if c.key in OF_THE_MACHINE else runs, c.key) for c in COLUMNS}
        seeds = min(map(len, runs.values()))
        cells = {c.key: c.show(measured[c.key].mean, measured[c.key].half) for c in COLUMNS}
        rows = [Row(self._label(one), cells, str(seeds))]
        theirs = self._paper(one.model, list(runs))
        delta = {
            c.key: math.nan if c.key in OF_THE_MACHINE else measured[c.key].mean - theirs.get(c.key, math.nan)
            for c in COLUMNS
        }
        if theirs:
            shown = {c.key: c.show(theirs[c.key]) for c in COLUMNS}
            shown["lpips_alex"] += f" {self._mark(tables.PAPER_LPIPS)}"
            rows.append(Row(f"paper {self._mark(PAPER)}", shown, paper=True))
            rows.append(Row("difference", {c.key: _signed(c, delta[c.key]) for c in COLUMNS}))
        line: Line = {"table": self.kind, "dataset": self.dataset, "experiment": one.experiment, "scene": scene}
        line |= {"scenes": len(runs), "model": one.model, "recipe": one.recipe, "seeds": seeds}
        for c in COLUMNS:
            line |= {c.key: measured[c.key].mean, f"{c.key} ±": measured[c.key].half}
            line |= {f"{c.key} paper": theirs.get(c.key, math.nan), f"{c.key} difference": delta[c.key]}
        self.lines.append(line)
        return rows

    def _paper(self, model: str, scenes: list[str]) -> dict[str, float]:
        """Return the paper's numbers by column, averaged over `scenes`; empty if the paper lacks one of these scenes.

        The result is also empty if the table's runs do not follow the paper's protocol.
        """
        if self.kind != "paper":
            return {}
        rows = [row for scene in scenes if (row := paper.paper_row(self.dataset, scene, model))]
        if len(rows) < len(scenes):
            return {}
        values = {c.key: [getattr(row, c.paper) for row in rows] for c in COLUMNS}
        return {key: math.nan if None in given else fmean(given) for key, given in values.items()}

    def _label(self, one: ModelRecipe) -> str:
        """Return the label of a row: its model, its training settings, and its experiment if the table has several."""
        return " ".join(filter(None, [one.model, one.recipe, f"({one.experiment})" * self.names_experiment]))

    def _mark(self, text: str) -> str:
        """Return the number of a footnote as text, such as "(1)"; footnotes with equal texts share a number."""
        if text not in self.marks:
            self.marks.append(text)
        return f"({self.marks.index(text) + 1})"


def _signed(column: QuantityColumn, difference: float) -> str:
    """Format a difference with its sign and with as many digits as its column has."""
    if math.isnan(difference):
        return EMPTY
    return ("+" if difference >= 0 else "-") + column.show(abs(difference))


def _with_best(rows: list[Row]) -> list[Row]:
    """Mark the measured rows whose final PSNR, rounded as the table shows it, is the highest."""
    shown = {row.cells["psnr"].partition(" ")[0] for row in rows if row.seeds} - {EMPTY}
    best = max(shown, key=float, default=None)
    return [
        Row(row.label, row.cells, row.seeds, bool(row.seeds) and row.cells["psnr"].partition(" ")[0] == best)
        for row in rows
    ]

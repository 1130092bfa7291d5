"""Make the table of 7DGS' successors: the PSNR that the authors of dGS and UBS publish, beside measured runs."""

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from statistics import fmean
from typing import Any, NamedTuple

from gsbench.errors import printable
from gsbench.measure.record import Record
from gsbench.report import paper
from gsbench.report.configurations import iterations, without
from gsbench.report.layout import QuantityColumn, Row, Section, Table
from gsbench.report.seed_means import SPREAD, mean
from gsbench.report.tables import LEAKS

MODELS = ("dgs", "ubs", "dbs", "freetime", "7dgs", "7dgs_noagr", "4dgs")
SCENES = {name: paper.PROTOCOLS[name].scenes for name in ("D-NeRF", "7DGS-PBR")}
COLUMNS = [
    QuantityColumn("psnr", "PSNR", 2),
    QuantityColumn(LEAKS, LEAKS, 2),
    QuantityColumn("num_gaussians", "#Gaussians", 0),
    QuantityColumn("protocol", "protocol, downscale, iterations x batch", None),
]
MEASURED = [column.key for column in COLUMNS[:-1]]
SOURCES = {
    "dgs": "the authors of dGS (under review, 2026): black background, half resolution (D-NeRF: 400x400), lego on val. "
    "They test every 500 iterations and keep the best: treat as best on test",
    "ubs": "the authors of UBS (ICLR 2026): iteration 30,000, and the mean of the channels' PSNR, which is never lower",
    "ubs_others": "in the table of UBS' authors, which does not say the iteration: treat as best on test",
}
COMPUTED = "the mean is computed here from the published scenes"
UNSTATED = "the number of scenes of this mean is not stated"
_IN_THE_PROTOCOL = (  # settings of a variant that the protocol of a row says, or that train nothing else
    "protocol", "downscale", "resize", "iterations", "batch_size", "eval_split", "best_on_test", "curve_points",
)  # fmt: skip

Line = dict[str, Any]  # a line of the CSV file


@dataclass(frozen=True)
class Published:
    """A published PSNR of a method on a scene, or its mean over scenes."""

    scene: str  # paper.AVERAGE for a mean
    scenes: int | None  # of the mean; None if it is not stated
    method: str
    source: str  # a key of SOURCES
    psnr: float  # dB
    num_gaussians: float  # NaN if it is not known


class _Settings(NamedTuple):
    """What the measured runs of a row have in common."""

    model: str
    recipe: str  # training settings that differ from the experiment's own
    experiment: str
    protocol: str


def build(records: list[Record]) -> tuple[list[Table], list[Line]]:
    """Make a table for each data set with published numbers, and the lines of the CSV file.

    A measured row may follow any protocol, and names it. Runs on other data, which stand in for a data set, are left
    out, and so are trials, which are measured on val where the data set has a test split.
    """
    lines: list[Line] = []
    return [_TableBuilder(dataset, records, lines).table() for dataset in SCENES], lines


@cache
def published(dataset: str) -> list[Published]:
    """Return the published numbers of a data set, "D-NeRF" or "7DGS-PBR"."""
    text = (resources.files(__package__) / "successors.csv").read_text()
    return [
        Published(
            scene=row["scene"],
            scenes=int(row["scenes"]) if row["scenes"] else None,
            method=row["method"],
            source=row["source"],
            psnr=float(row["psnr_db"]),
            num_gaussians=1000 * float(row["thousand_gaussians"] or "nan"),
        )
        for row in csv.DictReader(text.splitlines())
        if row["dataset"] == dataset
    ]


class _TableBuilder:
    """Makes the table of one data set, and adds its numbers to the CSV lines."""

    def __init__(self, dataset: str, records: list[Record], lines: list[Line]) -> None:
        self.dataset = dataset
        self.lines = lines
        self.marks: list[str] = []
        self.runs: dict[_Settings, dict[str, dict[int, Record]]] = {}  # then by scene and seed
        for r in sorted(records, key=lambda r: (r.metrics or {}).get("psnr_best_on_test") is not None):
            wanted = r.dataset == dataset and r.model in MODELS and r.scene in SCENES[dataset]
            if r.status == "ok" and wanted and r.protocol.get("eval_split") == _split(dataset, r.scene):
                self.runs.setdefault(_settings(r), {}).setdefault(r.scene, {})[r.seed] = r

    def table(self) -> Table:
        """Make the table: a section for every scene, and the means over all scenes and over those of MCMC runs."""
        scenes = SCENES[self.dataset]
        sections = [self._scene(scene) for scene in scenes] + [self._mean(scenes)]
        if "lego" in scenes:
            sections.append(self._mean([scene for scene in scenes if scene != "lego"]))
        lacking = [model for model in MODELS if not any(one.model == model for one in self.runs)]
        notes = [f"No finished run here of {', '.join(lacking)}."] if lacking else []
        notes += [SPREAD, "Measured rows have lego on val."][: 1 + ("lego" in scenes)]
        return Table(f"Successors of 7DGS, {self.dataset}", COLUMNS, sections, self.marks, notes)

    def _scene(self, scene: str) -> Section:
        rows = [self._published(one, 1) for one in published(self.dataset) if one.scene == scene]
        return Section(scene, rows + self._measured([scene]))

    def _mean(self, scenes: Sequence[str]) -> Section:
        """Make the rows of means over some scenes; a measured row has finished all of them."""
        whole = len(scenes) == len(SCENES[self.dataset])
        found = [one for one in published(self.dataset) if one.scene == paper.AVERAGE]
        rows = []
        for one in found:
            if one.scenes == len(scenes) or (whole and one.scenes is None):
                rows.append(self._published(one, one.scenes, *([] if one.scenes else [UNSTATED])))
            elif not whole and one.scenes == len(SCENES[self.dataset]):
                own = [p for p in published(self.dataset) if p.method == one.method and p.source == one.source]
                of = [p for p in own if p.scene in scenes]
                psnr, count = fmean(p.psnr for p in of), fmean(p.num_gaussians for p in of)
                computed = Published(paper.AVERAGE, len(scenes), one.method, one.source, psnr, count)
                rows.append(self._published(computed, len(scenes), COMPUTED))
        title = f"mean over {len(scenes)} scenes{'' if whole else ', without lego'}"
        return Section(title, rows + self._measured(scenes))

    def _published(self, one: Published, scenes: int | None, *notes: str) -> Row:
        """Make a published row: its PSNR is in the column of the last iteration or of the best on test."""
        key = "psnr" if one.source == "ubs" else LEAKS
        values = {key: one.psnr, "num_gaussians": one.num_gaussians}
        marks = " ".join(self._mark(text) for text in (SOURCES[one.source], *notes))
        line: Line = {"dataset": self.dataset, "scene": one.scene, "scenes": scenes or "", "row": "published"}
        line |= {"method": one.method, "recipe": "", "experiment": "", "protocol": SOURCES[one.source], "seeds": ""}
        self.lines.append(line | {name: values.get(name, math.nan) for name in MEASURED})
        shown = {c.key: c.show(values.get(c.key, math.nan)) for c in COLUMNS[:-1]}
        return Row(f"{one.method} {marks}", shown | {"protocol": "published"})

    def _measured(self, scenes: Sequence[str]) -> list[Row]:
        """Make a row for every model with its settings that has finished all of some scenes."""
        rows = []
        names_experiment = len({one.experiment for one in self.runs}) > 1
        for one in sorted(self.runs, key=lambda one: (MODELS.index(one.model), one)):
            if not all(scene in self.runs[one] for scene in scenes):
                continue
            runs = {s: [self.runs[one][s][seed] for seed in sorted(self.runs[one][s])] for s in scenes}
            means = {name: mean(runs, name) for name in MEASURED}
            seeds = min(map(len, runs.values()))
            line: Line = {"dataset": self.dataset, "scene": scenes[0] if len(scenes) == 1 else paper.AVERAGE}
            line |= {"scenes": len(scenes), "row": "measured", "method": one.model, "recipe": one.recipe}
            line |= {"experiment": one.experiment, "protocol": one.protocol, "seeds": seeds}
            for name in MEASURED:
                line |= {name: means[name].mean, f"{name} ±": means[name].half}
            self.lines.append(line)
            shown = {c.key: c.show(means[c.key].mean, means[c.key].half) for c in COLUMNS[:-1]}
            said = ["measured:", one.model, one.recipe, f"({one.experiment})" * names_experiment]
            rows.append(Row(printable(" ".join(filter(None, said))), shown | {"protocol": one.protocol}, str(seeds)))
        return rows

    def _mark(self, text: str) -> str:
        """Return the number of a footnote as text, such as "(1)"; footnotes with equal texts share a number."""
        if text not in self.marks:
            self.marks.append(text)
        return f"({self.marks.index(text) + 1})"


def _split(dataset: str, scene: str) -> str:
    """Return the split on which a scene of a data set is tested: "val" for D-NeRF's lego, else "test"."""
    splits = paper.PROTOCOLS[dataset].splits
    return splits.get(scene, splits["*"])


def _settings(record: Record) -> _Settings:
    """Return the model, the training settings, the experiment and the protocol of a run."""
    recipe = without(record.variant, *_IN_THE_PROTOCOL)
    return _Settings(record.model, recipe, record.experiment, printable(_protocol(record)))


def _protocol(record: Record) -> str:
    """Return the protocol of a run as a text such as "gsbench, 2, 30,000 x 4".

    Parts that the name of a protocol does not imply are added: another filter, rounding or background.
    """
    said, config = record.protocol, record.provenance.config
    train = config.get("train")
    batch = train.get("batch_size") if isinstance(train, dict) else None
    name = said.get("name", "protocol not recorded")
    text = f"{name}, {said.get('downscale')}, {iterations(record) or 0:,} x {batch}"
    as_dgs = name == "dgs2026"
    own: dict[str, Any] = {"resize": "pillow" if as_dgs else None, "quantise": as_dgs}
    own["background"] = "black"
    return ", ".join([text, *(f"{key} {said.get(key)}" for key, value in own.items() if said.get(key) != value)])

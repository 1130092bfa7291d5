"""Sort run records by whether they follow the protocol of the 7DGS paper, so that tables hold only comparable runs."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from gsbench.errors import printable
from gsbench.measure.record import Record
from gsbench.report.configurations import iterations, without
from gsbench.report.paper import PROTOCOLS, Protocol

MODELS = ("3dgs", "4dgs", "6dgs", "7dgs_noagr", "7dgs")
# Settings of a variant that do not belong to a model's training settings: they change what is measured, or the heading
# of a table names them.
_NOT_OF_THE_RECIPE = ("iterations", "downscale", "eval_split", "best_on_test", "curve_points")
_SAME_TRAINING = "protocol=published"  # only adds the best on test


class ModelRecipe(NamedTuple):
    """The model, the experiment and the training settings that the runs of a table row have in common."""

    model: str
    experiment: str
    recipe: str  # training settings that differ from the experiment's own; "" if none does


@dataclass(frozen=True)
class Pool:
    """Runs on one data set with the same protocol, which may therefore share a table."""

    dataset: str
    experiment: str
    steps: int  # iterations of training; 0 if the records lack them
    runs: list[Record] = field(default_factory=list)

    @property
    def heading(self) -> str:
        """Return a heading with the data set, the experiment, the image sizes and the training length of these runs."""
        sizes = ", ".join(sorted({_size(r) for r in self.runs}))
        resized = f" by {resize}" if (resize := self.runs[0].protocol.get("resize")) else ""
        return f"{self.dataset}: experiment {self.experiment}, {sizes}{resized}, {self.steps:,} iterations"

    @property
    def effort(self) -> int:
        """Return the pixels of the largest image times the number of training iterations.

        Of two groups of runs, the one with the higher value is closer to the paper's protocol.
        """
        return self.steps * max(_pixels(_size(r)) for r in self.runs)


@dataclass(frozen=True)
class Sorted:
    """The run records of a folder, sorted by whether they can be compared with the results of the 7DGS paper."""

    paper: dict[str, list[Record]]  # by data set: runs at the paper's protocol
    other_protocol: list[Pool]  # for each data set of the paper, the runs nearest to its protocol
    other_data: list[Pool]  # runs on data that stand in for the paper's: those of most effort
    left_out: dict[str, list[str]]  # by data set of the paper: the runs that are in no table, as text


def sort(records: list[Record]) -> Sorted:
    """Sort run records into those with the 7DGS paper's protocol, those with another protocol, and those on other data.

    Other data are scenes that stand in for scenes of the paper. A record is skipped without a message if its model is
    not one of the five in MODELS, or if its data neither belong to the paper nor stand in for its data.
    """
    at_paper: dict[str, list[Record]] = {name: [] for name in PROTOCOLS}
    pools: dict[tuple[str, str, str, str, str, int], Pool] = {}  # by downscaling, as image sizes differ between scenes
    for r in records:
        named = r.protocol.get("paper_dataset")
        if not isinstance(named, str) or named not in PROTOCOLS or r.model not in MODELS:
            continue
        if not departure(r):
            at_paper[named].append(r)
            continue
        steps = iterations(r) or 0
        reduced = str(r.protocol.get("downscale")), str(r.protocol.get("resize"))
        key = named, r.dataset, r.experiment, *reduced, steps
        pools.setdefault(key, Pool(r.dataset, r.experiment, steps)).runs.append(r)
    nearest: dict[tuple[str, str], Pool] = {}
    for (named, dataset, *_), pool in sorted(pools.items(), key=lambda one: (-one[1].effort, one[0])):
        if any(r.status == "ok" for r in pool.runs):
            nearest.setdefault((named, dataset), pool)
    shown = {id(pool) for pool in nearest.values()}
    left: dict[str, list[str]] = {name: [] for name in PROTOCOLS}
    for (named, *_), pool in sorted(pools.items()):
        if id(pool) not in shown:
            left[named].append(f"{len(pool.runs)} run{'s' * (len(pool.runs) > 1)} of {pool.heading}")
    return Sorted(
        at_paper,
        [pool for (named, dataset), pool in nearest.items() if named == dataset],
        [pool for (named, dataset), pool in nearest.items() if named != dataset],
        left,
    )


def departure(record: Record) -> str:
    """Return the names of the settings in which a run differs from the 7DGS paper's protocol; "" if there are none."""
    protocol = PROTOCOLS.get(record.dataset)
    if protocol is None or record.protocol.get("paper_dataset") != record.dataset:
        return "data"
    if record.scene not in protocol.scenes:
        return "scene"
    config = record.provenance.config
    expected: dict[str, tuple[Any, Any]] = _of_images(record, protocol) | {
        "iterations": (iterations(record), protocol.iterations),
        "batch size": (_part(config, "train").get("batch_size"), protocol.batch_size),
        "frames": (_count(_part(config, "scene").get("frames")), protocol.frames),
    }
    if record.status != "ok" and record.protocol.get("resolution") == "not loaded":
        del expected["size"]  # a run that failed before it saw an image
    return ", ".join(name for name, (theirs, papers) in expected.items() if theirs != papers)


def has_images_of_paper(record: Record) -> bool:
    """Tell whether a run is measured on the images of the 7DGS paper, of the paper's size, split and background.

    Only then can its PSNR be compared with the paper's. The training may be another one.
    """
    protocol = PROTOCOLS.get(record.dataset)
    if protocol is None or record.protocol.get("paper_dataset") != record.dataset:
        return False
    return all(theirs == papers for theirs, papers in _of_images(record, protocol).values())


def _of_images(record: Record, protocol: Protocol) -> dict[str, tuple[Any, Any]]:
    """Return the settings of the images on which a run is measured, by name, each beside that of the paper."""
    return {
        "size": (record.protocol.get("resolution"), protocol.sizes.get(record.scene, protocol.sizes["*"])),
        "filter": (record.protocol.get("resize"), None),
        "split": (record.protocol.get("eval_split"), protocol.splits.get(record.scene, protocol.splits["*"])),
        "background": (record.protocol.get("background"), "black"),
        "quantisation": (record.protocol.get("quantise"), False),
    }


def model_recipe(record: Record) -> ModelRecipe:
    """Return the model, the experiment and the training settings of a run, which determine its table row."""
    words = without(record.variant, *_NOT_OF_THE_RECIPE).split(",")
    return ModelRecipe(record.model, record.experiment, ",".join(word for word in words if word != _SAME_TRAINING))


def model_recipes(records: list[Record]) -> list[ModelRecipe]:
    """List the different models and training settings that occur in run records, in the order of MODELS."""
    return sorted({model_recipe(r) for r in records}, key=lambda one: (MODELS.index(one.model), one))


def finished(records: list[Record], one: ModelRecipe, scenes: Sequence[str]) -> dict[str, list[Record]]:
    """Return the finished runs of a model with the given training settings: for each scene one run for each seed.

    If a seed has two runs, the run that also records the best test PSNR during training is taken.
    """
    found: dict[str, dict[int, Record]] = {}
    for r in sorted(records, key=lambda r: (r.metrics or {}).get("psnr_best_on_test") is not None):
        if r.status == "ok" and r.scene in scenes and model_recipe(r) == one:
            found.setdefault(r.scene, {})[r.seed] = r
    return {scene: [found[scene][seed] for seed in sorted(found[scene])] for scene in scenes if scene in found}


def _size(record: Record) -> str:
    """Return the image size of a run as a text such as "400x400", with control characters escaped."""
    return printable(record.protocol.get("resolution", "a size not recorded"))


def _pixels(size: str) -> int:
    """Return the number of pixels of a size such as "400x400", or 0 if the text is not a size."""
    numbers = size.split("x")
    return int(numbers[0]) * int(numbers[1]) if re.fullmatch(r"[0-9]{1,6}x[0-9]{1,6}", size) else 0


def _part(config: dict[str, Any], name: str) -> dict[str, Any]:
    """Return a section of a run's config, such as "train"; it is empty if the record lacks the section."""
    part = config.get(name)
    return part if isinstance(part, dict) else {}


def _count(frames: Any) -> int | None:
    """Return the number of frames in a range [first, last]; None if `frames` is not such a range."""
    if isinstance(frames, list) and len(frames) == 2 and all(isinstance(n, int) for n in frames):
        return int(frames[1] - frames[0] + 1)
    return None

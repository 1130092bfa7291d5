"""Provide the results in Tables 1 and 2 of the 7DGS paper, its protocol, and how a run departs from that protocol.

Source: Gao et al., "7DGS: Unified Spatial-Temporal-Angular Gaussian Splatting", ICCV 2025. Numbers that the paper lacks
are NaN. The paper's averages over a data set have the scene name "avg".
"""

import re
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from importlib import resources
from typing import Any

import pandas as pd

from gsbench.errors import printable
from gsbench.measure.record import Record
from gsbench.report.frame import iterations, value_at

AVERAGE = "avg"
MODELS = {"4dgs": False, "7dgs": True, "7dgs_noagr": False}  # the models of Table 1, and whether they have AGR


@dataclass(frozen=True)
class Protocol:
    """The settings with which the 7DGS paper trained and tested on a data set (section "implementation details")."""

    scenes: tuple[str, ...]  # as conf/exp names them
    sizes: dict[str, str]  # image size by scene, "*" for all other scenes
    batch_size: int
    splits: dict[str, str]  # evaluated split by scene, "*" for all other scenes
    frames: int | None = None  # of each scene; None if the data set defines its frames
    iterations: int = 30_000

    def size(self, scene: str) -> str:
        """Return the size of a scene's images, such as "400x400"."""
        return self.sizes.get(scene, self.sizes["*"])

    def split(self, scene: str) -> str:
        """Return the split on which a scene is evaluated."""
        return self.splits.get(scene, self.splits["*"])


PROTOCOLS = {
    "7DGS-PBR": Protocol(
        scenes=("heart1", "heart2", "cloud", "dust", "flame", "suzanne"),
        sizes={"heart1": "500x500", "*": "800x800"},  # half of 1000x1000 and 1600x1600
        batch_size=4,
        splits={"*": "test"},
    ),
    "D-NeRF": Protocol(
        scenes=("bouncingballs", "hellwarrior", "hook", "jumpingjacks", "lego", "mutant", "standup", "trex"),
        sizes={"*": "400x400"},  # half of 800x800
        batch_size=4,
        splits={"lego": "val", "*": "test"},  # published code measures lego on val: its test split is wrong
    ),
    "Technicolor": Protocol(
        scenes=("Birthday", "Fabien", "Painter", "Theater", "Train"),
        sizes={"*": "2048x1088"},
        batch_size=1,
        splits={"*": "test"},
        frames=50,
    ),
}


@cache
def table1() -> pd.DataFrame:
    """Return Table 1, a row for each data set, scene in lower case (or "avg") and model, which are the index.

    PSNR is the best on test during training. The paper does not say on which network its LPIPS is. Minutes and FPS are
    of one V100.
    """
    return read_table("paper_table1.csv").set_index(["dataset", "scene", "model"]).sort_index()


def average(dataset: str, scenes: list[str], model: str) -> pd.Series:
    """Return the paper's numbers of a model, averaged over scenes; empty if it lacks one of them.

    Example: ``average("D-NeRF", ["trex"], "7dgs").psnr_db``.
    """
    keys = [(dataset, scene.lower(), model) for scene in scenes]  # Technicolor's folders are named Birthday, ..
    if not keys or not all(key in table1().index for key in keys):
        return pd.Series(dtype=float)
    return table1().loc[keys].mean(skipna=False).rename({"lpips": "lpips_alex"})  # shown there, as it names no network


def read_table(name: str) -> pd.DataFrame:
    """Read a CSV file that lies in the folder of this module."""
    with (resources.files(__package__) / name).open() as file:
        return pd.read_csv(file)


def departure(record: Record) -> str:
    """Return the names of the settings in which a run differs from the 7DGS paper's protocol; "" if there are none."""
    protocol = PROTOCOLS.get(record.dataset)
    if protocol is None or record.protocol.get("paper_dataset") != record.dataset:
        return "data"
    if record.scene not in protocol.scenes:
        return "scene"
    frames = value_at(record, "provenance.config.scene.frames")
    settings: dict[str, tuple[Any, Any]] = {
        "size": (record.protocol.get("resolution"), protocol.size(record.scene)),
        "filter": (record.protocol.get("resize"), None),
        "split": (record.protocol.get("eval_split"), protocol.split(record.scene)),
        "background": (record.protocol.get("background"), "black"),
        "quantisation": (record.protocol.get("quantise"), False),
        "iterations": (iterations(record), protocol.iterations),
        "batch size": (value_at(record, "provenance.config.train.batch_size"), protocol.batch_size),
        "frames": (_count(frames), protocol.frames),
    }
    if record.status != "ok" and record.protocol.get("resolution") == "not loaded":
        del settings["size"]  # a run that failed before it saw an image
    return ", ".join(name for name, (of_run, of_paper) in settings.items() if of_run != of_paper)


def relative_size(record: Record) -> str:
    """Return the width of a run's images divided by the paper's, such as "1/2"; if there is none, their size."""
    protocol = PROTOCOLS.get(str(record.protocol.get("paper_dataset")))
    size = str(record.protocol.get("resolution", "a size not recorded"))
    width = re.fullmatch(r"([0-9]{1,6})x[0-9]{1,6}", size)
    if protocol is None or width is None:
        return printable(size)
    return str(Fraction(int(width[1]), int(protocol.size(record.scene).partition("x")[0])))


def _count(frames: Any) -> int | None:
    """Return the number of frames in a range [first, last]; None if `frames` is not such a range."""
    if isinstance(frames, list) and len(frames) == 2 and all(isinstance(n, int) for n in frames):
        return int(frames[1] - frames[0] + 1)
    return None

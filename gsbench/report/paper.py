"""Provide the numbers of Tables 1 and 2 of the 7DGS paper and their protocol, for comparison.

Source: Gao et al., "7DGS: Unified Spatial-Temporal-Angular Gaussian Splatting", ICCV 2025. A cell that the paper leaves
empty is None. The paper's averages are rows of the scene "avg".
"""

import csv
from dataclasses import dataclass
from functools import cache
from importlib import resources

AVERAGE = "avg"
MODELS = {"4dgs": False, "7dgs": True, "7dgs_noagr": False}  # the models of Table 1, and whether they have AGR


@dataclass(frozen=True)
class Protocol:
    """How the paper trained and tested on a data set (its section "implementation details")."""

    scenes: tuple[str, ...]  # as conf/exp names them
    sizes: dict[str, str]  # of the images, by scene, "*" for all others
    batch_size: int
    splits: dict[str, str]  # by scene, "*" for all others
    frames: int | None = None  # of each scene; None: the data set has its own list
    iterations: int = 30_000


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


@dataclass(frozen=True)
class PaperRow:
    """One row of Table 1: a model on a scene."""

    psnr: float  # dB, the best on test during training
    ssim: float
    lpips: float  # the paper does not say on which backbone
    train_min: float | None  # minutes on one V100
    fps: float  # on one V100
    num_gaussians: int


@dataclass(frozen=True)
class MethodRow:
    """One row of Table 2: a method's average over a data set."""

    method: str
    psnr: float
    ssim: float | None
    lpips: float | None
    reproduced_by_paper: bool  # rather than quoted from the method's own paper


def paper_row(dataset: str, scene: str, model: str) -> PaperRow | None:
    """Return a row of Table 1, such as ``paper_row("D-NeRF", "trex", "7dgs")``; None if the paper has no such row."""
    return table1().get((dataset, scene.lower(), model))  # Technicolor's folders are named Birthday, ..


@cache
def table1() -> dict[tuple[str, str, str], PaperRow]:
    """Return Table 1 by data set ("7DGS-PBR", "D-NeRF", "Technicolor"), scene (or "avg") and model."""
    return {
        (row["dataset"], row["scene"], row["model"]): PaperRow(
            psnr=float(row["psnr_db"]),
            ssim=float(row["ssim"]),
            lpips=float(row["lpips"]),
            train_min=_number(row["train_min"]),
            fps=float(row["fps"]),
            num_gaussians=int(row["num_gaussians"]),
        )
        for row in _read("paper_table1.csv")
    }


@cache
def table2() -> dict[str, list[MethodRow]]:
    """Return Table 2 by data set ("D-NeRF", "Technicolor"), in the paper's order."""
    table: dict[str, list[MethodRow]] = {}
    for row in _read("paper_table2.csv"):
        reproduced = row["reproduced_by_paper"] == "yes"
        method = MethodRow(
            row["method"], float(row["psnr_db"]), _number(row["ssim"]), _number(row["lpips"]), reproduced
        )
        table.setdefault(row["dataset"], []).append(method)
    return table


def _number(cell: str) -> float | None:
    return float(cell) if cell else None


def _read(name: str) -> list[dict[str, str]]:
    """Read the rows of a CSV file beside this module."""
    return list(csv.DictReader((resources.files(__package__) / name).read_text().splitlines()))

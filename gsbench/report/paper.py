"""Provide the results in Tables 1 and 2 of the 7DGS paper and its protocol, for comparison with measured runs.

Source: Gao et al., "7DGS: Unified Spatial-Temporal-Angular Gaussian Splatting", ICCV 2025. A cell that is empty in the
paper is None. The paper's averages over a data set have the scene name "avg".
"""

import csv
from dataclasses import dataclass
from functools import cache
from importlib import resources

import pandas as pd

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
    """One row of Table 1 in the 7DGS paper: the results of a model on a scene."""

    psnr: float  # dB, the best on test during training
    ssim: float
    lpips: float  # the paper does not say on which backbone
    train_min: float | None  # minutes on one V100
    fps: float  # on one V100
    num_gaussians: int


@dataclass(frozen=True)
class MethodRow:
    """One row of Table 2 in the 7DGS paper: the average results of a method over a data set."""

    method: str
    psnr: float
    ssim: float | None
    lpips: float | None
    source: str  # reproduced by the 7DGS paper; quoted; retrained: quoted from Ex4DGS, which trained the method again


def paper_row(dataset: str, scene: str, model: str) -> PaperRow | None:
    """Return a row of the 7DGS paper's Table 1, or None if there is no such row.

    Example: ``paper_row("D-NeRF", "trex", "7dgs")``.
    """
    return table1().get((dataset, scene.lower(), model))  # Technicolor's folders are named Birthday, ..


def average(dataset: str, scenes: list[str], model: str) -> pd.Series | None:
    """Return the paper's numbers of a model, averaged over scenes; None if it lacks one of them."""
    rows = [paper_row(dataset, scene, model) for scene in scenes]
    if not rows or None in rows:
        return None
    names = {"lpips": "lpips_alex", "psnr": "psnr_db", "num_gaussians": "gaussians"}
    return pd.DataFrame([vars(row) for row in rows]).astype(float).rename(columns=names).mean(skipna=False)


@cache
def table1() -> dict[tuple[str, str, str], PaperRow]:
    """Return Table 1 of the 7DGS paper, by data set, scene (or "avg") and model.

    The data sets are "7DGS-PBR", "D-NeRF" and "Technicolor".
    """
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
    """Return Table 2 of the 7DGS paper: for "D-NeRF" and "Technicolor" the rows of all methods in the paper's order."""
    table: dict[str, list[MethodRow]] = {}
    for row in _read("paper_table2.csv"):
        method = MethodRow(
            row["method"], float(row["psnr_db"]), _number(row["ssim"]), _number(row["lpips"]), row["source"]
        )
        table.setdefault(row["dataset"], []).append(method)
    return table


def _number(cell: str) -> float | None:
    return float(cell) if cell else None


def _read(name: str) -> list[dict[str, str]]:
    """Read the rows of a CSV file that lies in the folder of this module."""
    return list(csv.DictReader((resources.files(__package__) / name).read_text().splitlines()))

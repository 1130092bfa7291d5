"""Measure the condition numbers of the covariance factors in a trained model."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from torch import Tensor

from gsbench.errors import InputError
from gsbench.models.factors import Triangle, rotation4d, sizes
from gsbench.models.slicing import reduce, subtract
from gsbench.stability.plots import save
from gsbench.stability.population import Floats
from gsbench.train import checkpoint

FILE_NAME = "spectrum.png"
PERCENTILES = (50, 90, 99, 99.9, 100)
OBSERVED = {1: "t", 3: "ddd", 4: "dddt"}  # time and direction in the default order of rows, by their number


def measure(path: Path) -> dict[str, Floats]:
    """Return the condition numbers of each Gaussian's covariance factors in a checkpoint.

    There are two factors: that of the full covariance (4D, 6D or 7D), and that of the conditional 3D covariance. Both
    are computed from the trained parameters, without AGR (the neural refinement).

    Raises:
        InputError: the file is not a checkpoint, or its model is 3DGS, which has no conditional Gaussians.
    """
    joint = _joint(path)
    sliced, size = reduce(joint).T_pp, joint.shape[-1]
    return {f"joint factor, {size} x {size}": _condition(joint), "sliced factor, 3 x 3": _condition(sliced)}


def failures(path: Path) -> dict[str, tuple[float, float]]:
    """Measure the float32 errors of the methods `schur` and `cholesky` on the Gaussians of a checkpoint.

    Both methods compute conditional covariances by a subtraction. Return, for each of them, the share of indefinite
    conditional covariances and the 99th percentile of relative errors.
    """
    joint = _joint(path)
    exact = reduce(joint).T_pp
    exact = exact @ exact.mT
    found = {}
    for scheme in ("schur", "cholesky"):
        cov = subtract(joint.float(), scheme)[1].double()
        error = (cov - exact).norm(dim=(1, 2)) / exact.norm(dim=(1, 2))
        found[scheme] = (float((torch.linalg.eigvalsh(cov)[:, 0] < 0).double().mean()), float(error.quantile(0.99)))
    return found


def _joint(path: Path) -> Tensor:
    state: dict[str, Any] = checkpoint.read(path).state.get("model", {})
    splats = {name.removeprefix("splats."): value.double() for name, value in state.items() if name[:7] == "splats."}
    joint = _joint_factors(splats)
    if joint is None:
        raise InputError(f"{path}: expected a checkpoint of 4dgs, 6dgs or 7dgs, got parameters {sorted(splats)}")
    return joint


def _joint_factors(splats: dict[str, Tensor]) -> Tensor | None:
    """Return the factors [N, 3+k, 3+k] from the raw parameters of a model; None if it has no such covariance.

    The first three rows are position, and the k others time and direction. The model must store its factors in the
    default row order.
    """
    if "log_diagonal" in splats:
        k = splats["log_diagonal"].shape[1] - 3
        L = Triangle(OBSERVED[k] + "ppp").factor(splats["log_diagonal"], splats)
        return torch.cat([L[:, k:], L[:, :k]], 1)
    if "left_quats" in splats:
        R = rotation4d(splats["left_quats"], splats["right_quats"])
        return R * sizes(splats["scales"])[:, None, :]
    return None


def report(found: dict[str, Floats]) -> str:
    """Return percentiles of condition numbers as a Markdown table."""
    lines = [f"| condition number of | {' | '.join(f'{p:g} %' for p in PERCENTILES)} |",
             "| --- |" + " ---: |" * len(PERCENTILES)]  # fmt: skip
    for name, values in found.items():
        lines.append(f"| {name} | {' | '.join(f'{x:.1e}' for x in np.percentile(values, PERCENTILES))} |")
    return "\n".join(lines)


def draw(found: dict[str, Floats], folder: Path, title: str) -> Path:
    """Write a histogram of condition numbers to `folder`; return its path."""

    def histogram(axes: Axes) -> None:
        most = max(float(values.max()) for values in found.values())
        bins = np.logspace(0, np.log10(most) + 0.1, 60)
        for name, values in found.items():
            axes.hist(values, bins=bins.tolist(), alpha=0.6, label=name)
        axes.set(xscale="log", xlabel="condition number", ylabel="Gaussians", title=title)
        axes.legend()

    save(folder / FILE_NAME, histogram)
    return folder / FILE_NAME


def _condition(factors: Tensor) -> Floats:
    return np.asarray(np.linalg.cond(factors.numpy()), np.float64)

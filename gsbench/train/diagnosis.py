"""Explain why a training diverged: find a Gaussian with a non-finite gradient, and name what is unusual about it."""

import math

import torch

from gsbench.kernels.headers import LOG_SIZE_MAX
from gsbench.models import GaussianModel

THIN = -10.0  # log of a size in time; e^-10 of a scene's length is less than a frame
NEEDLE = math.log(1e5)  # log ratio of the largest to the smallest size
FAR = 1e3  # in units of the scene's extent
LOUD = 1e3  # absolute value of a colour coefficient


def explain(model: GaussianModel) -> str:
    """Name the first Gaussian with a NaN or infinite gradient, and a case of the audit with such Gaussians."""
    for name, parameter in model.splats.items():
        if parameter.grad is None:
            continue
        bad = ~parameter.grad.reshape(len(parameter), math.prod(parameter.shape[1:])).isfinite().all(1)
        if bad.any():
            index = int(bad.nonzero()[0])
            case = resembles(model, index)
            like = f"it resembles the stability case '{case}'" if case else "it resembles no stability case"
            return f"the first is Gaussian {index} of {len(parameter)} in '{name}' ({int(bad.sum())} in all): {like}"
    where = "AGR's networks or lambda" if model.refinement is not None else "the learning rates"
    return f"no Gaussian's gradient is: look at {where}"


@torch.no_grad()
def resembles(model: GaussianModel, index: int) -> str | None:
    """Return the name of a case of `make stability` whose Gaussians are as extreme as this one, or None."""
    raw = {name: parameter[index].flatten() for name, parameter in model.splats.items()}
    if not all(value.isfinite().all() for value in raw.values()):
        return "learning_rates_times_30"  # the previous step was too long
    sizes, in_time = model.log_sizes(index), model.log_duration(index)
    colors = torch.cat([raw[name] for name in ("sh0", "shN") if name in raw])
    lambdas = [float(value) for value in model.log_lambda.parameters()]
    checks = {
        "refinement_pushes_sizes": float(sizes.abs().amax()) > LOG_SIZE_MAX,
        "instant": in_time is not None and in_time < THIN,
        "static": in_time is not None and in_time > -THIN,
        "needle": float(sizes.amax() - sizes.amin()) > NEEDLE,
        "vanishing_quaternion": any(float(raw[q].norm()) < 1e-5 for q in raw if q.endswith("quats")),
        "direction_off_the_sphere": "directions" in raw and float(raw["directions"].norm()) > 10,
        "larger_than_the_scene": float(sizes.amax()) > math.log(FAR * max(model.extent, 1e-3)),
        "far_off_axis": float(raw["means"].norm()) > FAR * max(model.extent, 1e-3),
        "loud_harmonics": bool((colors.abs() > LOUD).any()),
        "oversensitive": any(value > math.log(1e3) for value in lambdas),
        "insensitive": any(value < math.log(1e-6) for value in lambdas),
    }
    return next((name for name, found in checks.items() if found), None)

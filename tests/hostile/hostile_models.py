"""Build models with hostile options, and slice and render them at hostile queries."""

import random
from typing import Any

import torch
from tensors import disturb
from workers import Case

from gsbench import models
from gsbench.models.camera_time import CameraTime
from gsbench.models.render import render
from gsbench.scenes.points import random_points
from gsbench.scenes.scene import Camera

OPTIONS: dict[str, dict[str, Any]] = {
    "3dgs": {},
    "4dgs": {"time_degree": 2, "scheme": "square_root", "lambda_t": 1.0},
    "6dgs": {"lambda_d": 0.5, "factor_order": "paper", "scheme": "schur", "off_diagonal": "raw"},
    "7dgs": {"lambda_d": 0.5, "lambda_t": 0.5, "directional_half": True},
}
COMMON: dict[str, Any] = {"agr": True, "agr_octaves": 4, "sh_degree": 2}
VALUES = (None, True, False, 0, 1, -1, 3, 4, 33, 10**30, 0.0, 0.5, 1e-300, 1e300, 1.0, float("nan"), float("inf"), "no",
          "", "schur", "cholesky", "paper", "relative", [], {}, torch.tensor(1.0), torch.zeros(3))  # fmt: skip
NAMES = ("", "3DGS", "8dgs", None, 7, "__init__", "../base")


def draw_model(r: random.Random) -> Case:
    """Draw a model's options and the query at which it is rendered, one of them hostile."""
    name: Any = r.choice(list(OPTIONS))
    options = OPTIONS[name] | COMMON
    time: Any = 0.5
    center: Any = torch.tensor([0.0, 0.0, -4.0])
    kind = r.choice(("nothing", "name", "option", "option", "option", "unknown option", "time", "center"))
    what = ""
    if kind == "name":
        name = r.choice(NAMES)
    if kind == "option":
        what = r.choice(list(options))
        options[what] = r.choice(VALUES)
        what += f"={options[what]!r}"
    if kind == "unknown option":
        options["nosuch"] = 1
    if kind == "time":
        time = r.choice((None, 2.0, -1e30, float("nan"), float("inf"), "now", torch.zeros(2), torch.tensor(1), []))
        what = repr(time)
    if kind == "center":
        center, what = disturb(r, center)

    def call() -> None:
        model = models.build(name, **options)
        random_generator = torch.Generator().manual_seed(0)
        model.initialise(random_points(20, 1.0, random_generator), 1.0, random_generator)
        model.slice(CameraTime.at(center, time))
        viewmat = torch.eye(4)
        viewmat[2, 3] = 4.0
        K = torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]])
        image = render(model, Camera(viewmat, K, 16, 16), time, torch.zeros(3))
        assert image.shape == (16, 16, 3)
        assert image.isfinite().all()
        image.sum().backward()
        assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())

    return Case(f"model {name!r} with a hostile {kind} {what}", call)

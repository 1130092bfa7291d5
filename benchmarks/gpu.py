"""Measure the CUDA backend beside gsplat in one process: python -m benchmarks.gpu; JSON and Markdown in results.

The raster alone on equal Gaussians, whole frames of models (ours fused; theirs slices in torch and draws by gsplat), a
step of training, and the loss. Without gsplat its columns stay empty, and why is said. A case that fails is a row that
says so. `--device cpu` is a rehearsal: small sizes, the CPU's backend.
"""

import argparse
import itertools
import json
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from benchmarks.rows import useful_alphas
from benchmarks.scene import camera, gaussians, model
from gsbench.kernels.loss import l1_ssim
from gsbench.measure.atomic import write_atomically
from gsbench.measure.provenance import git_commit, processor_name, versions
from gsbench.models import GaussianModel
from gsbench.models.factors import rotation
from gsbench.raster import rasterize
from gsbench.train.losses import photometric

COLUMNS = ("section", "case", "pass", "ours_ms", "theirs_ms", "ratio", "ours_mib", "theirs_mib", "ours_gb_s",
           "ours_galpha_s", "difference", "failed")  # fmt: skip
TIME = 0.4  # at which models are seen
Call = Callable[[], Any]
Row = dict[str, Any]


class Cost(NamedTuple):
    """Milliseconds of a call, and the MiB it holds at most beside what was there before (0 on the CPU)."""

    ms: float  # median
    p10: float
    p90: float
    mib: float

    @classmethod
    def of(cls, times: list[float], peak: int) -> "Cost":
        deciles = statistics.quantiles(times, n=10, method="inclusive")
        return cls(statistics.median(times), deciles[0], deciles[-1], peak / 2**20)


@dataclass
class Place:
    """Where is measured, and against what. Not torch's default device: that would cost a microsecond an operation."""

    device: str
    gsplat: bool = False

    @property
    def on_gpu(self) -> bool:
        return self.device == "cuda"

    def put(self, tensors: tuple[Tensor, ...]) -> list[Tensor]:
        return [x.to(self.device) for x in tensors]

    def cost(self, call: Call, repeats: int = 30) -> Cost:
        """Time a call after a few to warm up; on a GPU by events, the device waited for between calls."""
        for _ in range(5 if self.on_gpu else 1):
            call()
        if not self.on_gpu:
            return Cost.of([1e3 * timed(call) for _ in range(3)], 0)
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        held, times = torch.cuda.memory_allocated(), []
        for _ in range(repeats):
            start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            torch.cuda.synchronize()
            start.record()
            call()
            end.record()
            torch.cuda.synchronize()
            times.append(start.elapsed_time(end))
        return Cost.of(times, torch.cuda.max_memory_allocated() - held)


def timed(call: Call) -> float:
    began = time.perf_counter()
    call()
    return time.perf_counter() - began


@dataclass
class Case:
    """What is compared: two ways to the same picture, each with what it has gradients by."""

    section: str
    name: str
    ours: Call
    theirs: Call
    leaves: list[Tensor]
    their_leaves: list[Tensor]
    least_bytes: float | None = None  # that forward cannot do without
    least_alphas: float | None = None  # of at least 1/255

    def rows(self, place: Place) -> Iterator[Row]:
        """Forward without a graph, backward on a graph that is kept, and both."""
        passes = {"forward": 1, "backward": 2, "both": 3}  # a backward moves and blends everything about twice
        ours = self.costs(place, self.ours, self.leaves)
        theirs = self.costs(place, self.theirs, self.their_leaves) if place.gsplat else [None] * len(passes)
        with torch.no_grad():
            difference = (self.ours() - self.theirs()).abs().mean().item() if place.gsplat else None
        for (way, times), mine, other in zip(passes.items(), ours, theirs, strict=True):
            yield compared(self.section, self.name, way, mine, other) | {
                "ours_gb_s": self.least_bytes and times * self.least_bytes / mine.ms / 1e6,
                "ours_galpha_s": self.least_alphas and times * self.least_alphas / mine.ms / 1e6,
                "difference": difference,
            }

    @staticmethod
    def costs(place: Place, call: Call, leaves: list[Tensor]) -> list[Cost]:
        image = call()
        upstream = torch.ones_like(image)

        def both() -> None:
            torch.autograd.grad(call(), leaves, upstream, allow_unused=True)

        backward = place.cost(
            lambda: torch.autograd.grad(image, leaves, upstream, retain_graph=True, allow_unused=True)
        )
        return [place.cost(torch.no_grad()(call)), backward, place.cost(both)]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu", description=__doc__)
    parser.add_argument("--device", default="cuda", choices=["cuda", "cpu"])
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="folder of the results")
    options = parser.parse_args()
    place = Place(options.device)
    missing = why_no_gsplat(place) if place.on_gpu else "this is a rehearsal"
    if missing:
        print(f"gsplat is left out: {missing}", flush=True)
    place.gsplat = not missing
    machine = conditions(place) | {"gsplat": version_of("gsplat") if place.gsplat else None, "no_gsplat": missing}
    name = "gpu" if place.on_gpu else "gpu_rehearsal"
    rows: list[Row] = []
    for row in itertools.chain(raster_rows(place), frame_rows(place), step_rows(place), loss_rows(place)):
        rows.append(row)
        print("  ".join(f"{key} {text(row[key])}" for key in COLUMNS if row.get(key) is not None), flush=True)
        write(options.out, name, machine, rows)  # after every row: what is known if time runs out
    sys.exit(any("failed" in row for row in rows))


def raster_rows(place: Place) -> Iterator[Row]:
    """The rasterizer alone: ours by factors, gsplat by quaternions and scales, its faster way."""
    sizes = [(1_000, 64)] if not place.on_gpu else itertools.product((10_000, 100_000, 1_000_000), (400, 800, 1600))
    for N, size in sizes:
        case = f"{N} / {size}x{size}"
        yield from attempted(lambda a=(place, case, N, size): raster_case(*a), case, "raster", place)


def raster_case(place: Place, case: str, N: int, size: int) -> Case:
    means, factors, opacities, colors = place.put(gaussians(N))
    quats = torch.randn(N, 4, generator=torch.Generator().manual_seed(0)).to(means)
    viewmats, Ks = place.put(camera(size))
    scales = factors.norm(dim=1)
    shared = [x.requires_grad_() for x in (means, opacities, colors)]
    equal = (rotation(quats) * scales[:, None]).requires_grad_()
    quats.requires_grad_()
    scales.requires_grad_()

    def ours() -> Tensor:
        return rasterize(means, equal, opacities, colors, viewmats, Ks, size, size).image

    def theirs() -> Tensor:
        return gsplat_image(means, quats, scales, opacities, colors, viewmats=viewmats, Ks=Ks, size=size)

    # 16 floats a Gaussian and four a pixel.
    return Case("raster", case, ours, theirs, [*shared, equal], [*shared, quats, scales],
                4.0 * (16 * N + 4 * size * size), useful_alphas(N, size))  # fmt: skip


def frame_rows(place: Place) -> Iterator[Row]:
    """Whole frames from a model's parameters to a picture, and the gradients of all parameters."""
    N, sizes = (500, (48,)) if not place.on_gpu else (100_000, (400, 800))
    for name, agr, size in itertools.product(("4dgs", "6dgs", "7dgs"), (False, True), sizes):
        case = f"{name} {'with' if agr else 'without'} AGR, {N} / {size}x{size}"
        yield from attempted(lambda a=(place, case, name, agr, N, size): frame_case(*a), case, "frame", place)


def frame_case(place: Place, case: str, name: str, agr: bool, N: int, size: int) -> Case:
    fitted = model(name, N, agr=agr).to(place.device)
    parameters = [p for p in fitted.parameters() if p.requires_grad]
    return Case("frame", case, *two_ways(place, fitted, size), parameters, parameters)


def two_ways(place: Place, fitted: GaussianModel, size: int) -> tuple[Call, Call]:
    """A model's picture by our kernels, and by slicing in torch and drawing by gsplat."""
    viewmats, Ks = place.put(camera(size))
    center = -(viewmats[0, :3, :3].T @ viewmats[0, :3, 3])

    def ours() -> Tensor:
        fitted.backend = "auto"
        return rasterize(*fitted.slice(center, TIME), viewmats, Ks, size, size).image

    def theirs() -> Tensor:
        fitted.backend = "reference"
        seen = fitted.slice(center, TIME)
        covars = seen.factors @ seen.factors.mT
        return gsplat_image(seen.means, None, None, seen.opacities, seen.colors, covars=covars, viewmats=viewmats,
                            Ks=Ks, size=size)  # fmt: skip

    return ours, theirs


def step_rows(place: Place) -> Iterator[Row]:
    """A step of training on one view: frame, L1 + SSIM (ours fused, theirs torch), gradients, Adam (fused in both)."""
    N, sizes = (500, (48,)) if not place.on_gpu else (100_000, (400, 800))
    for agr, size in itertools.product((False, True), sizes):
        case = f"7dgs {'with' if agr else 'without'} AGR, {N} / {size}x{size}"
        try:
            ours, theirs = steps(place, agr, N, size)
            yield compared("step", case, "all", place.cost(ours), place.cost(theirs) if place.gsplat else None)
        except Exception as error:
            yield failure("step", case, error)


def steps(place: Place, agr: bool, N: int, size: int) -> list[Call]:
    found: list[Call] = []
    target = torch.rand(1, size, size, 3, device=place.device)
    for k, loss in enumerate((l1_ssim, lambda a, b, w: photometric(a, b, w, "reference"))):
        fitted = model("7dgs", N, agr=agr).to(place.device)
        picture = two_ways(place, fitted, size)[k]
        adam = torch.optim.Adam(fitted.parameters(), lr=1e-5, eps=1e-15, fused=True)

        def step(picture: Call = picture, loss: Any = loss, adam: torch.optim.Adam = adam) -> None:
            loss(picture()[0], target[0], 0.2).backward()
            adam.step()
            adam.zero_grad(set_to_none=True)

        found.append(step)
    return found


def loss_rows(place: Place) -> Iterator[Row]:
    """L1 + SSIM forward and backward, against torch's own operations."""
    for size in (32,) if not place.on_gpu else (400, 800, 1600):
        image, target = (torch.rand(size, size, 3, device=place.device) for _ in range(2))
        image.requires_grad_()
        ours = place.cost(lambda a=image, b=target: torch.autograd.grad(l1_ssim(a, b, 0.2), a))
        theirs = place.cost(lambda a=image, b=target: torch.autograd.grad(photometric(a, b, 0.2, "reference"), a))
        yield compared("loss", f"{size}x{size}, theirs is torch", "both", ours, theirs)


def attempted(case: Callable[[], Case], name: str, section: str, place: Place) -> Iterator[Row]:
    """The rows of a case, or one that says how it failed: the others are still measured."""
    try:
        yield from case().rows(place)
    except Exception as error:
        yield failure(section, name, error)


def failure(section: str, case: str, error: Exception) -> Row:
    return {"section": section, "case": case, "failed": f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"}


def compared(section: str, case: str, way: str, ours: Cost, theirs: Cost | None) -> Row:
    row: Row = {"section": section, "case": case, "pass": way}
    for who, found in (("ours", ours), ("theirs", theirs)):
        if found is not None:
            row |= {f"{who}_{name}": value for name, value in found._asdict().items()}
    return row | ({"ratio": theirs.ms / ours.ms} if theirs else {})


def why_no_gsplat(place: Place) -> str | None:
    """None where gsplat draws; its kernels may be compiled here, on first use."""
    try:
        means, factors, opacities, colors, viewmats, Ks = place.put((*gaussians(10), *camera(16)))
        quats, scales = torch.ones(10, 4, device=place.device), factors.norm(dim=1)
        gsplat_image(means, quats, scales, opacities, colors, viewmats=viewmats, Ks=Ks, size=16)
    except Exception as error:  # not installed, not built for this torch, no compiler, ..
        return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
    return None


def gsplat_image(means: Tensor, quats: Any, scales: Any, opacities: Tensor, colors: Tensor, *, viewmats: Tensor,
                 Ks: Tensor, size: int, covars: Tensor | None = None) -> Tensor:  # fmt: skip
    """The same picture by gsplat, not packed: the faster way for one camera that sees most Gaussians."""
    import gsplat

    image, _, _ = gsplat.rasterization(means, quats, scales, opacities, colors, viewmats, Ks, size, size,
                                       covars=covars, packed=False)  # fmt: skip
    return image


def conditions(place: Place) -> dict[str, Any]:
    """Where: the device, its measured rates, and the versions."""
    found: dict[str, Any] = {"processor": processor_name(), "git_commit": git_commit(), "versions": versions()}
    if place.on_gpu:
        a, b = torch.empty(2, 1 << 28, device=place.device).unbind()  # 1 GiB each, far beyond any cache
        square = torch.rand(8192, 8192, device=place.device)
        found["device"] = torch.cuda.get_device_name()
        found["copy_gb_s"] = 2 * a.numel() * 4 / place.cost(lambda: b.copy_(a)).ms / 1e6
        found["float32_tflop_s"] = 2 * 8192**3 / place.cost(lambda: square @ square, 5).ms / 1e9
    return found


def version_of(package: str) -> str:
    return str(getattr(sys.modules[package], "__version__", "?"))


def write(folder: Path, name: str, machine: dict[str, Any], rows: list[Row]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / f"{name}.json", json.dumps({"machine": machine, "rows": rows}, indent=1).encode())
    write_atomically(folder / f"{name}.md", table(machine, rows).encode())


def table(machine: dict[str, Any], rows: list[Row]) -> str:
    gsplat = f"gsplat {machine['gsplat']}" if machine["gsplat"] else f"without gsplat ({machine['no_gsplat']})"
    lines = [
        f"# The CUDA backend on {machine.get('device', 'a CPU (rehearsal)')}",
        "",
        f"Commit {machine['git_commit']}, {gsplat}. Measured peaks: a copy moves",
        f"{text(machine.get('copy_gb_s'))} GB/s, products {text(machine.get('float32_tflop_s'))} float32 TFLOP/s.",
        "Median milliseconds; ratio = theirs / ours; ours_gb_s: the bytes that cannot be spared over the time;",
        "ours_galpha_s: likewise alphas of at least 1/255; difference: mean over the picture between ours and theirs.",
        "",
        "| " + " | ".join(COLUMNS) + " |",
        "| --- | --- | --- |" + " ---: |" * (len(COLUMNS) - 3),
    ]
    lines += ["| " + " | ".join(text(row.get(name)).replace("|", "/") for name in COLUMNS) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def text(value: Any) -> str:
    return "" if value is None else f"{value:.3f}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()

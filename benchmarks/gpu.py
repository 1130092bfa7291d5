"""Measure the CUDA backend beside gsplat in one process: python -m benchmarks.gpu; JSON and Markdown in results.

Raster alone on equal Gaussians, whole frames of models (ours fused; theirs torch slicing and gsplat), a training step,
and the loss. Without gsplat its columns stay empty. `--device cpu` is a rehearsal: small sizes, the CPU's backend.
"""

import argparse
import importlib.util
import itertools
import json
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.scene import camera, gaussians, model
from gsbench.kernels.loss import l1_ssim
from gsbench.measure.atomic import write_atomically
from gsbench.measure.provenance import git_commit, processor_name, versions
from gsbench.models.factors import rotation
from gsbench.raster import rasterize
from gsbench.train.losses import photometric

COLUMNS = (
    "section",
    "case",
    "pass",
    "ours_ms",
    "theirs_ms",
    "ratio",
    "ours_mib",
    "theirs_mib",
    "ours_gb_s",
    "difference",
)
Call = Callable[[], Any]
Row = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu", description=__doc__)
    parser.add_argument("--device", default="cuda", choices=["cuda", "cpu"])
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="folder of the results")
    options = parser.parse_args()
    rehearsal = options.device == "cpu"
    torch.set_default_device(options.device)
    machine = conditions(options.device)
    print(json.dumps(machine, indent=1), flush=True)
    rows: list[Row] = []
    for row in itertools.chain(raster_rows(rehearsal), frame_rows(rehearsal), loss_rows(rehearsal)):
        rows.append(row)
        print("  ".join(f"{name} {text(row.get(name))}" for name in COLUMNS), flush=True)
    options.out.mkdir(parents=True, exist_ok=True)
    name = "gpu_rehearsal" if rehearsal else "gpu"
    content = json.dumps({"machine": machine, "rows": rows}, indent=1)
    write_atomically(options.out / f"{name}.json", content.encode())
    write_atomically(options.out / f"{name}.md", table(machine, rows).encode())


def raster_rows(rehearsal: bool) -> Iterator[Row]:
    """The rasterizer alone, forward and backward: ours by factors, gsplat by quaternions and scales, its faster way."""
    sizes = [(1_000, 64)] if rehearsal else itertools.product((10_000, 100_000, 1_000_000), (400, 800, 1600))
    for N, size in sizes:
        g = torch.Generator().manual_seed(0)
        means, factors, opacities, colors = (x.to(torch.get_default_device()) for x in gaussians_on_cpu(N))
        quats = torch.randn(N, 4, generator=g, device="cpu").to(means)
        scales = factors.norm(dim=1)
        viewmats, Ks = (x.to(means) for x in camera_on_cpu(size))
        inputs = [means, rotation(quats) * scales[:, None], opacities, colors]
        theirs = [means, quats, scales, opacities, colors]

        def ours(inputs: list[Tensor], viewmats: Tensor = viewmats, Ks: Tensor = Ks, size: int = size) -> Tensor:
            return rasterize(*inputs, viewmats, Ks, size, size).image

        def gsplat(inputs: list[Tensor], viewmats: Tensor = viewmats, Ks: Tensor = Ks, size: int = size) -> Tensor:
            return gsplat_image(*inputs, viewmats=viewmats, Ks=Ks, size=size)

        # The least to be moved: 16 floats a Gaussian and four a pixel, and in backward as much again, twice.
        least = 4 * (16 * N + 4 * size * size)
        yield from both_ways("raster", f"{N} / {size}x{size}", ours, inputs, gsplat, theirs, least)


def frame_rows(rehearsal: bool) -> Iterator[Row]:
    """Whole frames from a model's parameters to a picture, and those with the gradients of all parameters."""
    N, sizes = (500, (48,)) if rehearsal else (100_000, (400, 800))
    for name, agr, size in itertools.product(("4dgs", "6dgs", "7dgs"), (False, True), sizes):
        fitted = model_on_cpu(name, N, agr).to(torch.get_default_device())
        viewmats, Ks = (x.to(torch.get_default_device()) for x in camera_on_cpu(size))
        center = -(viewmats[0, :3, :3].T @ viewmats[0, :3, 3])
        parameters = [p for p in fitted.parameters() if p.requires_grad]

        def ours(_: list[Tensor], fitted: Any = fitted, at: Any = (center, viewmats, Ks, size)) -> Tensor:
            fitted.backend = "auto"
            return rasterize(*fitted.slice(at[0], 0.4), *at[1:3], at[3], at[3]).image

        def theirs(_: list[Tensor], fitted: Any = fitted, at: Any = (center, viewmats, Ks, size)) -> Tensor:
            fitted.backend = "reference"
            seen = fitted.slice(at[0], 0.4)
            covars = seen.factors @ seen.factors.mT
            return gsplat_image(seen.means, None, None, seen.opacities, seen.colors, covars=covars, viewmats=at[1],
                                Ks=at[2], size=at[3])  # fmt: skip

        case = f"{name} {'with' if agr else 'without'} AGR, {N} / {size}x{size}"
        yield from both_ways("frame", case, ours, parameters, theirs, parameters, None)


def loss_rows(rehearsal: bool) -> Iterator[Row]:
    """L1 + SSIM forward and backward, against torch's own operations."""
    for size in (32,) if rehearsal else (400, 800, 1600):
        image, target = torch.rand(size, size, 3).requires_grad_(), torch.rand(size, size, 3)
        ours = cost(lambda a=image, b=target: torch.autograd.grad(l1_ssim(a, b, 0.2), a))
        theirs = cost(lambda a=image, b=target: torch.autograd.grad(photometric(a, b, 0.2, "reference"), a))
        yield compared("loss", f"{size}x{size}, theirs is torch", "both", ours, theirs, None)


def both_ways(section: str, case: str, ours: Any, inputs: list[Tensor], theirs: Any, their_inputs: list[Tensor],
              least: int | None) -> Iterator[Row]:  # fmt: skip
    """Rows of one case: forward without a graph, and backward alone, which is both less forward with a graph."""
    found: dict[str, tuple[tuple[float, float], ...]] = {}
    for who, call, leaves in (("ours", ours, inputs), ("theirs", theirs, their_inputs)):
        if who == "theirs" and not has_gsplat():
            continue
        leaves = [x if isinstance(x, torch.nn.Parameter) else x.detach().requires_grad_() for x in leaves]

        def without(call: Any = call, leaves: list[Tensor] = leaves) -> None:
            with torch.no_grad():
                call(leaves)

        def with_gradients(call: Any = call, leaves: list[Tensor] = leaves) -> None:
            image = call(leaves)
            torch.autograd.grad(image, leaves, torch.ones_like(image), allow_unused=True)

        found[who] = cost(without), cost(with_gradients)
    difference = None
    if has_gsplat():
        with torch.no_grad():
            difference = (ours(inputs) - theirs(their_inputs)).abs().mean().item()
    for k, way in enumerate(("forward", "forward and backward")):
        pair = [found[who][k] if who in found else None for who in ("ours", "theirs")]
        assert pair[0] is not None
        yield compared(section, case, way, pair[0], pair[1], least and least * (1, 3)[k]) | {"difference": difference}


def compared(section: str, case: str, way: str, ours: tuple[float, float], theirs: tuple[float, float] | None,
             least: int | None) -> Row:  # fmt: skip
    row: Row = {"section": section, "case": case, "pass": way, "ours_ms": ours[0], "ours_mib": ours[1]}
    if theirs is not None:
        row |= {"theirs_ms": theirs[0], "theirs_mib": theirs[1], "ratio": theirs[0] / ours[0]}
    if least is not None:
        row["ours_gb_s"] = least / ours[0] / 1e6
    return row


def cost(call: Call, repeats: int = 30) -> tuple[float, float]:
    """Median milliseconds of a call, and peak MiB it holds beside what was there before (0 on the CPU)."""
    on_gpu = torch.get_default_device().type == "cuda"
    for _ in range(5):
        call()
    held = 0
    if on_gpu:
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        held = torch.cuda.memory_allocated()
    times = []
    for _ in range(repeats if on_gpu else 3):
        if on_gpu:
            start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            torch.cuda.synchronize()
            start.record()
            call()
            end.record()
            torch.cuda.synchronize()
            times.append(start.elapsed_time(end))
        else:
            began = time.perf_counter()
            call()
            times.append(1e3 * (time.perf_counter() - began))
    peak = torch.cuda.max_memory_allocated() - held if on_gpu else 0
    return statistics.median(times), peak / 2**20


def has_gsplat() -> bool:
    return torch.get_default_device().type == "cuda" and importlib.util.find_spec("gsplat") is not None


def gsplat_image(means: Tensor, quats: Any, scales: Any, opacities: Tensor, colors: Tensor, *, viewmats: Tensor,
                 Ks: Tensor, size: int, covars: Tensor | None = None) -> Tensor:  # fmt: skip
    """The same picture by gsplat, not packed: the faster way for one camera that sees most Gaussians."""
    import gsplat

    image, _, _ = gsplat.rasterization(means, quats, scales, opacities, colors, viewmats, Ks, size, size,
                                       covars=covars, packed=False)  # fmt: skip
    return image


def gaussians_on_cpu(N: int) -> tuple[Tensor, ...]:
    with torch.device("cpu"):
        return gaussians(N)


def camera_on_cpu(size: int) -> tuple[Tensor, Tensor]:
    with torch.device("cpu"):
        return camera(size)


def model_on_cpu(name: str, N: int, agr: bool) -> Any:
    with torch.device("cpu"):
        return model(name, N, agr=agr)


def conditions(device: str) -> dict[str, Any]:
    """Where: the device, its measured bandwidth, and the versions."""
    found: dict[str, Any] = {"processor": processor_name(), "git_commit": git_commit(), "versions": versions()}
    if device == "cuda":
        a, b = torch.empty(2, 1 << 28).unbind()  # 1 GiB each, far beyond any cache
        milliseconds, _ = cost(lambda: b.copy_(a))
        found |= {"device": torch.cuda.get_device_name(), "copy_gb_s": 2 * a.numel() * 4 / milliseconds / 1e6}
        found["gsplat"] = getattr(__import__("gsplat"), "__version__", "?") if has_gsplat() else None
    return found


def table(machine: dict[str, Any], rows: list[Row]) -> str:
    lines = [
        f"# The CUDA backend on {machine.get('device', 'a CPU (rehearsal)')}",
        "",
        f"Commit {machine['git_commit']}; a copy moves {text(machine.get('copy_gb_s'))} GB/s; gsplat "
        f"{machine.get('gsplat')}. Median milliseconds; ratio = theirs / ours; ours_gb_s: the bytes that cannot be",
        "spared over the time; difference: mean over the picture between ours and theirs.",
        "",
        "| " + " | ".join(COLUMNS) + " |",
        "| --- | --- | --- |" + " ---: |" * (len(COLUMNS) - 3),
    ]
    lines += ["| " + " | ".join(text(row.get(name)) for name in COLUMNS) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def text(value: Any) -> str:
    return "" if value is None else f"{value:.3f}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()

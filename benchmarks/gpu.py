"""Measure the CUDA backend beside gsplat in one process: python -m benchmarks.gpu; JSON and Markdown in results.

The raster alone on equal Gaussians, whole frames of models (ours fused; theirs slices in
torch and draws by gsplat), replayed frames, a step of training, and the loss. Without gsplat its columns stay empty,
and why is said. A case that fails is a row that says so. `--device cpu` is a rehearsal: small sizes, the CPU's kernels.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import torch

from benchmarks import gpu_rows, gsplat_way
from benchmarks.compare import Place, Row
from gsbench.measure.atomic import write_atomically
from gsbench.measure.machine import processor_name
from gsbench.measure.provenance import git_commit, versions

# How many times as fast as theirs ours is to be, on a Hopper-class card.
TARGETS = {("raster", "forward"): 1.3, ("raster", "backward"): 1.2, ("frame", "forward"): 3.0, ("step", "all"): 2.5}
AGR_TARGET = 0.2  # of a frame, at most
COLUMNS = (
    "section",
    "case",
    "pass",
    "ours_ms",
    "theirs_ms",
    "ratio",
    "ours_back_to_back",
    "theirs_back_to_back",
    "ratio_back_to_back",
    "target",
    "ours_mib",
    "theirs_mib",
    "ours_gb_s",
    "ours_galpha_s",
    "difference",
    "failed",
)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu", description=__doc__)
    parser.add_argument("--device", default="cuda", choices=["cuda", "cpu"])
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="folder of the results")
    options = parser.parse_args()
    place = Place(options.device)
    missing = gsplat_way.why_not(place) if place.on_gpu else "this is a rehearsal"
    if missing:
        print(f"gsplat is left out: {missing}", flush=True)
    place.gsplat = not missing
    machine = conditions(place) | {"gsplat": gsplat_way.version() if place.gsplat else None, "no_gsplat": missing}
    name = "gpu" if place.on_gpu else "gpu_rehearsal"
    rows: list[Row] = []
    for row in gpu_rows.every(place):
        rows.append(row | {"target": target(row)})
        print(
            "  ".join(f"{key} {text(value)}" for key in COLUMNS if (value := rows[-1].get(key)) is not None), flush=True
        )
        write(options.out, name, machine, rows)  # after every row: what is known if time runs out
    sys.exit(any("failed" in row for row in rows))


def conditions(place: Place) -> dict[str, Any]:
    """Where: the device, its measured rates, and the versions."""
    facts: dict[str, Any] = {"processor": processor_name(), "git_commit": git_commit(), "versions": versions()}
    if place.on_gpu:
        a, b = torch.empty(2, 1 << 28, device=place.device).unbind()  # 1 GiB each, far beyond any cache
        square = torch.rand(8192, 8192, device=place.device)
        facts["device"] = torch.cuda.get_device_name()
        facts["copy_gb_s"] = 2 * a.numel() * 4 / place.cost(lambda: b.copy_(a)).ms / 1e6
        facts["float32_tflop_s"] = 2 * 8192**3 / place.cost(lambda: square @ square, 5).ms / 1e9
    return facts


def write(folder: Path, name: str, machine: dict[str, Any], rows: list[Row]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / f"{name}.json", json.dumps({"machine": machine, "rows": rows}, indent=1).encode())
    write_atomically(folder / f"{name}.md", table(machine, rows).encode())


def target(row: Row) -> str | None:
    """Which ratio was aimed at, and whether it was reached."""
    aim = TARGETS.get((row["section"], row.get("pass", "")))
    return None if aim is None or "ratio" not in row else f"{aim} {'met' if row['ratio'] >= aim else 'missed'}"


def agr_shares(rows: list[Row]) -> list[str]:
    """What AGR is of a frame's time, for frames that were measured with and without it."""
    frames = {
        (row["section"], row["case"]): row["ours_ms"]
        for row in rows
        if row["section"] in ("frame", "replay") and row.get("pass") == "forward"
    }
    lines = []
    for (section, case), with_agr in frames.items():
        without = frames.get((section, case.replace("with AGR", "without AGR")))
        if without is not None and "with AGR" in case:
            share = 1 - without / with_agr
            lines.append(f"| {section} | {case} | {share:.1%} | {'met' if share <= AGR_TARGET else 'missed'} |")
    title = [
        f"AGR's share of a frame; the aim is at most {AGR_TARGET:.0%}.",
        "",
        "| | | share | |",
        "| --- | --- | ---: | --- |",
    ]
    return ["", *title, *lines] if lines else []


def table(machine: dict[str, Any], rows: list[Row]) -> str:
    gsplat = f"gsplat {machine['gsplat']}" if machine["gsplat"] else f"without gsplat ({machine['no_gsplat']})"
    lines = [
        f"# The CUDA backend on {machine.get('device', 'a CPU (rehearsal)')}",
        "",
        f"Commit {machine['git_commit']}, {gsplat}. Measured peaks: a copy moves",
        f"{text(machine.get('copy_gb_s'))} GB/s, products {text(machine.get('float32_tflop_s'))} float32 TFLOP/s.",
        "Median milliseconds of single calls, around which the GPU is waited for: Python's time counts in full, and",
        "more than where work is queued. back_to_back: mean milliseconds of calls that follow at once, where Python",
        "runs while the GPU works; but a forward pass of either rasterizer waits for the GPU itself, to read how many",
        "intersections there are. ratio = theirs / ours; targets are for that of single calls. ours_gb_s: the bytes",
        "that cannot be spared over the time; ours_galpha_s: likewise alphas of at least 1/255; difference: mean over",
        "the picture between ours and theirs.",
        "",
        "| " + " | ".join(COLUMNS) + " |",
        "| --- | --- | --- |" + " ---: |" * (len(COLUMNS) - 3),
    ]
    lines += ["| " + " | ".join(text(row.get(name)).replace("|", "/") for name in COLUMNS) + " |" for row in rows]
    lines += agr_shares(rows)
    return "\n".join(lines) + "\n"


def text(value: Any) -> str:
    return "" if value is None else f"{value:.3f}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()

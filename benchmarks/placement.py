"""Train models on a capture that is moved, scaled or has far points: python -m benchmarks.placement --folder FOLDER.

Writes a capture in COLMAP's layout, images of moving Gaussians by cameras on a ring, and the same capture elsewhere, in
other units and with far points. Trains eight models on each and prints how PSNR on test differs from that of the
capture as it is, a Markdown table. FOLDER keeps the captures and the runs, so a second call prints the table again.
"""

import argparse
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy import stats
from scipy.spatial.transform import Rotation

from gsbench import rasterize
from gsbench.measure import record
from gsbench.measure.machine import processor_name
from gsbench.models.cameras import look_at

MODELS = ("3dgs", "4dgs", "6dgs", "7dgs_noagr", "7dgs", "freetime", "ubs", "dgs")
SEEDS = tuple(range(8))
WIDTH, HEIGHT, FOCAL, VIEWS, RADIUS = 96, 72, 110.0, 48, 4.0
BLOBS, POINTS_OF_A_BLOB = 60, 16
ITERATIONS = 600


class Change(NamedTuple):
    """What is done to a capture: all of it is scaled and then moved, and a share of far points is added."""

    scale: float = 1.0
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    far: float = 0.0


CHANGES = {
    "as it is": Change(),
    "moved by (100, 100, 0)": Change(offset=(100.0, 100.0, 0.0)),
    "moved by (1000, 2000, 30)": Change(offset=(1000.0, 2000.0, 30.0)),
    "UTM metres": Change(offset=(431234.56, 5412345.67, 321.5)),
    "times 0.001": Change(0.001),
    "times 0.003": Change(0.003),
    "times 100": Change(100.0),
    "1 % far points": Change(far=0.01),
}


class Blobs(NamedTuple):
    """Hold moving Gaussians in float64: means at time 0 and velocities, covariance factors, opacities and colours."""

    means: torch.Tensor  # [N, 3]
    velocities: torch.Tensor  # [N, 3]
    factors: torch.Tensor  # [N, 3, 3]
    opacities: torch.Tensor  # [N]
    colors: torch.Tensor  # [N, 3]


def blobs() -> Blobs:
    """Draw the Gaussians of the scene; four in ten move."""
    random = np.random.default_rng(0)
    axes = np.linalg.qr(random.normal(size=(BLOBS, 3, 3)))[0] * random.uniform(0.04, 0.16, (BLOBS, 1, 3))
    moves = random.uniform(-0.3, 0.3, (BLOBS, 3)) * (random.random((BLOBS, 1)) < 0.4)
    parts = random.uniform(-0.8, 0.8, (BLOBS, 3)), moves, axes, random.uniform(0.6, 0.95, BLOBS)
    return Blobs(*map(torch.from_numpy, (*parts, random.uniform(0.1, 1, (BLOBS, 3)))))


def write_capture(root: Path, change: Change) -> None:
    """Write images, times.csv and sparse/0 of the scene after a change."""
    scene, sparse = blobs(), root / "sparse" / "0"
    sparse.mkdir(parents=True)
    (root / "images").mkdir()
    offset = np.array(change.offset)
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    lines, times = [], ["name,time"]
    for i in range(VIEWS):
        angle, time = 2.4 * i, i / (VIEWS - 1)  # about the golden angle: neighbours in time look from other sides
        eye = RADIUS * torch.tensor([np.cos(angle), np.sin(angle), 0.3 * np.sin(3 * angle) + 0.1], dtype=torch.float64)
        viewmat = look_at(eye, torch.zeros(3).to(eye), torch.tensor([0.0, 0.0, 1.0]).to(eye))
        image = rasterize(
            scene.means + time * scene.velocities,
            scene.factors,
            scene.opacities,
            scene.colors,
            viewmat[None],
            K[None],
            WIDTH,
            HEIGHT,
            backend="reference",
        ).image[0]
        name = f"view_{i:03d}.png"
        assert cv2.imwrite(
            str(root / "images" / name), (255 * image.numpy()[..., ::-1] + 0.5).clip(0, 255).astype("u1")
        )
        R, t = viewmat[:3, :3].numpy(), viewmat[:3, 3].numpy()
        pose = [*np.roll(Rotation.from_matrix(R).as_quat(), 1), *(change.scale * t - R @ offset)]
        lines += [f"{i + 1} {' '.join(repr(float(value)) for value in pose)} 1 {name}", ""]
        times.append(f"{name},{time}")
    (root / "times.csv").write_text("\n".join(times) + "\n")
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    (sparse / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}\n")
    rows = [
        f"{i} {' '.join(repr(float(value)) for value in xyz)} 128 128 128 0.5"
        for i, xyz in enumerate(change.scale * points(scene, change.far) + offset, 1)
    ]
    (sparse / "points3D.txt").write_text("\n".join(rows) + "\n")


def points(scene: Blobs, far: float) -> NDArray[np.float64]:  # [P, 3]
    """Draw points of the Gaussians, and a share of others at 30 to 10,000 units."""
    random = np.random.default_rng(1)
    draws = torch.from_numpy(random.normal(size=(BLOBS, POINTS_OF_A_BLOB, 3)))
    near = (scene.means[:, None] + draws @ scene.factors.mT).reshape(-1, 3).numpy()
    directions = random.normal(size=(round(far * len(near)), 3))
    directions *= 10 ** random.uniform(1.5, 4, (len(directions), 1)) / np.linalg.norm(directions, axis=1, keepdims=True)
    return np.concatenate([near, directions])


def measured(results: Path) -> dict[tuple[str, str, int], float]:
    """Return PSNR on test by capture, model and seed."""
    records = [record.read(path) for path in record.find(results)]
    return {(r.scene, r.model, r.seed): float(r.metrics["psnr"] or np.nan) for r in records if r.metrics}


def main() -> int:
    """Print the table; return 0, or 1 if a run failed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.placement", description=__doc__)
    parser.add_argument("--folder", type=Path, required=True, help="of the captures and the runs")
    folder = parser.parse_args().folder.absolute()
    captures = {name: f"capture_{i}" for i, name in enumerate(CHANGES)}
    for name, capture in captures.items():
        if not (folder / capture).exists():
            write_capture(folder / capture, CHANGES[name])
    status = subprocess.run(
        [
            sys.executable,
            "-m",
            "gsbench",
            "-m",
            "+exp=colmap",
            f"data.root={folder}",
            "scene=custom",
            f"scene.name={','.join(captures.values())}",
            f"model={','.join(MODELS)}",
            f"seed={','.join(map(str, SEEDS))}",
            f"train.iterations={ITERATIONS}",
            "train.curve_points=1",
            f"results={folder / 'results'}",
        ],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        check=False,
    ).returncode
    psnr = measured(folder / "results")
    print(f"| | {' | '.join(MODELS)} |\n| --- |{' ---: |' * len(MODELS)}")
    for name, capture in captures.items():
        cells = []
        for model in MODELS:
            plain = np.array([psnr.get((captures["as it is"], model, seed), np.nan) for seed in SEEDS])
            here = np.array([psnr.get((capture, model, seed), np.nan) for seed in SEEDS])
            change = here - plain
            half = float(stats.t.ppf(0.975, len(SEEDS) - 1)) * change.std(ddof=1) / len(SEEDS) ** 0.5
            cells.append(f"{here.mean():.2f}" if name == "as it is" else f"{change.mean():+.2f} ± {half:.2f}")
        print(f"| {name} | {' | '.join(cells)} |")
    print(
        f"\nPSNR on test in dB, and how it differs from that of the capture as it is; means over {len(SEEDS)} seeds "
        f"with 95 % intervals. {ITERATIONS} iterations, {VIEWS} views of {WIDTH}x{HEIGHT}; "
        f"{processor_name()}, 1 thread."
    )
    return int(status != 0)


if __name__ == "__main__":
    sys.exit(main())

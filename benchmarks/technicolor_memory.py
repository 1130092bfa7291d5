"""Measure the memory of a Technicolor scene of full size: python benchmarks/technicolor_memory.py --folder FOLDER.

Writes a scene in the layout of the release, 16 cameras x 50 frames of 2048 x 1088 with smooth content (0.1 GB in
FOLDER, removed at the end), loads it as `+exp=technicolor` does, and takes some training steps of 4DGS.
"""

import argparse
import shutil
import time
from pathlib import Path

import cv2
import hydra
import numpy as np
import torch
from numpy.typing import NDArray

from gsbench.config import CONF, register_schema
from gsbench.measure.machine import processor_name
from gsbench.measure.quality import evaluate
from gsbench.run.execution import Execution
from gsbench.run.identity import identify
from gsbench.scenes.technicolor import CAMERAS, COLUMNS, TEST_CAMERA

WIDTH, HEIGHT, ACROSS, FRAMES = 2048, 1088, 4, range(151, 201)  # Birthday's
FOCAL, BASELINE = 1170.0, 0.1  # pixels; world units between neighbours of the array


def write_scene(root: Path) -> int:
    """Write the cameras and images of a scene; return the bytes of its images."""
    root.mkdir(parents=True)
    lines = [" ".join(COLUMNS)]
    for camera in range(ACROSS**2):
        x, y = (BASELINE * (n - (ACROSS - 1) / 2) for n in (camera % ACROSS, camera // ACROSS))
        lines.append(f"{FOCAL} {WIDTH / 2} {HEIGHT / 2} 1 0 1 0 0 0 {-x} {-y} 0")
    (root / CAMERAS).write_text("\n".join(lines) + "\n")
    written = 0
    for frame in FRAMES:
        for camera in range(ACROSS**2):
            path = root / f"{root.name}_undist_{frame:05d}_{camera:02d}.png"
            assert cv2.imwrite(str(path), content(frame, camera), [cv2.IMWRITE_PNG_COMPRESSION, 1])
            written += path.stat().st_size
    return written


def content(frame: int, camera: int) -> NDArray[np.uint8]:
    """Make a smooth image, [H, W, 3], that differs for every frame and camera."""
    y, x = np.mgrid[0 : HEIGHT // 8, 0 : WIDTH // 8] / 32.0
    waves = [np.sin(x + 0.1 * frame + k) * np.cos(y - 0.2 * camera + k) for k in range(3)]
    small = (127.5 + 127.5 * np.stack(waves, -1)).astype(np.uint8)
    return np.repeat(np.repeat(small, 8, 0), 8, 1)


def resident() -> dict[str, float]:
    """Return the resident memory of this process now and at its peak, GB (proc(5): VmRSS, VmHWM)."""
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return {name: int(status[key].split()[0]) * 1024 / 1e9 for name, key in (("now", "VmRSS"), ("peak", "VmHWM"))}


def report(what: str, began: float) -> None:
    """Print seconds and memory after a part. The peak is that since the part before the training."""
    memory = resident()
    print(f"{what}: {time.perf_counter() - began:.0f} s, {memory['now']:.2f} GB resident, peak {memory['peak']:.2f} GB",
          flush=True)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="where the scene is written")
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--gaussians", type=int, default=20_000)
    asked = parser.parse_args()
    print(f"{processor_name()}, {torch.get_num_threads()} threads; before: {resident()['now']:.2f} GB resident")
    root = asked.folder / "data" / "Birthday"
    try:
        written = write_scene(root)
        print(f"{len(FRAMES) * ACROSS**2} images of {WIDTH}x{HEIGHT}, {written / 1e9:.2f} GB of PNG", flush=True)
        measure(asked.folder, asked.steps, asked.gaussians)
    finally:
        shutil.rmtree(asked.folder / "data", ignore_errors=True)
        shutil.rmtree(asked.folder / "results", ignore_errors=True)


def measure(folder: Path, steps: int, gaussians: int) -> None:
    """Load the scene, train and measure one test view as a run does, and say what each part needed."""
    register_schema()
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        composed = hydra.compose("config", [
            "+exp=technicolor", "scene=Birthday", "model=4dgs", f"data.root={folder / 'data'}", "resume=false",
            f"results={folder / 'results'}", f"train.iterations={steps}", f"data.initial_points={gaussians}",
        ])  # fmt: skip
    execution = Execution(identify(composed))
    began = time.perf_counter()
    model, scene = execution.prepare()
    report(f"loaded {len(scene.train)} training and {len(scene.test)} test views of camera {TEST_CAMERA}", began)
    began = time.perf_counter()
    trainer = execution.fit(model, scene)  # it starts a new peak
    report(f"{steps} steps of batch {trainer.config.train.batch_size} with {len(model)} Gaussians", began)
    view = scene.test[0]
    began = time.perf_counter()
    evaluate([(view.name, trainer.render(view), view.image)], background=scene.background, quantised=False, weights={})
    report("one test view measured", began)


if __name__ == "__main__":
    main()

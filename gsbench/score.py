"""Score the renders of any method on a scene's test views (``python -m gsbench.score RENDERS --name NAME +exp=..``).

The images are measured by the functions and the protocol that measure gsbench's own runs, and the record is one like
theirs, so that tables, pairs and pages have it.
"""

import argparse
import itertools
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from skimage.metrics import structural_similarity
from torch import Tensor

from gsbench.config_roles import without_agr
from gsbench.errors import InputError, one_line, printable
from gsbench.launch.command import Command, compose_run, hydra_with, runs_of
from gsbench.measure import record as records
from gsbench.measure.flicker import films_of, grey_of, tof
from gsbench.measure.images import write_png
from gsbench.measure.provenance import provenance
from gsbench.measure.quality import SSIM_LEAST_SIDE, capped_psnr
from gsbench.measure.record import Cost, Record
from gsbench.measure.renders import HOW_TO, CheckedRenders, check_renders
from gsbench.models.registry import is_registered
from gsbench.process.ending import end_with
from gsbench.process.memory import is_out_of_memory
from gsbench.run import drift
from gsbench.run.execution import summary
from gsbench.run.identity import RunSpec, identify
from gsbench.run.measuring import measure_images, protocol_of
from gsbench.run.settings import AUTO
from gsbench.run.setup import check_folder, check_machine, evaluated_views, load_scene
from gsbench.scenes import View
from gsbench.train import losses

# What a command line can set, as nothing is trained: experiment, scene, data, measurement, seed, device and folder.
KEYS = ("exp", "scene", "data", "protocol", "seed", "device", "results")
RECORDED = ("experiment", "seed", "device", "data", "scene", "protocol")  # keys of a config that the record has
NAMED = 5  # files that a line names
MS_SSIM_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)  # of the scales, from the finest (Wang et al. 2003)
MS_SSIM_LEAST_SIDE = 161  # pixels: a window of 11 fits into the coarsest scale, a sixteenth of the size


def main(arguments: list[str] | None = None) -> int:
    """Measure the renders of the command line and write their record; return 0, or 2 after an error message."""
    options = _parser().parse_intermixed_args(arguments)
    try:
        record, folder = score(options)
    except (InputError, OSError, MemoryError, RuntimeError) as error:  # RuntimeError: torch has no memory
        if isinstance(error, RuntimeError) and not is_out_of_memory(error):
            raise
        why = "out of memory: " if is_out_of_memory(error) else ""
        print(f"gsbench.score: {why}{one_line(error)}", file=sys.stderr)
        return 2
    print(f"{record.scene} {record.model}: {summary(record)}; {folder / records.FILE_NAME}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m gsbench.score", description=__doc__.partition("\n")[0])
    add = parser.add_argument
    add("renders", type=Path, metavar="RENDERS", help="a folder of images (PNG, JPEG, .npy of floats), or a video")
    add(
        "overrides",
        nargs="*",
        metavar="KEY=VALUE",
        help="+exp=NAME scene=NAME data.root=PATH, as for python -m gsbench",
    )
    add("--name", required=True, help="of the method, in tables")
    add("--reduce", action="store_true", help="reduce larger images to the size of the views, by the mean of areas")
    add("--train-seconds", type=float, metavar="S", help="of its training, on this machine")
    add("--fps", type=float, metavar="F", help="frames a second, on this machine")
    add("--gaussians", type=int, metavar="N", help="of its model")
    add("--megabytes", type=float, metavar="MB", help="of its model's parameters")
    add("--config-dir", type=Path, metavar="FOLDER", help="of your own YAML files")
    return parser


def score(options: argparse.Namespace) -> tuple[Record, Path]:
    """Measure the renders that the options name, write the record, and return it with its folder.

    Raises:
        InputError: the options, the scene or the renders are invalid; nothing is written.
    """
    costs = _costs(options)
    spec, folder = _run_of(options)
    config = spec.config
    check_machine(config)
    scene = load_scene(config)
    views = evaluated_views(scene, config.scene.eval_split)
    renders = check_renders(options.renders, views, scene.background, reduces=options.reduce)
    print(printable(_matching(renders, views)))
    check_folder(folder)
    measured = measure_images(views, renders.images(), scene.background, config)
    # In what the images depart from those that gsbench renders: settings of which tables warn.
    departures: dict[str, Any] = {"images": renders.facts.kind}
    if renders.facts.resized_from is not None:
        departures["reduced"] = f"from {renders.facts.resized_from}, mean of areas"
    record = Record(
        status="ok",
        reason=None,
        experiment=config.experiment,
        model=options.name,
        scene=config.scene.name,
        dataset=config.data.dataset,
        seed=config.seed,
        effects=None,
        protocol=protocol_of(config, scene) | departures,
        provenance=provenance({key: spec.plain[key] for key in RECORDED}, scene, config.device),
        metrics=measured.metrics | dict.fromkeys(drift.NAMES),
        missing=measured.missing | dict.fromkeys(drift.NAMES, "needs the Gaussians, not their images"),
        per_view=measured.per_view,
        regions=measured.regions,
        cost=costs,
        exact=sorted({name for view in measured.per_view for name in view.exact}),
        parts={"score": other_metrics(views, renders)},
        rendered_elsewhere=renders.facts,
    )
    records.write(record, folder / records.FILE_NAME)
    for name, image in measured.images.items():
        write_png(image, folder / name)
    if (measured.metrics["psnr"] or 0) <= (measured.metrics["psnr_background_only"] or 0):
        print(f"{config.scene.name}: PSNR is not above that of the background alone: are these images of these views?")
    return record, folder


def _run_of(options: argparse.Namespace) -> tuple[RunSpec, Path]:
    """Compose the config of the scene, and return it with the folder of the record.

    Raises:
        InputError: an override is wrong or of a training, or the name is that of a model or of a trained run.
    """
    for word in options.overrides:
        key = word.lstrip("+~").partition("=")[0].partition(".")[0]
        if key not in KEYS:
            raise InputError(f"{word!r:.200}: expected a key of {', '.join(KEYS)}, as nothing is trained: leave it out")
    # Runs of gsbench have the name of a model, also with _agr or _noagr, or "auto".
    if is_registered(without_agr(options.name)) or options.name == AUTO:
        raise InputError(
            f"--name: expected a name that no model of gsbench has, got {options.name}: try {options.name}_official"
        )
    with hydra_with(options.config_dir):
        runs, is_sweep = runs_of(Command(options.overrides, multirun=False, config_dir=options.config_dir, asks=False))
        if is_sweep:
            raise InputError("scene: expected one, as there is one set of renders: add scene=NAME", docs=HOW_TO)
        spec = identify(compose_run(runs[0]).config)
    config = spec.config
    folder = records.run_path(Path(config.results), config.experiment, config.scene.name, options.name, config.seed)
    if (folder / records.CHECKPOINT).exists():
        raise InputError(f"--name: expected another one, {folder} has a run that gsbench trained")
    return spec, folder


def _costs(options: argparse.Namespace) -> Cost:
    """Return what the user states of the method's cost.

    Raises:
        InputError: a number is not positive.
    """
    stated = {name: getattr(options, name) for name in ("train_seconds", "fps", "gaussians", "megabytes")}
    for name, value in stated.items():
        if value is not None and not 0 < value < 1e15:  # NaN, infinity and typing errors are refused too
            raise InputError(f"--{name.replace('_', '-')}: expected a number above 0, got {value}")
    size = None if options.megabytes is None else round(options.megabytes * 1e6)
    return Cost(
        train_s=options.train_seconds,
        stage_s={},
        render_ms=None,
        fps=options.fps,
        num_gaussians=options.gaussians,
        bytes=size,
        peak_memory=None,
    )


def _matching(renders: CheckedRenders, views: Sequence[View]) -> str:
    """Say which file was taken for which view."""
    pairs = [f"{file} is {view.name}" for file, view in zip(renders.files, views, strict=True)]
    shown = pairs if len(pairs) <= NAMED else [*pairs[: NAMED - 1], "..", pairs[-1]]
    text = f"{len(pairs)} images ({renders.facts.kind}), matched to the views by {renders.facts.matched}: "
    others = f"; not read: {', '.join(renders.others[:NAMED])}" if renders.others else ""
    return text + ", ".join(shown) + others


def other_metrics(views: Sequence[View], renders: CheckedRenders) -> dict[str, float]:
    """Return the means of the metrics of other papers over views, and of tOF over films.

    A metric is left out if an image is too small for it, or if there is no film.
    """
    films = [[view.name for view in film] for film in films_of(views)]
    is_filmed = set(itertools.chain(*films))
    by_view: list[dict[str, float]] = []
    frames = {}  # grey render and truth of each filmed view, by name
    for view, image in zip(views, renders.images(), strict=True):
        truth = view.image
        if min(truth.shape[:2]) >= SSIM_LEAST_SIDE:
            by_view.append(of_other_papers(image, truth))
        if view.name in is_filmed:
            frames[view.name] = grey_of(image), grey_of(truth)
    names = [name for name in by_view[0] if all(name in scores for scores in by_view)] if by_view else []
    means = {name: fmean(scores[name] for scores in by_view) for name in names}
    flows = [tof(*zip(*(frames[name] for name in film), strict=True)) for film in films]
    known = [flow for flow in flows if flow is not None]
    return means | ({"tof_farneback": fmean(known)} if known else {})


def of_other_papers(render: Tensor, truth: Tensor) -> dict[str, float]:  # [H, W, 3], each
    """Compute the SSIM of other papers, and PSNR after the affine map of colours that fits the image best.

    `ssim_padded` is that of 3DGS and of SSIM1 of STG, with a zero-padded Gaussian window. `ssim_uniform` is
    scikit-image's default, with a uniform window of 7 pixels; it takes data_range 2 for floats where none is named, as
    in `ssim_uniform_range2`, SSIM2 of STG. DSSIM is (1 - SSIM) / 2. `ms_ssim`, which 4DGaussians reports, is left out
    if a side is shorter than MS_SSIM_LEAST_SIDE.
    """
    a, b = (image.detach().double().clamp(0, 1) for image in (render, truth))
    arrays = a.cpu().numpy(), b.cpu().numpy()
    uniform = [
        float(structural_similarity(*arrays, channel_axis=-1, data_range=data_range)) for data_range in (1.0, 2.0)
    ]
    padded = float(losses.structural_similarity(a, b))
    return {
        "ssim_padded": padded,
        "ssim_uniform": uniform[0],
        "ssim_uniform_range2": uniform[1],
        "dssim1": (1 - padded) / 2,
        "dssim2": (1 - uniform[1]) / 2,
        "psnr_color_corrected": capped_psnr(_color_corrected(a, b), b),
    } | ({"ms_ssim": multiscale_ssim(*arrays)} if min(arrays[0].shape[:2]) >= MS_SSIM_LEAST_SIDE else {})


def multiscale_ssim(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:  # [H, W, 3] in [0, 1], each
    """Compute MS-SSIM (Wang et al. 2003) as the package pytorch-msssim does, whose numbers papers print.

    It is a product over scales of the contrasts and structures, and of the luminance of the coarsest; the mean over
    channels. A scale has means of 2 x 2 pixels of the one before, after a row or column of zeros where a side is odd.
    """
    C1, C2 = 0.01**2, 0.03**2
    product = np.ones(a.shape[-1])
    for scale, weight in enumerate(MS_SSIM_WEIGHTS):
        if scale:
            a, b = _halved(a), _halved(b)
        mean_a, mean_b, aa, bb, ab = map(_windowed, (a, b, a * a, b * b, a * b))  # aa: the mean of squares
        similarity = (2 * (ab - mean_a * mean_b) + C2) / (aa - mean_a**2 + bb - mean_b**2 + C2)
        if scale == len(MS_SSIM_WEIGHTS) - 1:
            similarity *= (2 * mean_a * mean_b + C1) / (mean_a**2 + mean_b**2 + C1)
        product *= similarity.mean((0, 1)).clip(0) ** weight
    return float(product.mean())


def _windowed(image: NDArray[np.float64]) -> NDArray[np.float64]:  # [H, W, 3] -> [H - 10, W - 10, 3]
    """Return the means in the Gaussian windows of 11 pixels that lie inside an image."""
    return gaussian_filter(image, sigma=(1.5, 1.5, 0), truncate=3.5)[5:-5, 5:-5]  # the radius is 3.5 * 1.5, rounded


def _halved(image: NDArray[np.float64]) -> NDArray[np.float64]:  # [H, W, 3]
    """Return the means of 2 x 2 pixels, where zeros stand before the first row or column of an odd number."""
    height, width = image.shape[:2]
    even = np.pad(image, ((height % 2, 0), (width % 2, 0), (0, 0)))
    return even.reshape(len(even) // 2, 2, -1, 2, image.shape[-1]).mean((1, 3))


def _color_corrected(render: Tensor, truth: Tensor) -> Tensor:  # [H, W, 3] float64, each
    """Map the colours c of a render to A c + b, with the A [3, 3] and b [3] of least squared error."""
    colors = np.concatenate([render.cpu().reshape(-1, 3).numpy(), np.ones((render[..., 0].numel(), 1))], axis=1)
    fit, *_ = np.linalg.lstsq(colors, truth.cpu().reshape(-1, 3).numpy())
    return torch.from_numpy(colors @ fit).reshape(truth.shape).to(truth)


if __name__ == "__main__":
    end_with("gsbench.score", main)

"""Measure a trained model: image quality, frame time, and the cost of its training.

`measure_images` measures the images of any program: those of a trained model, and those that gsbench.score reads.
"""

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy.typing as npt
from torch import Tensor

from gsbench.config import Config
from gsbench.errors import one_line
from gsbench.gates import picture
from gsbench.measure.flicker import FlickerScores
from gsbench.measure.images import Pixels, strip
from gsbench.measure.quality import evaluate, evenly
from gsbench.measure.record import Cost, Region, ViewScore
from gsbench.measure.regions import RegionScores
from gsbench.measure.speed import RenderTimes, peak_memory, synchroniser, time_in_turns
from gsbench.models.render import GraphedFrames
from gsbench.run import drift
from gsbench.run.drift import Still
from gsbench.run.settings import lpips_weights
from gsbench.scenes import Scene, View
from gsbench.stability.float32_error import psnr_float32
from gsbench.train.hooks.best import Best
from gsbench.train.loop import Trainer

Pairs = list[tuple[npt.ArrayLike, npt.ArrayLike]]  # render and ground truth, [H, W, 3] each


@dataclass(frozen=True)
class Measured:
    """The measurements of the images of evaluated views for a record, and pictures to be written beside it."""

    metrics: dict[str, float | None]
    missing: dict[str, str]  # why a metric has no value
    per_view: list[ViewScore]
    regions: dict[str, Region]  # the pixels of `psnr_moving`, `psnr_object` and `flicker`
    images: dict[str, Pixels]  # by file name
    still: Sequence[Still]  # films with their static pixels
    no_film: str  # why there is none


def measure_images(
    views: Sequence[View],
    renders: Iterable[Tensor],  # [H, W, 3] of each view
    background: tuple[float, float, float],
    config: Config,
) -> Measured:
    """Measure the renders of the evaluated views, of which one at a time is in memory, by the protocol of a config.

    `evaluate` asks for one (name, render, ground truth) after the other; regions and flicker look at each on its way.
    """
    shown: Pairs = []  # `_beside_truth` fills it while `evaluate` runs
    regions = RegionScores(views, config.protocol.quantise)
    flicker = FlickerScores(views, regions.regions["moving"].of_any_size)
    pairs = _beside_truth(views, renders, config.protocol.pictures, shown)
    quality = evaluate(
        regions.measured(flicker.measured(pairs)),
        background=background,
        quantised=config.protocol.quantise,
        weights=lpips_weights(config),
    )
    return Measured(
        metrics=quality.metrics | regions.metrics() | flicker.metrics(),
        missing=quality.missing | regions.missing() | flicker.missing(),
        per_view=regions.with_scores(quality.per_view),
        regions=regions.of_record() | flicker.of_record(),
        images={"pictures.png": strip(shown)} | flicker.pictures() if shown else {},
        still=flicker.still,
        no_film=flicker.missing_because,
    )


def protocol_of(config: Config, scene: Scene | None) -> dict[str, Any]:
    """Return the protocol of a measurement for its record; `scene` is None if it could not be loaded."""
    camera = scene.train[0].camera if scene else None
    return {
        "name": config.protocol.name,
        "background": config.data.background,
        "downscale": config.scene.downscale,
        "resolution": f"{camera.width}x{camera.height}" if camera else "not loaded",
        "eval_split": config.scene.eval_split,
        "quantise": config.protocol.quantise,
        "paper_dataset": config.data.paper_dataset,
        **{key: value for key in ("resize", "val_every") if (value := getattr(config.scene, key)) is not None},
        **({"repaired": ", ".join(scene.repaired)} if scene and scene.repaired else {}),
    }


def measure(trainer: Trainer, *, with_effect_sets: bool) -> tuple[Measured, Cost, dict[str, str]]:
    """Measure a trained model on the evaluated views: images, cost, and the note of `frames`, which the record has too.

    `with_effect_sets` also draws what each Gaussian depends on.
    """
    views = trainer.views
    measured = measure_images(views, map(trainer.render, views), trainer.scene.background, trainer.config)
    times, note = time_frames(trainer, views)
    cost = Cost(
        train_s=sum(trainer.stages.seconds.values()),
        stage_s=trainer.stages.state_dict(),
        render_ms=times,
        fps=times.fps,
        num_gaussians=len(trainer.model),
        bytes=trainer.model.stored_bytes(),
        peak_memory=peak_memory(trainer.config.device),
        train_cpu_s=trainer.effort.cpu_s,
        load=trainer.effort.load,
    )
    metrics, missing = with_best(measured, trainer)
    metrics["psnr_train"] = trainer.psnr(evenly(trainer.scene.train, len(views)))
    renderer = trainer.renderer
    metrics["psnr_float32"], why = psnr_float32(trainer.model, trainer.views, renderer.background, renderer.antialias)
    if why:
        missing["psnr_float32"] = why
    metrics |= drift.of_films(trainer.model, measured.still, renderer.antialias, trainer.scene.placement.unit)
    missing |= {} if measured.still else dict.fromkeys(drift.NAMES, measured.no_film)
    images = measured.images
    if images and with_effect_sets:
        first = views[0]
        effect_sets = picture.draw(trainer.model, first.camera, first.time, renderer.background, renderer.antialias)
        images = images | {"effect_sets.png": effect_sets}
    return replace(measured, metrics=metrics, missing=missing, images=images), cost, note


def _beside_truth(
    views: Sequence[View], renders: Iterable[Tensor], pictures: int, shown: Pairs
) -> Iterator[tuple[str, Tensor, Tensor]]:
    """Yield (name, render, ground truth) of each evaluated view, and append a few of these image pairs to `shown`."""
    chosen = range(0, len(views), max(1, len(views) // max(1, pictures)))[:pictures]  # evenly spaced
    # one view at a time, because fifty views of 2048 x 1088 take 3 GB
    for i, (view, render) in enumerate(zip(views, renders, strict=True)):
        truth = view.image
        if i in chosen:
            shown.append((render.cpu().numpy(), truth.cpu().numpy()))
        yield view.name, render, truth


def time_frames(trainer: Trainer, views: Sequence[View]) -> tuple[RenderTimes, dict[str, str]]:
    """Time frames of a trained model at some views in turn, and return the note of `frames` too."""
    frame, note = frames(trainer, views[0])
    count, synchronise = max(trainer.config.protocol.renders, len(views)), synchroniser(trainer.config.device)
    (times,) = time_in_turns([lambda i: frame(views[i % len(views)])], count, synchronise)
    return times, note


def frames(trainer: Trainer, first: View) -> tuple[Callable[[View], Tensor], dict[str, str]]:
    """Return the function that renders a frame for the FPS measurement, and a note for the record.

    On a GPU frames are "replayed" from a CUDA graph if the model can be captured, so that Python's launches of kernels
    take no time. Otherwise they are "launched" kernel by kernel.
    """
    if trainer.model.backend.name != "cuda":
        return trainer.render, {}
    graphed = GraphedFrames(trainer.model, trainer.renderer.background, trainer.renderer.antialias)
    try:
        graphed(first.camera, first.time)
    except RuntimeError as error:  # the model waits for the GPU, which a CUDA graph does not allow
        print(f"FPS is that of launched frames: CUDA cannot record this model: {one_line(error)}", file=sys.stderr)
        return trainer.render, {"frames": "launched"}
    return lambda view: graphed(view.camera, view.time), {"frames": "replayed"}


def with_best(measured: Measured, trainer: Trainer) -> tuple[dict[str, float | None], dict[str, str]]:
    """Return the metrics of the last iteration, with the PSNR at the iteration that was best on val added.

    With `protocol.best_on_test`, the highest PSNR on the evaluated split during training is added too.
    """
    metrics, missing = dict(measured.metrics), dict(measured.missing)
    best = trainer.hook(Best).scores
    metrics["psnr_best_on_val"] = best.eval_at_best_val
    if trainer.config.scene.eval_split == "val":
        metrics["psnr_best_on_val"] = None
        missing["psnr_best_on_val"] = "measured on val, so no other split is left to choose an iteration by"
    elif metrics["psnr_best_on_val"] is None:
        has_val = bool(trainer.scene.val)
        missing["psnr_best_on_val"] = "PSNR on val is not a number" if has_val else "the scene has no val split"
    if trainer.config.protocol.best_on_test:
        metrics["psnr_best_on_test"] = best.eval
    return metrics, missing

"""Measure a trained model: image quality, frame time, and the cost of its training."""

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy.typing as npt
from torch import Tensor

from gsbench.config import Config
from gsbench.errors import one_line
from gsbench.gates import picture
from gsbench.measure.images import Pixels, strip
from gsbench.measure.quality import Quality, evaluate, evenly
from gsbench.measure.record import Cost, Region, ViewScore
from gsbench.measure.regions import RegionScores
from gsbench.measure.speed import peak_memory, synchroniser, time_renders
from gsbench.models.render import GraphedFrames
from gsbench.run.settings import lpips_weights
from gsbench.scenes import View
from gsbench.stability.float32_error import psnr_float32
from gsbench.train.hooks.best import Best
from gsbench.train.loop import Trainer

Pairs = list[tuple[npt.ArrayLike, npt.ArrayLike]]  # render and ground truth, [H, W, 3] each


@dataclass(frozen=True)
class Measured:
    """The measurements of a trained model for its record, and images to be written beside the record."""

    metrics: dict[str, float | None]
    missing: dict[str, str]  # why a metric has no value
    per_view: list[ViewScore]
    regions: dict[str, Region]  # the pixels of `psnr_moving` and `psnr_object`
    cost: Cost
    frames: dict[str, str]  # whether frames on a GPU are replayed from a CUDA graph, for the record
    images: dict[str, Pixels]  # images by file name


def measure(trainer: Trainer, config: Config, *, with_effect_sets: bool) -> Measured:
    """Measure a trained model on the evaluated views; `with_effect_sets` also draws what each Gaussian depends on."""
    views = trainer.views
    shown: Pairs = []
    regions = RegionScores(views, config.protocol.quantise)
    quality = evaluate(
        regions.measured(_rendered(trainer, config.protocol.pictures, shown)),
        background=trainer.scene.background,
        quantised=config.protocol.quantise,
        weights=lpips_weights(config),
    )
    frame, note = frames(trainer, views[0])
    times = time_renders(
        lambda i: frame(views[i % len(views)]),
        count=max(config.protocol.renders, len(views)),
        synchronise=synchroniser(config.device),
    )
    cost = Cost(
        train_s=sum(trainer.stages.seconds.values()),
        stage_s=trainer.stages.state_dict(),
        render_ms=times,
        fps=times.fps,
        num_gaussians=len(trainer.model),
        bytes=trainer.model.stored_bytes(),
        peak_memory=peak_memory(config.device),
        train_cpu_s=trainer.effort.cpu_s,
        load=trainer.effort.load,
    )
    metrics, missing = with_best(quality, trainer, config)
    metrics |= regions.metrics()
    missing |= regions.missing()
    metrics["psnr_train"] = trainer.psnr(evenly(trainer.scene.train, len(views)))
    renderer = trainer.renderer
    metrics["psnr_float32"], why = psnr_float32(trainer.model, trainer.views, renderer.background, renderer.antialias)
    if why:
        missing["psnr_float32"] = why
    images = {"pictures.png": strip(shown)} if shown else {}
    if shown and with_effect_sets:
        first = views[0]
        images["effect_sets.png"] = picture.draw(
            trainer.model, first.camera, first.time, renderer.background, renderer.antialias
        )
    return Measured(metrics, missing, regions.with_scores(quality.per_view), regions.of_record(), cost, note, images)


def _rendered(trainer: Trainer, pictures: int, shown: Pairs) -> Iterator[tuple[str, Tensor, Tensor]]:
    """Yield (name, render, ground truth) of each evaluated view, and append a few of these image pairs to `shown`."""
    views = trainer.views
    chosen = range(0, len(views), max(1, len(views) // max(1, pictures)))[:pictures]
    for i, view in enumerate(views):  # one view at a time, because fifty views of 2048 x 1088 take 3 GB
        render, truth = trainer.render(view), view.image
        if i in chosen:
            shown.append((render.cpu().numpy(), truth.cpu().numpy()))
        yield view.name, render, truth


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


def with_best(quality: Quality, trainer: Trainer, config: Config) -> tuple[dict[str, float | None], dict[str, str]]:
    """Return the metrics of the last iteration, with the PSNR at the iteration that was best on val added.

    With `protocol.best_on_test`, the highest PSNR on the evaluated split during training is added too.
    """
    metrics, missing = dict(quality.metrics), dict(quality.missing)
    best = trainer.hook(Best).scores
    metrics["psnr_best_on_val"] = best.eval_at_best_val
    if config.scene.eval_split == "val":
        metrics["psnr_best_on_val"] = None
        missing["psnr_best_on_val"] = "measured on val, so no other split is left to choose an iteration by"
    elif metrics["psnr_best_on_val"] is None:
        has_val = bool(trainer.scene.val)
        missing["psnr_best_on_val"] = "PSNR on val is not a number" if has_val else "the scene has no val split"
    if config.protocol.best_on_test:
        metrics["psnr_best_on_test"] = best.eval
    return metrics, missing

"""Do one run from its config to its record: load the scene, build the model, train it, measure it."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from omegaconf import DictConfig
from torch import Tensor

from gsbench import models, scenes
from gsbench.backends import resolve
from gsbench.config import Config
from gsbench.errors import one_line
from gsbench.measure import record as records
from gsbench.measure.provenance import config_hash, provenance
from gsbench.measure.quality import Quality, evaluate, evenly
from gsbench.measure.record import Cost, Effects, Record
from gsbench.measure.speed import peak_memory, reset_peak_memory, synchroniser, time_renders
from gsbench.models import GaussianModel
from gsbench.models.replay import Replay
from gsbench.report.pictures import strip, write_png
from gsbench.run.checks import BACKGROUNDS, check_times, evaluated_views, scene_folder
from gsbench.run.identity import Run, identify
from gsbench.scenes import Scene, View
from gsbench.scenes.points import random_points
from gsbench.train import checkpoint
from gsbench.train.diagnosis import explain
from gsbench.train.loop import Trainer
from gsbench.train.schedule import generator
from gsbench.train.watch import DivergedError


def run(composed: DictConfig) -> Record:
    """Do the run of a composed config of one scene, or keep the one that finished before under the same config.

    The record is on disk when this returns, whatever its status is.

    Raises:
        InputError: the config or the data has a fault; nothing was trained.
    """
    this = identify(composed)
    config = this.config
    model = build(config)
    scene = load_scene(config)
    check_times(model, scene, config.model.name)
    done = finished(this, scene)
    if done is not None:
        print(f"{this.name}: finished before, kept: {summary(done)}; {this.folder / records.FILE_NAME}")
        return done
    reset_peak_memory(config.device)
    try:
        record = fit_and_measure(this, scene, model)
    except DivergedError as error:
        record = described(this, scene, model, "diverged", f"{error}; {explain(model)}")
    except (MemoryError, torch.OutOfMemoryError) as error:
        record = described(this, scene, model, "failed", f"out of memory: {one_line(error)}")
    records.write(record, this.folder / records.FILE_NAME)
    print(f"{this.name}: {summary(record)}; {this.folder / records.FILE_NAME}, pictures.png beside it")
    return record


def build(config: Config) -> GaussianModel:
    """Build the model of a config, without Gaussians yet; raises InputError as `models.build` does."""
    return models.build(
        config.model.name,
        agr=config.agr,
        agr_octaves=config.model.agr_octaves,
        sh_degree=config.model.sh_degree,
        backend=resolve(config.raster.backend, torch.device(config.device).type),
        **config.model.options,
    )


def load_scene(config: Config) -> Scene:
    """Load the scene of a config onto its device.

    Raises:
        InputError: the data set is missing or has a fault.
    """
    background = BACKGROUNDS[config.data.background]
    return scenes.load(scene_folder(config), downscale=config.scene.downscale, background=background).to(config.device)


def finished(this: Run, scene: Scene) -> Record | None:
    """Read the record of this run, if it ended well before under the same config and on the same data."""
    path = this.folder / records.FILE_NAME
    if not this.config.resume or not path.exists():
        return None
    record = records.read(path)
    same = record.provenance.config == this.plain and record.provenance.data_hash == scene.fingerprint
    if not same:
        print(f"{this.name}: the config or the data is not that of {path}: running again", file=sys.stderr)
    return record if same and record.status == "ok" else None


def fit_and_measure(this: Run, scene: Scene, model: GaussianModel) -> Record:
    """Train the model, then measure its images, its speed and its size."""
    config = this.config
    data = config.data
    views = evaluated_views(scene, config.scene.eval_split)
    random = generator(config.seed)
    points = scene.points or random_points(data.initial_points, data.initial_half_width, random)
    model.initialise(points, scene.extent, random)
    model.to(config.device)
    trainer = Trainer(model, scene, views, config)

    path = this.folder / checkpoint.FILE_NAME
    hashes = (config_hash(this.plain), scene.fingerprint)
    state = checkpoint.load(path, *hashes, config.device) if config.resume else None
    if state is not None:
        trainer.load_state_dict(state)
        print(f"{this.name}: goes on from step {trainer.step} of {path}", file=sys.stderr)
    trainer.run(lambda state: checkpoint.save(path, *hashes, state), this.name)

    images = [(view.name, trainer.render(view), view.image) for view in views]
    weights = {name: Path(file) for name, file in (("alex", config.protocol.lpips_alex),
                                                   ("vgg", config.protocol.lpips_vgg)) if file}  # fmt: skip
    quality = evaluate(images, background=scene.background, quantised=config.protocol.quantise, weights=weights)
    frame, made = frames(trainer, views[0])
    times = time_renders(
        lambda i: frame(views[i % len(views)]),
        count=max(config.protocol.renders, len(views)),
        synchronise=synchroniser(config.device),
    )
    shown = images[:: max(1, len(images) // max(1, config.protocol.pictures))][: config.protocol.pictures]
    if shown:
        write_png(strip([(render.cpu(), truth.cpu()) for _, render, truth in shown]), this.folder / "pictures.png")
    cost = Cost(
        train_s=sum(trainer.stages.seconds.values()),
        stage_s=trainer.stages.state_dict(),
        render_ms=times,
        fps=times.fps,
        num_gaussians=len(model),
        bytes=sum(p.numel() * p.element_size() for p in model.parameters()),
        peak_memory=peak_memory(config.device),
    )
    metrics, missing = with_best(quality, trainer, config)
    metrics["psnr_train"] = trainer.psnr(evenly(scene.train, len(views)))
    record = described(this, scene, model, "ok", None)
    return replace(
        record, protocol=record.protocol | made,
        metrics=metrics, missing=missing, per_view=quality.per_view, cost=cost, curve=trainer.curve.points,
    )  # fmt: skip


def frames(trainer: Trainer, first: View) -> tuple[Callable[[View], Tensor], dict[str, str]]:
    """Choose the function that FPS is measured on, and say for the record how it makes frames on a GPU.

    Frames are `replayed` from a CUDA graph where CUDA can record the model, and otherwise `launched` anew each time.
    """
    config = trainer.config
    if trainer.model.backend.name != "cuda":
        return trainer.render, {}
    replay = Replay(trainer.model, trainer.background, config.raster.antialias)
    try:
        replay(first.camera, first.time)
    except RuntimeError as error:  # an operation that waits for the device, in a model or a scheme written in torch
        print(f"FPS is that of launched frames: CUDA cannot record this model: {one_line(error)}", file=sys.stderr)
        return trainer.render, {"frames": "launched"}
    return lambda view: replay(view.camera, view.time), {"frames": "replayed"}


def with_best(quality: Quality, trainer: Trainer, config: Config) -> tuple[dict[str, float | None], dict[str, str]]:
    """Add to the metrics of the last iteration those that the evaluated split had at the best iterations."""
    metrics, missing = dict(quality.metrics), dict(quality.missing)
    metrics["psnr_best_on_val"] = trainer.best.eval_at_best_val
    if config.scene.eval_split == "val":
        metrics["psnr_best_on_val"] = None
        missing["psnr_best_on_val"] = "measured on val, so no other split is left to choose an iteration by"
    elif metrics["psnr_best_on_val"] is None:
        missing["psnr_best_on_val"] = "the scene has no val split"
    if config.protocol.best_on_test:
        metrics["psnr_best_on_test"] = trainer.best.eval
    return metrics, missing


def described(this: Run, scene: Scene, model: GaussianModel, status: str, reason: str | None) -> Record:
    """Describe a run in a record: what was run, where, and how it ended, without measurements.

    Args:
        this: the run.
        scene: its scene.
        model: its model.
        status: ok, failed or diverged.
        reason: why it failed or diverged; None where it ended well.
    """
    config = this.config
    on_gpu = config.device.startswith("cuda")
    return Record(
        status=status,
        reason=reason,
        experiment=config.experiment,
        model=this.label,
        scene=scene.name,
        dataset=config.data.dataset,
        seed=config.seed,
        effects=Effects("time" in model.observes, "direction" in model.observes, config.agr),
        protocol={
            "name": config.protocol.name,
            "background": config.data.background,
            "downscale": config.scene.downscale,
            "resolution": f"{scene.train[0].camera.width}x{scene.train[0].camera.height}",
            "eval_split": config.scene.eval_split,
            "quantise": config.protocol.quantise,
            "backend": model.backend.name,
            "paper_dataset": config.data.paper_dataset,
        },
        provenance=provenance(
            config=this.plain,
            data_hash=scene.fingerprint,
            threads=torch.get_num_threads(),
            device=torch.cuda.get_device_name(config.device) if on_gpu else None,
        ),
    )


def summary(record: Record) -> str:
    """Sum up a record in a few words: the quality, the size and the speed, or why there are none."""
    if record.metrics is None or record.cost is None:
        return f"{record.status}: {record.reason}"
    psnr = record.metrics["psnr"]
    return (
        f"PSNR {'-' if psnr is None else format(psnr, '.2f')} dB, {record.cost.num_gaussians} Gaussians, "
        f"trained in {record.cost.train_s:.0f} s, {record.cost.fps:.0f} FPS"
    )

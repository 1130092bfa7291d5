"""One run, read as a sentence: scene -> model -> train -> measure -> record."""

import importlib.resources
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from gsbench import models, scenes
from gsbench.backends import resolve
from gsbench.config import Config
from gsbench.errors import InputError, did_you_mean
from gsbench.measure import record as records
from gsbench.measure.provenance import config_hash, provenance
from gsbench.measure.quality import Quality, evaluate, evenly
from gsbench.measure.record import Cost, Effects, Record
from gsbench.measure.speed import peak_memory, reset_peak_memory, synchroniser, time_renders
from gsbench.models import GaussianModel
from gsbench.models.replay import Replay
from gsbench.report.pictures import strip, write_png
from gsbench.scenes import Scene, View
from gsbench.scenes.points import random_points
from gsbench.train import checkpoint
from gsbench.train.diagnosis import explain
from gsbench.train.loop import Trainer
from gsbench.train.optim import OPTIMIZERS
from gsbench.train.schedule import generator
from gsbench.train.watch import DivergedError

BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
SPLITS = ("test", "val")


@dataclass(frozen=True)
class Run:
    """What identifies a run: its config, the folder that config has, and what goes into every record of it."""

    config: Config
    plain: dict[str, Any]  # the config as recorded
    folder: Path
    label: str  # the model's name, with _agr or _noagr where it is not as published


def run(composed: DictConfig) -> Record:
    """Do what a composed config of one scene says; a run that finished before under the same config is kept.

    The record is on disk when this returns, whatever the status.

    Raises:
        InputError: a fault in the config or the data; nothing was trained.
    """
    this = identify(composed)
    config = this.config
    model = build(config)
    scene = load_scene(config)
    done = finished(this, scene)
    if done is not None:
        print(f"{_name(this)}: finished before, kept: {summary(done)}; {this.folder / records.FILE_NAME}")
        return done
    reset_peak_memory(config.device)
    if "time" in model.observes and not scene.has_time:
        raise InputError(f"{config.model.name}: expected a scene with times, {scene.name} has none: use 3dgs or 6dgs")
    try:
        record = fit_and_measure(this, scene, model)
    except DivergedError as error:
        record = unfinished(this, scene, model, "diverged", f"{error}; {explain(model)}")
    except (MemoryError, torch.OutOfMemoryError) as error:
        record = unfinished(this, scene, model, "failed", f"out of memory: {_one_line(error)}")
    records.write(record, this.folder / records.FILE_NAME)
    print(f"{_name(this)}: {summary(record)}; {this.folder / records.FILE_NAME}, pictures.png beside it")
    return record


def build(config: Config) -> GaussianModel:
    """The model of a config, without Gaussians yet; raises InputError as `models.build`."""
    return models.build(
        config.model.name,
        agr=config.agr,
        agr_octaves=config.model.agr_octaves,
        sh_degree=config.model.sh_degree,
        backend=resolve(config.raster.backend, torch.device(config.device).type),
        **config.model.options,
    )


def identify(composed: DictConfig) -> Run:
    """Resolve and check a config of one scene.

    Raises:
        InputError: a value that no run can have; unknown keys and wrong types Hydra has refused before.
    """
    config: Config = OmegaConf.to_object(composed)  # type: ignore[assignment]
    if config.data.background not in BACKGROUNDS:
        raise InputError(f"data.background '{config.data.background}' is not known. "
                         f"{did_you_mean(config.data.background, BACKGROUNDS)}")  # fmt: skip
    if config.scene.eval_split not in SPLITS:
        raise InputError(f"scene.eval_split '{config.scene.eval_split}' is not known. "
                         f"{did_you_mean(config.scene.eval_split, SPLITS)}")  # fmt: skip
    if config.optim not in OPTIMIZERS:
        raise InputError(f"optim '{config.optim}' is not known. {did_you_mean(config.optim, OPTIMIZERS)}")
    train = config.train
    counts = {"iterations": train.iterations, "recipe_iterations": train.recipe_iterations,
              "batch_size": train.batch_size, "densify.every": train.densify.every}  # fmt: skip
    for key, count in counts.items():
        if count < 1:
            raise InputError(f"train.{key}: expected at least 1, got {count}")
    choose_device(config.device)
    resolve(config.raster.backend, torch.device(config.device).type)
    as_published = config.agr == config.model.published_with_agr
    label = config.model.name + ("" if as_published else "_agr" if config.agr else "_noagr")
    folder = records.run_path(Path(config.results), config.experiment, config.scene.name, label, config.seed)
    plain: dict[str, Any] = OmegaConf.to_container(composed, resolve=True)  # type: ignore[assignment]
    for key in ("results", "resume"):  # where results lie and whether they are kept changes no number
        del plain[key]
    return Run(config, plain, folder, label)


def choose_device(name: str) -> None:
    """Raise InputError unless `name` is a device torch can use here."""
    kind = name.partition(":")[0]
    if kind not in ("cpu", "cuda"):
        raise InputError(f"device '{name}' is not known. {did_you_mean(kind, ['cpu', 'cuda'])}")
    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError) as error:
        raise InputError(f"device '{name}' cannot be used here ({_one_line(error)}); use device=cpu") from None


def load_scene(config: Config) -> Scene:
    """The scene of a config, on its device.

    Raises:
        InputError: the data set is not there or not sound.
    """
    data, name = config.data, config.scene.name
    root = data_root(data.root)
    folder = root / name
    if root.resolve() not in folder.resolve().parents:
        raise InputError(f"scene.name: expected the name of a folder in data.root, got '{name}'")
    if not folder.is_dir():
        published = f"; {data.dataset} is published at: {data.published}" if data.published else ""
        raise InputError(
            f"data.root={data.root}: expected a folder '{name}' with transforms_{{train,val,test}}.json and the "
            f"images they name, looked for {folder}{published}"
        )
    background = BACKGROUNDS[data.background]
    return scenes.load(folder, downscale=config.scene.downscale, background=background).to(config.device)


def data_root(root: str) -> Path:
    """The folder that data.root names: a path, or pkg://module for data that comes with a package."""
    if not root.startswith("pkg://"):
        return Path(root).expanduser()
    return Path(str(importlib.resources.files(root.removeprefix("pkg://"))))


def finished(this: Run, scene: Scene) -> Record | None:
    """The record of this run where it ended well before, under the same config and on the same data."""
    path = this.folder / records.FILE_NAME
    if not this.config.resume or not path.exists():
        return None
    record = records.read(path)
    same = record.provenance.config == this.plain and record.provenance.data_hash == scene.fingerprint
    if not same:
        print(f"{_name(this)}: the config or the data is not that of {path}: running again", file=sys.stderr)
    return record if same and record.status == "ok" else None


def fit_and_measure(this: Run, scene: Scene, model: GaussianModel) -> Record:
    """Train, then measure what came out."""
    config = this.config
    data = config.data
    views = scene.val if config.scene.eval_split == "val" else scene.test
    if not views:
        raise InputError(f"{scene.name}: expected views in the split '{config.scene.eval_split}', there are none")
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
        print(f"{_name(this)}: goes on from step {trainer.step} of {path}", file=sys.stderr)
    trainer.run(lambda state: checkpoint.save(path, *hashes, state), _name(this))

    pictures = [(view.name, trainer.render(view), view.image) for view in views]
    weights = {name: Path(file) for name, file in (("alex", config.protocol.lpips_alex),
                                                   ("vgg", config.protocol.lpips_vgg)) if file}  # fmt: skip
    quality = evaluate(pictures, background=scene.background, quantised=config.protocol.quantise, weights=weights)
    frame, made = frames(trainer, views[0])
    times = time_renders(
        lambda i: frame(views[i % len(views)]),
        count=max(config.protocol.renders, len(views)),
        synchronise=synchroniser(config.device),
    )
    shown = pictures[:: max(1, len(pictures) // max(1, config.protocol.pictures))][: config.protocol.pictures]
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
    record = unfinished(this, scene, model, "ok", None)
    return replace(
        record, protocol=record.protocol | made,
        metrics=metrics, missing=missing, per_view=quality.per_view, cost=cost, curve=trainer.curve.points,
    )  # fmt: skip


def frames(trainer: Trainer, first: View) -> tuple[Callable[[View], Tensor], dict[str, str]]:
    """What FPS is measured on, and on a GPU how it makes frames: `replayed` as a CUDA graph, or `launched` anew."""
    config = trainer.config
    if trainer.model.backend.name != "cuda":
        return trainer.render, {}
    replay = Replay(trainer.model, trainer.background, config.raster.antialias)
    try:
        replay(first.camera, first.time)
    except RuntimeError as error:  # an operation that waits for the device, in a model or a scheme written in torch
        print(f"FPS is that of launched frames: CUDA cannot record this model: {_one_line(error)}", file=sys.stderr)
        return trainer.render, {"frames": "launched"}
    return lambda view: replay(view.camera, view.time), {"frames": "replayed"}


def with_best(quality: Quality, trainer: Trainer, config: Config) -> tuple[dict[str, float | None], dict[str, str]]:
    """The metrics of the last iteration, and beside them what the evaluated split had at the best iterations."""
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


def unfinished(this: Run, scene: Scene, model: GaussianModel, status: str, reason: str | None) -> Record:
    """A record of what was run, without what came out."""
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
    """One run in a few words."""
    if record.metrics is None or record.cost is None:
        return f"{record.status}: {record.reason}"
    psnr = record.metrics["psnr"]
    return (
        f"PSNR {'-' if psnr is None else format(psnr, '.2f')} dB, {record.cost.num_gaussians} Gaussians, "
        f"trained in {record.cost.train_s:.0f} s, {record.cost.fps:.0f} FPS"
    )


def _name(this: Run) -> str:
    return f"{this.config.scene.name} {this.label} seed{this.config.seed}"


def _one_line(error: BaseException) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]

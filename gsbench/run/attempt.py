"""Attempt a run: check its config and data, fit the model, measure it, and describe the result in a record."""

import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy.typing as npt
import torch
from torch import Tensor

from gsbench import kernels, models
from gsbench.config import Config, DataConfig
from gsbench.effects import picture
from gsbench.effects.choose import import_compiler
from gsbench.errors import InputError, one_line
from gsbench.measure import record as records
from gsbench.measure.images import Pixels, strip, write_png
from gsbench.measure.provenance import provenance
from gsbench.measure.quality import Quality, evaluate, evenly
from gsbench.measure.record import Cost, Effects, OnDemand, Record, TimeScreen
from gsbench.measure.settings import training_hash
from gsbench.measure.speed import Effort, peak_memory, reset_peak_memory, synchroniser, time_renders
from gsbench.models import GaussianModel
from gsbench.models.cuda_graph import GraphedFrames
from gsbench.models.start import start_from
from gsbench.run import progress, stop
from gsbench.run.auto import is_auto, plain_model, resolve, with_candidate
from gsbench.run.checks import check_config, check_scene, evaluated_views, lpips_weights, trained_start
from gsbench.run.identity import Run
from gsbench.run.load import plain_description
from gsbench.run.setup import build, load_scene
from gsbench.scenes import Points, Scene, View
from gsbench.scenes.points import frustum_points, random_points
from gsbench.scenes.trained import TrainedGaussians
from gsbench.train import checkpoint
from gsbench.train.checkpoint import Checkpoint
from gsbench.train.finite_check import DivergedError
from gsbench.train.loop import Trainer
from gsbench.train.seeding import generator


class Attempt:
    """One attempt at a run. It can describe its state in a record, also where an error stopped it."""

    def __init__(self, this: Run) -> None:
        """Take a run that has a name and a folder; nothing is read or checked yet."""
        self.this = this
        # model=auto is checked by its candidate with more effects; `fit` chooses the candidate.
        self.config = with_candidate(this.config, "moving") if is_auto(this.config) else this.config
        self.screen: TimeScreen | None = None
        self._screening = Effort()
        self.model: GaussianModel | None = None
        self.scene: Scene | None = None
        self.start: TrainedGaussians | None = None  # trained Gaussians to start from; None: points
        self._shown: list[tuple[npt.ArrayLike, npt.ArrayLike]] = []
        self._classes: Pixels | None = None

    def prepare(self) -> tuple[GaussianModel, Scene]:
        """Check the config, build the model and load the scene, so that faults are refused before step 0.

        Raises:
            InputError: the config, the device or the data has a fault.
        """
        check_config(self.config)
        self.model = build(self.config)
        self.start = trained_start(self.config)
        self.scene = scene = load_scene(self.config)
        if is_auto(self.this.config) and not scene.has_time:
            self.config = with_candidate(self.this.config, "static")
            self.model = build(self.config)
        check_scene(self.model, scene, self.config)
        evaluated_views(scene, self.config.scene.eval_split)
        records.check(self.describe("failed", "not run"), "planned record")
        return self.model, scene

    def fit(self, model: GaussianModel, scene: Scene) -> Trainer:
        """Train to the end, starting from this training's checkpoint where the run's folder has one.

        Raises:
            InputError: a training image or the checkpoint is damaged, or a parameter has no learning rate.
            DivergedError: a loss or gradient was not finite.
            Stopped: the process was told to end; the checkpoint is saved.
        """
        this = self.this
        if is_auto(this.config):
            model = self._choose(scene)
        trainer = self.trainer(model, scene)
        reset_peak_memory(self.config.device)
        path, hashes = this.folder / checkpoint.FILE_NAME, (training_hash(this.plain), scene.fingerprint)
        state = checkpoint.load(path, *hashes, self.config.device) if self.config.resume else None
        if state is not None:
            trainer.load_state_dict(state)
            print(f"{this.name}: continues from step {trainer.step} of {path}", file=sys.stderr)
        elif self.screen is not None:
            trainer.stages.add("screen", self.screen.seconds)
            trainer.effort.add(self._screening)
        about = self.plain(), plain_description(scene)
        with stop.requested() as request:
            report = progress.Reporter(this.folder, this.overrides, self.config.train.iterations)

            def goes_on() -> bool:
                if report.is_due():
                    report(trainer.step, sum(trainer.stages.seconds.values()), trainer.curve.last)
                return request.signal is None

            trainer.run(lambda state: checkpoint.save(path, Checkpoint(*hashes, state, *about)), this.name, goes_on)
            if request.signal is not None and trainer.step < self.config.train.iterations:
                report.end()
                if request.signal == signal.SIGUSR2:  # submitit's handler puts the job back into the queue, and ends it
                    request.hand_on(request.signal)
                raise stop.Stopped(request.signal, f"{this.name}: stopped at step {trainer.step}, saved in {path}: "
                                                   f"the same command continues from there")  # fmt: skip
        for name, parameter in trainer.model.named_parameters():  # no image shows a colour of -inf: it is black
            if not parameter.isfinite().all():
                raise DivergedError(f"step {trainer.step}: '{name}' has values that are not finite")
        if not len(trainer.model):
            raise InputError("no Gaussian is left: the training pruned all of them; look at train.densify, "
                             "model.min_opacity and data.initial_half_width")  # fmt: skip
        return trainer

    def trainer(self, model: GaussianModel, scene: Scene) -> Trainer:
        """Initialise a model from the scene's points or from trained Gaussians, and prepare its training."""
        random = generator(self.config.seed)
        if self.start is not None:
            start_from(model, self.start, scene.extent, random)
        else:
            points = scene.points or initial_points(self.config.data, scene, random)
            model.initialise(points, scene.extent, random)
        model.to(self.config.device)
        return Trainer(model, scene, evaluated_views(scene, self.config.scene.eval_split), self.config)

    def plain(self) -> dict[str, Any]:
        """Return the training's config in plain values; for model=auto it holds the chosen model."""
        if not is_auto(self.this.config):
            return self.this.plain
        return self.this.plain | {"model": plain_model(self.config), "agr": self.config.agr}

    def _choose(self, scene: Scene) -> GaussianModel:
        """Choose the model of model=auto, and print the reason."""
        import_compiler()
        with self._screening:
            self.config, self.screen = resolve(self.this.config, scene)
        self.model = model = build(self.config)
        print(f"{self.this.name}: time is {self.screen.decision}: {self.screen.reason}; {self.config.model.name}"
              f"{' with AGR' if self.config.agr else ''}", file=sys.stderr)  # fmt: skip
        return model

    def measure(self, trainer: Trainer) -> Record:
        """Measure the images, the speed and the size of a fitted model."""
        config, views = self.config, trainer.views
        pictures = config.protocol.pictures
        chosen = range(0, len(views), max(1, len(views) // max(1, pictures)))[:pictures]

        def images() -> Iterator[tuple[str, Tensor, Tensor]]:
            for i, view in enumerate(views):  # one at a time: fifty views of 2048 x 1088 take 3 GB
                render, truth = trainer.render(view), view.image
                if i in chosen:
                    self._shown.append((render.cpu().numpy(), truth.cpu().numpy()))
                yield view.name, render, truth

        quality = evaluate(
            images(),
            background=trainer.scene.background,
            quantised=config.protocol.quantise,
            weights=lpips_weights(config),
        )
        frame, made = frames(trainer, views[0])
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
        metrics["psnr_train"] = trainer.psnr(evenly(trainer.scene.train, len(views)))
        record, on_demand = self.describe("ok", None), self._on_demand(trainer)
        if on_demand and self._shown:
            first, renderer = views[0], trainer.renderer
            self._classes = picture.draw(
                trainer.model, first.camera, first.time, renderer.background, renderer.antialias
            )
        return replace(
            record, protocol=record.protocol | made, on_demand=on_demand,
            metrics=metrics, missing=missing, per_view=quality.per_view, cost=cost, curve=trainer.curve.points,
        )  # fmt: skip

    def _on_demand(self, trainer: Trainer) -> OnDemand | None:
        """Return which effects were chosen; None where the config chooses none."""
        if self.screen is None and self.config.effects.gate == "off":
            return None
        gating = trainer.gating
        return OnDemand(self.screen, gating.gates, gating.notes, gating.direction)

    def draw(self) -> None:
        """Write pictures.png of the measured views, and classes.png of a model whose effects were chosen.

        It is called after the record is written, so a full disk costs the pictures and not the record.
        """
        if not self._shown:
            return
        drawn = {"pictures.png": strip(self._shown)}
        if self._classes is not None:
            drawn["classes.png"] = self._classes
        for name, image in drawn.items():
            path = self.this.folder / name
            try:
                write_png(image, path)
            except OSError as error:
                print(f"{self.this.name}: no pictures: {path}: {error.strerror}", file=sys.stderr)

    def describe(self, status: str, reason: str | None) -> Record:
        """Describe the run in a record without measurements: its config, its machine and how it ended.

        Args:
            status: ok, failed or diverged.
            reason: why it failed or diverged; None where it ended well.
        """
        config, scene, this = self.config, self.scene, self.this
        observes = models.find(config.model.name, config.model.module).observes
        camera = scene.train[0].camera if scene else None
        on_gpu = config.device.startswith("cuda") and self.model is not None
        return Record(
            status=status,
            reason=reason,
            experiment=config.experiment,
            model=this.label,
            scene=config.scene.name,
            dataset=config.data.dataset,
            seed=config.seed,
            effects=Effects("time" in observes, "direction" in observes, config.agr),
            protocol={
                "name": config.protocol.name,
                "background": config.data.background,
                "downscale": config.scene.downscale,
                "resolution": f"{camera.width}x{camera.height}" if camera else "not loaded",
                "eval_split": config.scene.eval_split,
                "quantise": config.protocol.quantise,
                "backend": self.model.backend.name if self.model else config.raster.backend,
                "paper_dataset": config.data.paper_dataset,
            },
            provenance=provenance(
                config=this.plain,
                data_hash=scene.fingerprint if scene else "not loaded",
                threads=torch.get_num_threads(),
                instruction_set=kernels.instruction_set(),
                device=torch.cuda.get_device_name(config.device) if on_gpu else None,
            ),
            variant=this.variant,
            overrides=this.overrides,
        )


def initial_points(data: DataConfig, scene: Scene, random: torch.Generator) -> Points:
    """Sample points to start from where the data set has none: in a cube, or in the frustum that all cameras share."""
    if data.initial_half_width is not None:
        return random_points(data.initial_points, data.initial_half_width, random)
    cameras = [view.to("cpu").camera for view in scene.train]
    return frustum_points(data.initial_points, cameras, scene.extent, random)


def frames(trainer: Trainer, first: View) -> tuple[Callable[[View], Tensor], dict[str, str]]:
    """Choose the function whose FPS is measured, and the record's protocol entry on how it makes frames on a GPU.

    Frames are `replayed` from a CUDA graph where CUDA can record the model. Otherwise each frame is `launched` anew.
    """
    if trainer.model.backend.name != "cuda":
        return trainer.render, {}
    graphed = GraphedFrames(trainer.model, trainer.renderer.background, trainer.renderer.antialias)
    try:
        graphed(first.camera, first.time)
    except RuntimeError as error:  # an operation that waits for the device, in a model or a scheme written in torch
        print(f"FPS is that of launched frames: CUDA cannot record this model: {one_line(error)}", file=sys.stderr)
        return trainer.render, {"frames": "launched"}
    return lambda view: graphed(view.camera, view.time), {"frames": "replayed"}


def with_best(quality: Quality, trainer: Trainer, config: Config) -> tuple[dict[str, float | None], dict[str, str]]:
    """Add the metrics of the evaluated split at the best iterations to those of the last iteration."""
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

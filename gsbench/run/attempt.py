"""Run one training in four steps (prepare, choose the model, train, measure), and describe it in a record."""

import sys
from dataclasses import replace

import torch

from gsbench import kernels, models
from gsbench.gates.hook import Gating
from gsbench.measure import record as records
from gsbench.measure.images import Pixels, write_png
from gsbench.measure.provenance import provenance
from gsbench.measure.record import Effects, OnDemand, Record, Status
from gsbench.measure.speed import reset_peak_memory
from gsbench.models import GaussianModel
from gsbench.run import fitting, measuring
from gsbench.run.auto_model import (
    Resolved,
    before_scene,
    best_of,
    check_candidates,
    check_compare,
    is_auto,
    reporter,
    resolve,
    with_candidate,
)
from gsbench.run.candidates import plain
from gsbench.run.checks import check_config, check_scene, check_values, evaluated_views
from gsbench.run.identity import Run
from gsbench.run.lengths import best_length
from gsbench.run.log import RunLog
from gsbench.run.setup import build, check_start, load_scene, trained_start
from gsbench.scenes import Scene
from gsbench.scenes.gaussian_ply import TrainedGaussians
from gsbench.scenes.placement import gaussians_to_standard
from gsbench.train.hooks.choices import Choices, lengths_of
from gsbench.train.loop import Trainer


class Attempt:
    """One attempt at a run (a training and its measurement), which can be described in a record even after an error."""

    def __init__(self, this: Run) -> None:
        """Store the run; no file is read and no setting is checked yet."""
        self.this = this
        self.resolved = Resolved(before_scene(this.config))
        self.model: GaussianModel | None = None
        self.scene: Scene | None = None
        self.start: TrainedGaussians | None = None  # trained Gaussians to start from; None to start from points
        self.log: RunLog | None = None  # from the first step on
        self._images: dict[str, Pixels] = {}

    def prepare(self) -> tuple[GaussianModel, Scene]:
        """Check the settings, build the model and load the scene, so that errors are found before the first step.

        Raises:
            InputError: the settings, the device or the data are invalid.
        """
        config = self.resolved.config
        check_compare(self.this.config)
        check_config(config)
        if is_auto(self.this.config):
            check_values(with_candidate(self.this.config, "static"))
        self.model = build(config)
        start = trained_start(config)
        self.scene = scene = load_scene(config)
        if is_auto(self.this.config) and not scene.has_time:
            self.resolved = Resolved(config := with_candidate(self.this.config, "static"))
            self.model = build(config)
        elif config.effects.compare:
            check_candidates(self.this.config, scene)
        check_scene(self.model, scene, config)
        if start is not None:
            self.start = gaussians_to_standard(start, scene.placement)
            check_start(self.start, scene)
        evaluated_views(scene, config.scene.eval_split)
        records.check(self.describe("failed", "not run"), "planned record")
        return self.model, scene

    def fit(self, model: GaussianModel, scene: Scene) -> Trainer:
        """Train to the last step; for model=auto, a test of the scene first chooses a model with or without time.

        If the scene changes with time, `effects.compare` chooses the model by PSNR on val. It raises the same errors as
        `gsbench.run.fitting.resume` and `fit`, `gsbench.run.auto_model.best_of` and `gsbench.run.lengths.best_length`.
        """
        this = self.this
        if is_auto(this.config):
            self.resolved = resolve(this, scene)
            self.model = model = build(self.resolved.config)
        screen, device = self.resolved.screen, this.config.device
        if self.resolved.compares or lengths_of(this.config) is not None:
            reset_peak_memory(device)
            choose = best_of if self.resolved.compares else best_length
            trainer = choose(this, scene, self.start, self.resolved)
            self.resolved, self.model = replace(self.resolved, config=trainer.config), trainer.model
        else:
            trainer = self.trainer(model, scene)
            reset_peak_memory(device)
            if not fitting.resume(trainer, this, fitting.saved_state(this, scene)) and screen is not None:
                trainer.stages.add("screen", screen.seconds)
                trainer.effort.add(self.resolved.effort)
        self.log = RunLog(this, trainer)
        fitting.fit(trainer, this, plain(this, trainer.config), lambda: reporter(this, trainer), self.log.follow)
        return trainer

    def trainer(self, model: GaussianModel, scene: Scene) -> Trainer:
        """Initialise the Gaussians from the scene's points or from trained Gaussians; return the trainer at step 0."""
        return fitting.trainer_of(model, scene, self.resolved.config, self.start)

    def measure(self, trainer: Trainer) -> Record:
        """Measure image quality, speed and size of the trained model, and return the record."""
        on_demand = self._on_demand(trainer)
        found = measuring.measure(trainer, self.resolved.config, on_demand is not None)
        self._images = found.images
        record = self.describe("ok", None)
        results = {name: value for hook in trainer.hooks for name, value in hook.results().items()}
        known = {name: value for name, value in results.items() if hasattr(record, name)}
        parts = {name: value for name, value in results.items() if name not in known}
        return replace(
            record, protocol=record.protocol | found.frames, on_demand=on_demand, metrics=found.metrics,
            missing=found.missing, per_view=found.per_view, regions=found.regions,
            cost=found.cost, curve=trainer.curve.points, **known, parts=parts,
            exact=sorted(trainer.exact.union(*(view.exact for view in found.per_view))),
        )  # fmt: skip

    def _on_demand(self, trainer: Trainer) -> OnDemand | None:
        """Return the decisions on removing time, direction or AGR (a network); None if the settings ask for none."""
        screen, gating = self.resolved.screen, trainer.hook(Gating)
        if screen is None and self.resolved.config.effects.gate == "off":
            return None
        return OnDemand(screen, gating.gates, gating.notes, gating.direction,
                        trainer.hook(Choices).chosen.comparison)  # fmt: skip

    def draw(self) -> None:
        """Write the measured renders as pictures.png, and the effects that Gaussians keep as effect_sets.png.

        The effects are time, direction and AGR (neural refinement). effect_sets.png is written only if the settings ask
        to remove effects from Gaussians. If the disk is full, the run has no images, but its record is already written.
        """
        for name, image in self._images.items():
            path = self.this.folder / name
            try:
                write_png(image, path)
            except OSError as error:
                print(f"{self.this.name}: no pictures: {path}: {error.strerror}", file=sys.stderr)

    def describe(self, status: Status, reason: str | None) -> Record:
        """Return a record of the run without measurements: its settings, its machine and its status.

        Args:
            status: how the run ended: ok, failed or diverged.
            reason: why the run failed or diverged; None if it is ok.
        """
        config, scene, this = self.resolved.config, self.scene, self.this
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
                **{key: value for key in ("resize", "val_every") if (value := getattr(config.scene, key)) is not None},
                **({"repaired": ", ".join(scene.repaired)} if scene and scene.repaired else {}),
            },
            provenance=provenance(
                config=this.plain,
                data_hash=scene.fingerprint if scene else "not loaded",
                data_notes=scene.notes if scene else (),
                threads=torch.get_num_threads(),
                instruction_set=kernels.instruction_set(),
                device=torch.cuda.get_device_name(config.device) if on_gpu else None,
            ),
            variant=this.variant,
            overrides=this.overrides,
        )

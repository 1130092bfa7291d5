"""Train a model: gradient steps on batches of views, density control, and measurements of PSNR on val."""

import math
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from gsbench.config import Config
from gsbench.errors import InputError, one_line
from gsbench.measure.curve import Curve
from gsbench.measure.exact_views import MOST_PSNR, rank
from gsbench.measure.record import LengthChoice, ModelComparison
from gsbench.measure.schema import parse
from gsbench.measure.speed import Effort, StageClock
from gsbench.models import GaussianModel
from gsbench.scenes import Scene, View
from gsbench.schedule import Schedule
from gsbench.train.averaging import NO_AVERAGE, Average
from gsbench.train.checkpoint import whole_number
from gsbench.train.densify import densification, gaussian_limit
from gsbench.train.densify.minimum_lifetime import MinimumLifetime
from gsbench.train.densify.minimum_scale import MinimumScale
from gsbench.train.densify.scores import ErrorScore
from gsbench.train.finite_check import DivergedError, FiniteCheck
from gsbench.train.gating import NO_GATES, Gating
from gsbench.train.optim import Optimizer
from gsbench.train.penalties import Penalties
from gsbench.train.pyramid import Pyramid
from gsbench.train.renderer import Renderer
from gsbench.train.rows import Rows
from gsbench.train.seeding import batch, generator
from gsbench.train.step import Step, fitting_threads
from gsbench.train.stopping import NOTHING_KEPT, EarlyStop
from gsbench.train.thinning import blend_weights, heaviest


@dataclass
class Best:
    """Hold the best PSNR on val so far, and two PSNRs of the evaluated split, which is test or val.

    One is measured at the iteration with the best PSNR on val, the other is the highest PSNR on the evaluated split.
    """

    val: float = -math.inf  # best PSNR on val so far, dB
    eval_at_best_val: float | None = None  # PSNR of the evaluated split at that iteration
    eval: float | None = None  # best PSNR of the evaluated split; to choose an iteration by it leaks test data


class Trainer:
    """Train one model on one scene. `step` is the number of finished steps; the state can be saved after each step."""

    def __init__(self, model: GaussianModel, scene: Scene, views: list[View], config: Config) -> None:
        """Make the optimizer, the density control and all other parts of the training of a model.

        Args:
            model: the initialised model on `config.device`.
            scene: the scene, which has the training and the val views.
            views: the views (test or val) on which results are measured.
            config: the config of the run.

        Raises:
            InputError: an image of any of these views has a value that is not finite.
        """
        for view in (*scene.train, *scene.val, *views):
            if view.pixels.is_floating_point() and not view.pixels.isfinite().all():
                raise InputError(f"{view.name}: expected an image of finite values, got NaN or inf: render it again")
        train = config.train
        self.model = model
        self.scene = scene
        self.views = views
        self.config = config
        self.renderer = Renderer(scene.train[0].image.new_tensor(scene.background), config.raster.antialias)
        self.schedule = Schedule(train, config.model.sh_degree, config.agr)
        self.optimizer = Optimizer(model, config.model, train, scene.extent, config.optim)
        self.rows = Rows(model, self.optimizer)
        score = ErrorScore(model, scene.train, self.renderer, train.ssim_weight)
        self.density = densification(self.rows, train.densify, config.model.min_opacity, len(scene.train), score)
        self.limit = gaussian_limit(train.densify, scene.train, len(model))
        self.minimum_scale = MinimumScale(model, [view.camera for view in scene.train])
        self.rows.add(self.minimum_scale)
        self.minimum_lifetime = MinimumLifetime(model, scene.train)
        self.average = Average(model, self.schedule.average_start)
        self.rows.add(self.average)
        self.penalties = Penalties(self.rows, train.penalties, self.schedule, config.seed, scene.train)
        self.pyramid = Pyramid(scene.train)
        self.stages = StageClock(config.device)
        self.effort = Effort()
        self.gradients = Step(model, self.renderer.background, train.ssim_weight, self.renderer.antialias, self.stages)
        self.gating = Gating(self.rows, scene, self.renderer, config)
        self.finite_check = FiniteCheck(config.device)
        if config.device.startswith("cuda"):  # a bad step is found some steps later, and must not be applied until then
            self.optimizer.skip = self.finite_check.skip
        self.curve = Curve()
        self.best = Best()
        self.exact: set[str] = set()  # names of views that a measurement found exact (gsbench.measure.exact_views)
        self.early_stop = EarlyStop(self.schedule, train.patience)
        self.comparison: ModelComparison | None = None  # by which model=auto chose this model
        self.length_choice: LengthChoice | None = None  # by which `train.lengths` chose this training
        self.step = 0
        self._is_full = False  # whether the largest allowed number of Gaussians was reached

    def run(
        self, save: Callable[[dict[str, Any]], None], label: str, goes_on: Callable[[], bool] = lambda: True
    ) -> None:
        """Train until the last step, until PSNR on val no longer rises, or until `goes_on()` returns False.

        The seconds of the training (`stages`) are the wall-clock seconds of all steps, and of the removal of effects at
        the end. Measuring on val, `save`, `goes_on` and the progress bar do not count.

        Args:
            save: a function that gets the state every `checkpoint_minutes` and once at the end.
            label: the name of the run in the progress bar.
            goes_on: a function that is called after every step; the training stops if it returns False.

        Raises:
            DivergedError: a loss or gradient was not finite. The last saved state is from before that step.
        """
        train = self.config.train
        if self.step == train.iterations:  # a checkpoint of a finished training
            return
        saved = time.monotonic()
        every = 0.2 if sys.stderr.isatty() else 20.0  # seconds between updates of the bar; rare if stderr is a file
        with tqdm(
            total=train.iterations, initial=self.step, desc=label, unit="it", mininterval=every, maxinterval=every
        ) as bar:
            while self.step < train.iterations:
                with self.effort, self.stages.running():
                    camera, factor = self.scene.train[0].camera, self.schedule.resolution(self.step)
                    with fitting_threads(len(self.model), camera.width * camera.height // factor**2):
                        self._descend()
                        self.average.add(self.step)
                measured = self.schedule.measures(self.step)
                if measured:
                    self._measure()
                if self.schedule.resets(self.step):  # after the measuring: opacities take hundreds of steps to recover
                    with self.effort, self.stages("density"):
                        self.density.reset_opacities()
                self.step += 1
                bar.update()
                # The bar shows the seconds of the last measurement: the clock itself waits for a GPU when it is read.
                loss = f"loss {self.finite_check.loss:.4f}"
                bar.set_postfix_str(f"{self.curve.progress}, {loss}, {len(self.model)} Gaussians", refresh=False)
                if self.step == train.iterations or (measured and self.early_stop.is_over(self.step)):
                    self._keep_best()
                if not goes_on():
                    break
                if time.monotonic() - saved >= 60 * train.checkpoint_minutes and self.step < train.iterations:
                    save(self.state_dict())
                    saved = time.monotonic()
        if self.step == train.iterations and self.config.effects.gate != "off":
            self.gate_at_end()
        save(self.state_dict())

    def _average(self, last: float) -> float:
        """End the training with averaged parameters (`train.average_from`) if PSNR on val is higher with them.

        The last parameters are kept if there is no val, or if results are measured on val: these would be too high.

        Args:
            last: PSNR of the last parameters on val, dB; NaN if there is no val.

        Returns:
            PSNR on val of the parameters that are kept, dB.
        """
        if not self.scene.val or self.config.scene.eval_split == "val":
            self.average.forget()
            return last
        kept = self.average.keep_better(last, lambda: self.psnr(self.scene.val), self.step + 1)
        if self.average.kept:
            tqdm.write(f"step {self.step + 1}: PSNR on val is {kept - last:.2f} dB higher with parameters averaged "
                       f"over the last {self.average.kept} iterations: the training ends with these",
                       file=sys.stderr)  # fmt: skip
        return kept

    def _keep_best(self) -> None:
        """End the training with the Gaussians of the iteration that had the best PSNR on val (`train.patience`)."""
        kept = self.early_stop.take(self.step)
        stop = self.early_stop.stop
        if stop is not None and len(equal := self.curve.equal_to(stop.kept)) > 1:
            tqdm.write(f"step {stop.iteration}: PSNR on val is equal at {len(equal)} steps, {equal[0].iteration} to "
                       f"{equal[-1].iteration}: it cannot decide, and the last of them is kept",
                       file=sys.stderr)  # fmt: skip
        if kept is not None:
            self.load_state_dict(self.state_dict() | kept)
            assert stop is not None
            tqdm.write(f"step {stop.iteration}: PSNR on val is highest at step {stop.kept}: the training ends with the "
                       f"Gaussians of that step", file=sys.stderr)  # fmt: skip
        self.step = self.config.train.iterations

    def gate_at_end(self, by_halves: bool = False) -> None:
        """Make Gaussians independent of time, direction or AGR (a network) after the training.

        PSNR and frame time are measured before and after. The measurement does not count as training time.

        Args:
            by_halves: whether a Gaussian may become independent of only one of time and direction. This saves bytes but
                no frame time, and nearly doubles the time of this function (docs/effects.md).
        """
        self.model.set_active(self.schedule.active(self.step - 1))
        ungated = self.gating.now()
        with self.effort, self.stages("gate"):
            if self.gating.at_end(by_halves):
                self.minimum_scale.update()
        self.gating.compare(ungated, self.views)

    def _descend(self) -> None:
        """Do one training step on a batch of views: compute gradients, update parameters, control the density."""
        step, train, stages, schedule = self.step, self.config.train, self.stages, self.schedule
        self.model.set_active(self.schedule.active(step))
        factor = schedule.resolution(step)
        chosen = batch(step, len(self.scene.train), train.batch_size, self.config.seed)
        views = [self.pyramid.view(i, factor) for i in chosen]
        with stages("loss"):
            penalties = self.penalties.at(step, views)
        try:
            seen = self.gradients(views, penalties)
        except DivergedError as error:
            raise DivergedError(f"step {step}: {error}") from None
        if step < schedule.densify_stop:
            with stages("density"):
                for view, one in zip(views, seen, strict=True):
                    self.density.accumulate(one.drawn, one.g_means2d, view.camera.width, view.camera.height, len(views))
        self.finite_check.see(step, torch.stack([one.loss for one in seen]).sum(), self.optimizer.groups)
        with stages("optimizer"):
            drawn = torch.cat([one.drawn for one in seen]).any(0) if self.optimizer.is_sparse else None
            self.optimizer.step(step, drawn, slowed=self.gating.slows_agr(step))
            self.minimum_scale.hold()
            self.minimum_lifetime.hold()
        with stages("density"):
            if self.density.adds_noise:
                rate = self.optimizer.rates_at(step)["means"]
                self.density.add_noise(rate, generator(self.config.seed, step, 1))  # 1: not the numbers of `densify`
            if schedule.densifies(step):
                most = schedule.most_gaussians(step, self.limit)
                refused = self.density.densify(generator(self.config.seed, step), schedule.has_reset(step), most)
                if factor == 1:
                    self._tell_full(refused, most)
            if schedule.thins(step):
                self._thin()
            if schedule.densifies(step) or schedule.thins(step):
                self.rows.sort_by_time()
            if (step + 1) % schedule.densify_every == 0:
                self.minimum_scale.update()
            if schedule.resolution(step + 1) != factor:
                self.pyramid.keep_only(schedule.resolution(step + 1))
        if self.config.effects.gate == "both" and schedule.gates(step):
            with stages("gate"):
                if self.gating.in_training(step + 1):
                    self.minimum_scale.update()

    def _thin(self) -> None:
        """Keep a share (`train.densify.thin_to`) of the Gaussians: those with the largest sums of blend weights."""
        share = self.config.train.densify.thin_to
        assert share is not None
        self.rows.select(heaviest(blend_weights(self.model, self.scene.train, self.renderer.antialias), share))

    def _tell_full(self, refused: int, most: int) -> None:
        """Print once that the largest number of Gaussians is reached; `refused` Gaussians were not added."""
        if refused and not self._is_full:
            self._is_full = True
            which = "default of " if self.config.train.densify.max_gaussians is None else ""
            tqdm.write(f"step {self.step + 1}: {most} Gaussians are the most ({which}train.densify.max_gaussians): "
                       f"{refused} of smaller gradients are not cloned or split", file=sys.stderr)  # fmt: skip

    def _measure(self) -> None:
        """Measure PSNR on val and add it to the training curve. This time does not count as training time."""
        self.model.set_active(self.schedule.active(self.step))
        val = self.psnr(self.scene.val) if self.scene.val else math.nan
        if self.step + 1 == self.config.train.iterations:
            val = self._average(val)
        self.curve.add(self.step + 1, sum(self.stages.seconds.values()), val)
        self.early_stop.see(self.step + 1, val, self._state_of_gaussians)
        leak = self.config.protocol.best_on_test
        is_best = val >= rank(self.best.val)  # of equal ones the last; a NaN is never the best
        if not leak and not is_best:
            return
        now = self.psnr(self.views)
        if is_best:
            self.best.val, self.best.eval_at_best_val = val, now
        if leak and rank(now) >= rank(self.best.eval):
            self.best.eval = now

    def psnr(self, views: list[View]) -> float:
        """Return the mean PSNR of the model over views in dB, and add exact views to `exact`."""
        scores = self.renderer.psnr_of_views(self.model, views)
        self.exact |= {view.name for view, score in zip(views, scores, strict=True) if score == MOST_PSNR}
        return sum(scores) / len(scores)

    def render(self, view: View) -> Tensor:
        """Render the image of the model for the camera and time of a view, [H, W, 3]."""
        return self.renderer.image(self.model, view)

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the training for a checkpoint, with all measurements so far.

        Raises:
            DivergedError: a loss or gradient was not finite.
        """
        self.finite_check.look()
        return {
            "step": self.step,
            **self._state_of_gaussians(),
            "stages": self.stages.state_dict(),
            "effort": self.effort.state_dict(),
            "curve": self.curve.state_dict(),
            "best": vars(self.best).copy(),
            "exact": sorted(self.exact),
            "early_stop": self.early_stop.state_dict(),
            "comparison": asdict(self.comparison) if self.comparison else None,
            "length_choice": asdict(self.length_choice) if self.length_choice else None,
        }

    def _state_of_gaussians(self) -> dict[str, Any]:
        """Return the part of the state that belongs to the Gaussians, and not to the measurements of the training."""
        return {
            "model": self.model.pack(),
            "optimizer": self.optimizer.state_dict(),
            "density": self.density.state_dict(),
            "minimum_scale": self.minimum_scale.state_dict(),
            "gating": self.gating.state_dict(),
            "average": self.average.state_dict(),
            "penalties": self.penalties.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the training from a `state_dict`. Its results are bit-equal to those of an uninterrupted run.

        Raises:
            InputError: a part of the state is missing or belongs to another training.
        """
        try:
            self.step = whole_number("step", state["step"], self.config.train.iterations)
            self.model.load_state(state["model"])
            self.optimizer.load_state_dict(state["optimizer"])
            self.density.load_state_dict(state["density"])
            self.minimum_scale.load_state_dict(state["minimum_scale"])
            self.gating.load_state_dict(state.get("gating", NO_GATES))
            self.average.load_state_dict(state.get("average", NO_AVERAGE))
            self.penalties.load_state_dict(state.get("penalties", {}))
            self.stages.load_state_dict(state["stages"])
            self.effort.load_state_dict(state.get("effort"))
            self.curve.load_state_dict(state["curve"])
            best = Best(**state["best"])
            self.best = Best() if best.val == math.inf else best  # older versions stored an infinite PSNR
            self.exact = set(parse(list[str], state.get("exact", []), "checkpoint: exact"))
            self.early_stop.load_state_dict(state.get("early_stop", NOTHING_KEPT))
            self.comparison = comparison_of(state)
            self.length_choice = length_choice_of(state)
        except (InputError, MemoryError):
            raise
        except Exception as error:  # a part may be of any type
            raise InputError(f"checkpoint: expected the state of this training: {one_line(error)!r:.200}") from None
        self.model.set_active(self.schedule.active(max(0, self.step - 1)))


def comparison_of(state: dict[str, Any]) -> ModelComparison | None:
    """Return the comparison by which model=auto chose the model of a `Trainer.state_dict`; None if there was none.

    Raises:
        InputError: the state does not hold a comparison as expected.
    """
    found = state.get("comparison")
    return None if found is None else parse(ModelComparison, found, "checkpoint: comparison")


def length_choice_of(state: dict[str, Any]) -> LengthChoice | None:
    """Return the choice of `train.lengths` in a `Trainer.state_dict`; None if there was none.

    Raises:
        InputError: the state does not hold a choice as expected.
    """
    found = state.get("length_choice")
    return None if found is None else parse(LengthChoice, found, "checkpoint: length_choice")

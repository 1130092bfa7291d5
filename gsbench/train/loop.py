"""Train a model: gradient steps on batches of views, density control, hooks, and measurements of PSNR on val."""

import math
import sys
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeVar

import torch
from torch import Tensor
from tqdm import tqdm

from gsbench.config import Config
from gsbench.errors import InputError, one_line
from gsbench.measure.curve import Curve
from gsbench.measure.exact_views import MOST_PSNR
from gsbench.measure.speed import Effort, StageClock
from gsbench.models import GaussianModel
from gsbench.reading import parse
from gsbench.scenes import Scene, View
from gsbench.schedule import Schedule
from gsbench.train.batches import Batches
from gsbench.train.checkpoint import whole_number
from gsbench.train.density.control import DensityControl
from gsbench.train.divergence import LOOK_EVERY, DivergedError, FiniteCheck
from gsbench.train.hooks import Hook, hook_types
from gsbench.train.optim import Optimizer
from gsbench.train.renderer import Renderer
from gsbench.train.rows import Rows
from gsbench.train.step import Step, fitting_threads
from gsbench.train.update import Update

H = TypeVar("H", bound=Hook)


class Trainer:
    """Train one model on one scene. `step` is the number of finished steps; the state can be saved after each step."""

    def __init__(self, model: GaussianModel, scene: Scene, views: list[View], config: Config) -> None:
        """Make the parts of a training of an initialised model; results are measured on `views` (test or val).

        Raises:
            InputError: an image of any view has a value that is not finite.
        """
        for view in (*scene.train, *scene.val, *views):
            if view.pixels.is_floating_point() and not view.pixels.isfinite().all():
                raise InputError(f"{view.name}: expected an image of finite values, got NaN or inf: render it again")
        self.model = model
        self.scene = scene
        self.views = views
        self.config = config
        self.step = 0
        self.done_again: int | None = None  # the last step to which the training went back, since it was bad
        # The counts of `StepReplay` before the steps at which the CPU has not looked yet, and their steps.
        self.counts_before: deque[tuple[int, dict[str, int]]] = deque(maxlen=LOOK_EVERY)
        self.renderer = Renderer(scene.train[0].image.new_tensor(scene.background), config.raster.antialias)
        self.schedule = Schedule(config.train, config.model.sh_degree, config.agr, model.warm_up)
        self.optimizer = Optimizer(model, config.model, config.train, scene.extent, config.optim)
        self.rows = Rows(model, self.optimizer)
        self.density = DensityControl(self.rows, scene, config, self.schedule, self.renderer)
        self.batches = Batches(scene.train, config.train.batch_size, config.seed)
        self.stages = StageClock(config.device)
        self.effort = Effort()
        self.gradients = Step(
            model, self.renderer.background, config.train.ssim_weight, config.raster.antialias, self.stages
        )
        self.finite_check = FiniteCheck(config.device)
        self.replay = self.gradients.replay
        self.update = Update(self.optimizer, self.finite_check, self.density, self.rows, self.replay, self.stages)
        self.curve = Curve()
        self.exact: set[str] = set()  # names of views that a measurement found exact (gsbench.measure.exact_views)
        self.hooks: list[Hook] = [hook(self) for hook in hook_types()]
        for hook in self.hooks:
            self.rows.add(hook.reindex)
            for name, (parameters, rate) in hook.groups().items():
                self.optimizer.add(name, parameters, rate)
                self.gradients.parameters += parameters

    def hook(self, kind: type[H]) -> H:
        """Return the hook of a class."""
        return next(hook for hook in self.hooks if isinstance(hook, kind))

    @property
    def loss(self) -> float:
        """Return the loss of the last step; on a GPU of one at most 50 steps before."""
        return self.finite_check.loss

    def report(self, text: str) -> None:
        """Print a line above the progress bar."""
        tqdm.write(text, file=sys.stderr)

    def psnr(self, views: list[View]) -> float:
        """Return the mean PSNR of the model over views in dB, and add exact views to `exact`."""
        scores = self.renderer.psnr_of_views(self.model, views)
        self.exact |= {view.name for view, score in zip(views, scores, strict=True) if score == MOST_PSNR}
        return sum(scores) / len(scores)

    def render(self, view: View) -> Tensor:
        """Render the image of the model for the camera and time of a view, [H, W, 3]."""
        return self.renderer.image(self.model, view)

    def run(
        self, save: Callable[[dict[str, Any]], None], label: str, goes_on: Callable[[], bool] = lambda: True
    ) -> None:
        """Train until the last step, until a hook stops the training, or until `goes_on()` is False.

        `goes_on` is called after every step, and `save` gets the state every `checkpoint_minutes` and once at the end.
        The seconds of the training (`stages`) are the wall-clock seconds of all steps, and of what hooks do at the end.
        Measuring on val, `save`, `goes_on` and the progress bar do not count.

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
                try:
                    with self.effort, self.stages.running():
                        camera, factor = self.scene.train[0].camera, self.schedule.resolution(self.step)
                        with fitting_threads(len(self.model), camera.width * camera.height // factor**2):
                            self.train_step()
                except DivergedError as error:
                    self._go_back(error)
                    continue
                measured = self.schedule.measures(self.step)
                if measured:
                    self._measure()
                if self.schedule.resets(self.step):  # after the measuring: opacities take hundreds of steps to recover
                    with self.effort, self.stages("density"):
                        self.density.rule.reset_opacities()
                self.step += 1
                bar.update(self.step - bar.n)
                # The bar shows the seconds of the last measurement: the clock itself waits for a GPU when it is read.
                loss = f"loss {self.loss:.4f}"
                bar.set_postfix_str(f"{self.curve.progress}, {loss}, {len(self.model)} Gaussians", refresh=False)
                if measured and any(hook.stops(self.step) for hook in self.hooks):
                    self.step = train.iterations  # so the training counts as finished
                if not goes_on():
                    break
                if time.monotonic() - saved >= 60 * train.checkpoint_minutes and self.step < train.iterations:
                    self._settle()
                    save(self.state_dict())
                    saved = time.monotonic()
        self._settle()
        if self.step == train.iterations:
            for hook in self.hooks:
                hook.at_end()
        save(self.state_dict())

    def train_step(self) -> None:
        """Do one training step on a batch of views: gradients, parameters, density, and hooks in between.

        Raises:
            DivergedError: this step was bad, or an earlier one. From the first bad one on nothing was changed.
        """
        step, stages = self.step, self.stages
        self.counts_before.append((step, dict(self.replay.counts)))
        self.model.set_active(self.schedule.active(step))
        views = self.batches.at(step, self.schedule.resolution(step))
        with stages("loss"):
            terms = [term for hook in self.hooks for term in hook.loss_terms(step, views)]
            maps = [image_map for hook in self.hooks for image_map in hook.image_maps(step, views)]
        try:
            results = self.gradients(views, terms, maps)
        except DivergedError as error:
            raise DivergedError(f"step {step}: {error}") from None
        if self.schedule.densifies(step):
            self.finite_check.look()
            with stages("density"):
                if all(part.loss.isfinite().all() for part in results):  # otherwise `update` finds the step bad
                    self.density.before_round(views, results)
        with torch.no_grad():
            factors = {name: x for hook in self.hooks for name, x in hook.rate_factors(step).items()}
            self.update(step, views, results, factors)
            if self.finite_check.every > 1 and self._acts(step):  # on a CPU, `update` has looked
                self.finite_check.look()
            with stages("optimizer"):
                for hook in self.hooks:
                    hook.after_update(step)
            with stages("density"):
                self.density.after_update(step, self.optimizer)
            for hook in self.hooks:
                hook.after_density(step)
            for hook in self.hooks:
                hook.after_step(step)

    def _acts(self, step: int) -> bool:
        """Return whether this step ends with work that cannot be undone, so that all steps must be good."""
        schedule = self.schedule
        return (
            schedule.measures(step)
            or schedule.resets(step)
            or self.density.acts(step)
            or any(hook.acts(step) for hook in self.hooks)
        )

    def _settle(self) -> None:
        """Look whether all steps so far were good; otherwise go back."""
        try:
            self.finite_check.look()
        except DivergedError as error:
            self._go_back(error)

    def _go_back(self, error: DivergedError) -> None:
        """Go back to the first bad step, to do it once more call by call, because a recording may be to blame.

        A repeated step fails if its images need more memory than those of the recorded step.

        Raises:
            DivergedError: no recording is to blame.
        """
        with suppress(DivergedError):
            self.finite_check.look()
        bad = self.finite_check.bad
        if bad is None or bad == self.done_again or not self.replay.counts["replayed"]:
            raise error
        self.step = self.done_again = bad
        self.replay.counts |= dict(self.counts_before)[bad]
        self.replay.forget()
        self.finite_check.forget()
        self.update.forget()

    def _measure(self) -> None:
        """Measure PSNR on val and add it to the training curve. This time does not count as training time."""
        self.model.set_active(self.schedule.active(self.step))
        val = self.psnr(self.scene.val) if self.scene.val else math.nan
        for hook in self.hooks:
            val = hook.after_measuring(self.step + 1, val)
        self.curve.add(self.step + 1, sum(self.stages.seconds.values()), val)

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the training for a checkpoint, with all measurements so far.

        Raises:
            DivergedError: a loss or gradient was not finite.
        """
        self.finite_check.look()
        return {
            "step": self.step,
            **self.state_of_gaussians(),
            "hooks": {hook.name: hook.state_dict() for hook in self.hooks},  # also of those that measure
            "stages": self.stages.state_dict(),
            "effort": self.effort.state_dict(),
            "replay": dict(self.replay.counts),
            "curve": self.curve.state_dict(),
            "exact": sorted(self.exact),
        }

    def state_of_gaussians(self) -> dict[str, Any]:
        """Return the part of the state that is restored with the Gaussians of an earlier iteration: no measurements."""
        return {
            "model": self.model.pack(),
            "optimizer": self.optimizer.state_dict(),
            "density": self.density.rule.state_dict(),
            "hooks": {hook.name: hook.state_dict() for hook in self.hooks if not hook.measures},
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
            self.update.forget()
            self.density.rule.load_state_dict(state["density"])
            for hook in self.hooks:
                if not isinstance(saved := state["hooks"][hook.name], dict):
                    raise InputError(f"checkpoint: expected '{hook.name}' as a dict, got {type(saved).__name__}")
                hook.load_state_dict(saved)
            self.stages.load_state_dict(state["stages"])
            self.effort.load_state_dict(state["effort"])
            counts = self.replay.counts  # changed in place
            counts |= {name: whole_number(f"replay: {name}", state["replay"][name], self.step) for name in counts}
            self.curve.load_state_dict(state["curve"])
            self.exact = set(parse(list[str], state["exact"], "checkpoint: exact"))
        except (InputError, MemoryError):
            raise
        except Exception as error:  # a part may be of any type
            raise InputError(f"checkpoint: expected the state of this training: {one_line(error)!r:.200}") from None
        self.model.set_active(self.schedule.active(max(0, self.step - 1)))

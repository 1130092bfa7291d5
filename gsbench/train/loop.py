"""Train a model: gradient steps on batches of views, density control, hooks, and measurements of PSNR on val."""

import math
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import torch
from tqdm import tqdm

from gsbench.train.divergence import DivergedError
from gsbench.train.step import fitting_threads
from gsbench.train.training_parts import TrainingParts


class Trainer(TrainingParts):
    """Train one model on one scene. `step` is the number of finished steps; the state can be saved after each step."""

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

"""Hold the parts of a training (model, optimizer, density control, hooks, clocks) and their state for a checkpoint."""

import sys
from collections import deque
from typing import Any, TypeVar

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
from gsbench.train.divergence import LOOK_EVERY, FiniteCheck
from gsbench.train.hooks import Hook, hook_types
from gsbench.train.optim import Optimizer
from gsbench.train.renderer import Renderer
from gsbench.train.rows import Rows
from gsbench.train.step import Step
from gsbench.train.update import Update

H = TypeVar("H", bound=Hook)


class TrainingParts:
    """The parts of a training, which `gsbench.train.loop.Trainer` calls step by step."""

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

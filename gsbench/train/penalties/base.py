"""Define the base class of penalties, the regularisers of a training."""

from abc import ABC, abstractmethod
from typing import Any, ClassVar

from torch import Tensor

from gsbench.models import GaussianModel, Query


class Penalty(ABC):
    """A term of the loss of every view, made once for a training.

    Threads compute the penalties of different views at the same time, so only `prepare` and `follow` change an object.
    """

    needs: ClassVar[tuple[str, ...]] = ()  # what the model must observe, of "time", "direction"

    def __init__(self, model: GaussianModel, seed: int, frames: int) -> None:
        """Make the penalty of a training.

        Args:
            model: the model, with Gaussians.
            seed: the seed of the run, from which all random numbers are drawn.
            frames: the number of different times of the training views.
        """
        self.model = model
        self.seed = seed
        self.frames = frames

    @abstractmethod
    def __call__(self, query: Query, index: int) -> Tensor:
        """Return the penalty for a view, [].

        Args:
            query: the camera centre and the time of the view.
            index: the number of the view in the batch.
        """

    def prepare(self, step: int, query: Query) -> None:
        """Do what is needed once in a step before its views are rendered; by default nothing.

        Args:
            step: the number of the step, counted from 0.
            query: the camera centre and the time of the first view of the batch.
        """
        return

    def follow(self, rows: Tensor, fresh: Tensor) -> None:
        """Update per-Gaussian state after Gaussians were added, removed or reordered; by default there is none."""
        return

    def state_dict(self) -> dict[str, Any]:
        """Return the state for the checkpoint; by default there is none."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the state from a checkpoint; raises InputError if it belongs to another training."""
        return

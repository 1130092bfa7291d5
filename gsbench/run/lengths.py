"""Train a run at several lengths, each from the start, and keep the training that is best on val (train.lengths).

Long trainings of small scenes overfit. Learning rates fall to the end of a training, so that to stop it early is worth
little: a training that was planned to be short is better (docs/tuning.md).
"""

import sys
from dataclasses import replace
from typing import Any

from gsbench.config import Config
from gsbench.gates import messages
from gsbench.measure.record import LengthChoice
from gsbench.run.auto_model import Resolved
from gsbench.run.candidates import Candidates, Result, best, highest
from gsbench.run.identity import Run
from gsbench.scenes import Scene
from gsbench.scenes.gaussian_ply import TrainedGaussians
from gsbench.train.hooks.choices import Choices, choices_in, lengths_of
from gsbench.train.loop import Trainer


def lengths(config: Config) -> dict[str, Config]:
    """Return the settings of each length, by a name such as "iterations=1000", the shortest first.

    Each length is twice the one before, and the last is `train.iterations`.
    """
    train, count = config.train, lengths_of(config)
    assert count is not None
    alone: dict[str, Any] = {"lengths": None}
    trains = [replace(train, iterations=train.iterations >> k, **alone) for k in reversed(range(count))]
    return {name_of(one.iterations): replace(config, train=one) for one in trains}


def name_of(iterations: int) -> str:
    """Return the name of a length among the candidates of a run."""
    return f"iterations={iterations}"


def best_length(this: Run, scene: Scene, start: TrainedGaussians | None, resolved: Resolved) -> Trainer:
    """Return the trainer of the length with the highest PSNR on val, at its last step.

    The lengths are trained from the shortest on. They end with the first that is not better on val than all before it.
    The result is bit-equal to a run of the chosen length alone. Each length is gated as such a run is, after its PSNR
    on val was measured. The seconds of the time screen and of the other lengths count as training.

    Raises:
        InputError: a checkpoint is damaged.
        DivergedError, NoGaussianError: all lengths failed; the error is that of the shortest.
        Stopped: a signal asked the process to end; the checkpoint of the present length is saved.
    """
    parts = Candidates(this, scene, start, lengths(resolved.config))
    return parts.chosen(_known, lambda: _best(parts, resolved))


def _known(state: dict[str, Any]) -> str | None:
    length = choices_in(state).length
    return None if length is None else name_of(length.kept)


def _best(parts: Candidates, resolved: Resolved) -> Trainer:
    """Train one length after the other, print which is the best, and return its trainer with the costs of all."""
    results: list[Result] = []
    steps = sum(config.train.iterations for config in parts.settings.values())
    for name, config in parts.settings.items():
        results.append(parts.train(name, config.train.iterations, results, steps))
        top = highest(results)
        if top is not results[-1] and top.error is None:
            break
    chosen = best(results)
    choice = LengthChoice(chosen.steps, [one.candidate for one in results])
    print(f"{parts.this.name}: {messages.of_lengths(choice)}", file=sys.stderr)
    trainer = parts.trained(chosen, results, resolved.screen, resolved.effort)
    trainer.hook(Choices).chosen.length = choice
    return trainer

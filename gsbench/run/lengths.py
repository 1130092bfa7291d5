"""Train a run at several lengths, each from the start, and keep the training that is best on val (train.lengths).

Long trainings of small scenes overfit. Learning rates fall to the end of a training, so that to stop it early is worth
little: a training that was planned to be short is better (docs/tuning.md).
"""

import sys
from dataclasses import replace

from gsbench.config import Config
from gsbench.measure.record import LengthChoice
from gsbench.run import fitting
from gsbench.run.candidates import Candidates, Result, add_costs, best
from gsbench.run.identity import Run
from gsbench.run.resolve import Resolved, plain
from gsbench.run.setup import build
from gsbench.scenes import Scene
from gsbench.scenes.trained import TrainedGaussians
from gsbench.train.loop import Trainer


def lengths(config: Config) -> dict[str, Config]:
    """Return the settings of each length, by a name such as "iterations=1000", the shortest first.

    Each length is twice the one before, and the last is `train.iterations`.
    """
    train = config.train
    assert train.lengths is not None
    halvings = reversed(range(train.lengths))
    trains = [replace(train, iterations=train.iterations >> k, lengths=None) for k in halvings]
    return {f"iterations={one.iterations}": replace(config, train=one) for one in trains}


def best_length(this: Run, scene: Scene, start: TrainedGaussians | None, resolved: Resolved) -> Trainer:
    """Return a trainer at its last step, with the Gaussians of the length that has the highest PSNR on val.

    The lengths are trained from the shortest on. They end with the first that is not better on val than all before it.
    The Gaussians are bit-equal to those of a run of the chosen length alone. The seconds of the time screen and of the
    other lengths count as training.

    Args:
        this: the run.
        scene: the scene, which has val views.
        start: trained Gaussians to start from; None to start from points.
        resolved: the settings with the chosen model, and the time screen of model=auto.

    Raises:
        InputError: a checkpoint is damaged.
        DivergedError, NoGaussianError: all lengths failed; the error is that of the shortest.
        Stopped: a signal asked the process to end; the checkpoint of the present length is saved.
    """
    config = resolved.config
    parts = Candidates(this, scene, start, lengths(config))
    trainer = fitting.trainer_of(build(config), scene, config, start)
    state = fitting.saved_state(this, scene)
    if state is not None:
        fitting.resume(trainer, this, state)
    else:
        _take_best(trainer, parts, resolved)
        fitting.save(trainer.state_dict(), this, scene, plain(this, config))
    parts.forget()
    return trainer


def _take_best(trainer: Trainer, parts: Candidates, resolved: Resolved) -> None:
    """Train one length after the other, print which is the best, and load its state with the costs of all."""
    results: list[Result] = []
    steps = sum(config.train.iterations for config in parts.settings.values())
    for name, config in parts.settings.items():
        results.append(parts.train(name, config.train.iterations, results, steps))
        top = max(results, key=lambda one: one.rank)
        if top is not results[-1] and top.error is None:
            break
    chosen = best(results)
    choice = LengthChoice(chosen.steps, [one.found for one in results])
    trainer.load_state_dict(parts.state(chosen.found.name) | {"step": trainer.config.train.iterations})
    trainer.length = choice
    add_costs(trainer, resolved, [one for one in results if one is not chosen])
    print(f"{parts.this.name}: {_said(choice)}", file=sys.stderr)


def _said(choice: LengthChoice) -> str:
    """Return a message: the PSNR on val of each length, and which of them is kept."""
    tried = [f"{one.name} {'-' if one.psnr_val is None else format(one.psnr_val, '.2f')} dB" if one.reason is None
             else f"{one.name} failed" for one in choice.tried]  # fmt: skip
    return f"PSNR on val: {', '.join(tried)}; the training of {choice.kept} iterations is kept"

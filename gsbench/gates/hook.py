"""Simplify Gaussians once after densification and once at the end of a training, if the images hardly change.

A simplified Gaussian is independent of time, direction or AGR (the neural refinement), has a lower SH degree, or is
removed. The first simplification makes the rest of the training faster.
"""

import copy
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import torch
from torch import Tensor

from gsbench.config import Config
from gsbench.errors import InputError
from gsbench.gates.gate import effect_sets_of, gate_within
from gsbench.gates.sensitivity import MOST_VIEWS, probe, share_asleep, visible_times
from gsbench.measure.exact_views import decides
from gsbench.measure.quality import evenly
from gsbench.measure.record import Direction, Gate, OnDemand, TimeScreen
from gsbench.measure.speed import synchroniser, time_in_turns
from gsbench.models import CameraTime, GaussianModel
from gsbench.models.effect_sets import EffectSets
from gsbench.models.gated import as_gated, has_gates
from gsbench.models.simplifications import STATIC, shares_of
from gsbench.reading import parse
from gsbench.scenes import View
from gsbench.train.hooks import Hook, Training
from gsbench.train.hooks.choices import Choices

# Largest loss of PSNR on val, in dB, when Gaussians are simplified in training. Of 0.5, 0.2 and 0.1 these are the
# largest losses from which the rest of the training recovers on every scene tried.
LOSS_IN_TRAINING = 0.1
LOSS_WITH_AGR = 0.5
# A model with fewer Gaussians than this is not simplified in training. With 300 and 600 Gaussians, models of four of
# five scenes lost 0.2 to 0.5 dB on val by that.
LEAST_IN_TRAINING = 1_000
VIEWS_IN_TRAINING = 30  # views from which errors are predicted; more would cost more time than simplification saves
# AGR's learning rate does not decay by itself. With fewer Gaussians the last steps are then too large: on trex a
# training with simplified Gaussians ended 0.4 dB lower.
LAST_RATE = 0.1
HELD_OUT = 8  # every 8th training view is held out to check PSNR, if the scene has no val split
FEW = 12  # with fewer training views than this, none is held out

GaussiansAndEffects = tuple[dict[str, Tensor], EffectSets | None]  # raw parameters, and the effects of each Gaussian


def gaussians_of(model: GaussianModel) -> GaussiansAndEffects:
    """Return the parameters of a model's Gaussians and what each depends on; `become` restores them."""
    return {name: x.data for name, x in model.splats.items()}, model.effect_sets


def become(model: GaussianModel, gaussians: GaussiansAndEffects) -> None:
    """Replace the Gaussians of a model by those that `gaussians_of` returned for it or for another model."""
    for name, value in gaussians[0].items():
        model.splats[name].data = value
    model.effect_sets = gaussians[1]


class Gating(Hook):
    """Simplify Gaussians as `effects.gate` asks, and record what it changed."""

    name = "gates"

    def __init__(self, training: Training) -> None:
        """Choose the views from which the errors of simplified Gaussians are predicted, and the views for PSNR."""
        super().__init__(training)
        self.model, self.config, self.renderer = training.model, training.config, training.renderer
        self.gates: list[Gate] = []
        self.notes: list[str] = []
        self.direction: Direction | None = None
        self.screen: TimeScreen | None = None  # by which model=auto chose the model
        scene = training.scene
        self.probed, self.checked, self.checked_on = scene.train, scene.val, "val"
        if scene.val and self.config.scene.eval_split != "val":  # views of results must not decide
            return
        if len(scene.train) < FEW:
            self.checked, self.checked_on = scene.train, "the training views"
            self.notes.append(
                f"{len(scene.train)} training views and no val split: the gate is checked on the "
                f"training views, which says little"
            )
        else:
            self.checked, self.checked_on = scene.train[::HELD_OUT], "held-out training views"
            self.probed = [view for i, view in enumerate(scene.train) if i % HELD_OUT]

    @classmethod
    def check_model(cls, model: GaussianModel, config: Config) -> None:
        """Raise InputError if Gaussians are to be simplified and the model cannot have this."""
        if config.effects.gate != "off":
            as_gated(model)

    def acts(self, step: int) -> bool:
        return self.config.effects.gate == "both" and self.training.schedule.gates(step)

    def after_density(self, step: int) -> None:
        """Simplify Gaussians once after densification, if `effects.gate=both`, unless the model has few Gaussians."""
        if not self.acts(step):
            return
        with self.training.stages("gate"):
            if len(self.model) < LEAST_IN_TRAINING:
                self.notes.append(
                    f"at step {step + 1} the model has {len(self.model)} Gaussians: of fewer than "
                    f"{LEAST_IN_TRAINING:,} none is simplified in training"
                )
                return
            most = LOSS_WITH_AGR if self.config.agr else LOSS_IN_TRAINING
            self.simplify(step + 1, most, VIEWS_IN_TRAINING)

    def at_end(self) -> None:
        """Simplify Gaussians after the training, unless `effects.gate=off`."""
        if self.config.effects.gate != "off":
            self.finish()

    def finish(self) -> None:
        """Simplify the Gaussians of a finished training, and measure PSNR and frame time before and after.

        The measurement does not count as training time.
        """
        training = self.training
        self.model.set_active(training.schedule.active(training.step - 1))
        before = gaussians_of(self.model)
        with training.effort, training.stages("gate"):
            self.simplify(None, self.config.effects.budget_db, MOST_VIEWS)
        self.compare(before, training.views)

    @torch.no_grad()
    def simplify(self, step: int | None, budget_db: float, most: int) -> None:
        """Simplify Gaussians if the loss of PSNR is allowed; otherwise note why not.

        Args:
            step: the step of the training; None at its end.
            budget_db: the largest allowed loss of PSNR, dB.
            most: the largest number of views from which errors are predicted.
        """
        started = time.perf_counter()
        model = as_gated(self.model)
        # In training AGR changes Gaussians at all times, because the times at which they are visible still change.
        intervals = visible_times(model, self.probed) if step is None else None
        hidden = None if intervals is None else intervals[:, 0].isinf()  # never visible
        sensitivity = probe(
            model,
            self.probed,
            self.renderer.background,
            seed=self.config.seed,
            most=most,
            antialias=self.renderer.antialias,
            hidden=hidden,
        )
        gated = gate_within(model, sensitivity, budget_db, lambda x: self.renderer.psnr(x, self.checked), intervals)
        if gated is None:
            before = self.renderer.psnr(model, self.checked)
            when = "at the end" if step is None else f"at step {step}"
            self.notes.append(
                f"{when} no simplification cost at most {budget_db} dB on {self.checked_on}"
                if decides(before)
                else f"{when} nothing was simplified: a PSNR of {before:.0f} dB on {self.checked_on} cannot show a loss"
            )
            return
        become(self.model, gaussians_of(gated.model))
        self.training.rows.moved(gated.rows, gated.changed)
        seconds = time.perf_counter() - started
        self.gates.append(
            replace(
                gated.gate,
                step=step,
                checked_on=self.checked_on,
                seconds=seconds,
                asleep=share_asleep(self.model, self.probed),
            )
        )

    def rate_factors(self, step: int) -> dict[str, float]:
        """Return the factor of the learning rate of AGR at a step.

        The factor is 1 until Gaussians are simplified in training. Then it falls log-linearly to LAST_RATE at the end.
        """
        if not self.gates or self.gates[0].step is None:
            return {}
        begun, iterations = self.gates[0].step, self.config.train.iterations
        return {"refinement": float(LAST_RATE ** (max(0, step - begun) / max(1, iterations - begun)))}

    def compare(self, ungated: GaussiansAndEffects, views: list[View]) -> None:
        """Measure how PSNR and frame time changed at the end, and how they would change without any direction.

        Args:
            ungated: the Gaussians before the gate at the end.
            views: the views (test or val) on which results are measured.
        """
        if self.gates and self.gates[-1].step is None:
            before = copy.deepcopy(self.model)
            become(before, ungated)
            loss, times = self._compare_models(before, self.model, views)
            self.gates[-1] = replace(self.gates[-1], eval_loss_db=loss, frame_ms_before=times[0], frame_ms=times[1])
        frozen = without_direction(self.model, self.probed)
        if frozen is not None:
            loss, times = self._compare_models(self.model, frozen, views)
            self.direction = Direction(share_with_direction(self.model), loss, *times)

    def _compare_models(
        self, model: GaussianModel, other: GaussianModel, views: list[View]
    ) -> tuple[float, list[float]]:
        """Return by how many dB PSNR is lower with `other` than with `model`, and both median frame times, ms."""
        count = max(self.config.protocol.renders, len(views))
        draw = [lambda i, shown=shown: self.renderer.image(shown, views[i % len(views)]) for shown in (model, other)]
        times = time_in_turns(draw, count, synchroniser(self.config.device))
        psnr = self.renderer.psnr
        return psnr(model, views) - psnr(other, views), [of_model.p50 for of_model in times]

    def state_dict(self) -> dict[str, Any]:
        direction = asdict(self.direction) if self.direction else None
        return {"gates": [asdict(gate) for gate in self.gates], "notes": list(self.notes), "direction": direction}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        gates, notes, direction = state["gates"], state["notes"], state["direction"]
        if not isinstance(gates, list) or not isinstance(notes, list) or not all(isinstance(x, str) for x in notes):
            raise InputError("checkpoint: expected lists of gates and notes")
        self.gates = [parse(Gate, gate, "checkpoint: gate") for gate in gates]
        self.notes = notes
        self.direction = parse(Direction, direction, "checkpoint: direction") if direction is not None else None

    def results(self) -> dict[str, Any]:
        if self.screen is None and self.config.effects.gate == "off":
            return {}
        comparison = self.training.hook(Choices).chosen.comparison
        notes = [] if has_gates(self.model) else [f"gates cannot simplify {self.config.model.name}"]
        return {"on_demand": OnDemand(self.screen, self.gates, self.notes + notes, self.direction, comparison)}


@torch.no_grad()
def without_direction(model: GaussianModel, views: Sequence[View]) -> GaussianModel | None:
    """Return a copy of a model whose means and opacities ignore the view direction; None for a model without direction.

    The comparison with this copy tells what direction is worth. Direction is replaced by its mean over the training
    views. AGR, the dependence on time and the SH coefficients of the colours stay.
    """
    if not has_gates(model) or "direction" not in model.observes:
        return None
    queries = [CameraTime.of(view.camera, view.time) for view in evenly(views, MOST_VIEWS)]
    weights = shares_of([model.slice(query).opacities for query in queries])
    frozen = model.frozen({name: value.detach() for name, value in model.splats.items()}, queries, weights)
    changed = copy.deepcopy(model)
    name = "direction" if "direction" in frozen else STATIC  # some models can only drop all variables at once
    for key, value in frozen[name].items():
        if key != "directions":  # these stay, because they are inputs of AGR
            changed.splats[key].data = value.clone()
    if name == STATIC:  # no Gaussian is refined or conditioned
        changed.effect_sets = effect_sets_of(model)._replace(refined=0, conditioned=0, intervals=None)
    return changed


def share_with_direction(model: GaussianModel) -> float:
    """Return the share of a model's Gaussians whose mean or opacity depends on the view direction."""
    return effect_sets_of(model).conditioned / max(1, len(model))

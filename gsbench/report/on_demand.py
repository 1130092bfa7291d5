"""Average over seeds how many Gaussians keep which effects (time, view direction, the network AGR)."""

import math
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from statistics import fmean

import numpy as np

from gsbench.effects.messages import EFFECT_SETS
from gsbench.measure.record import Gate, Record
from gsbench.report.configurations import Configuration, Group
from gsbench.report.intervals import Estimate, estimate

REMOVED = "removed"
DEGREES = 4  # of spherical harmonics: 0, 1, 2, 3


@dataclass(frozen=True)
class Decided:
    """How many Gaussians of a model keep which effects (time, view direction, the network AGR) on a scene.

    The numbers are means over seeds. The step that removes effects from Gaussians is called a gate.
    """

    scene: str
    configuration: Configuration
    name: str  # a short name of the configuration that no other one has
    runs: list[Record]  # runs that chose effects, in order of the seeds
    gated: int  # number of runs in which a gate removed effects; the numbers below are of these
    rows: dict[str, float]  # number of Gaussians by the effects that they have at the end, and of those removed
    degrees: list[float]  # number of Gaussians by SH degree at the end
    views: str  # the views on which the change of PSNR was measured
    psnr: Estimate  # change of PSNR by the gate after training, dB
    ms: Estimate  # change of the median milliseconds per frame by the gate after training
    ms_before: float
    mb_before: float  # of the model before the first gate
    mb: float
    predicted: float  # change of PSNR that the gate after training predicted, dB
    asleep: float  # share of Gaussians that AGR skips in a frame, as they cannot be seen at its time

    @property
    def before(self) -> float:
        """Return the number of Gaussians before time, direction, AGR (a network) or whole Gaussians were removed."""
        return sum(self.rows.values())

    @property
    def left(self) -> float:
        """Return the number of Gaussians that remain after all removals."""
        return self.before - self.rows.get(REMOVED, 0.0)


def decided(group: Group) -> list[Decided]:
    """Return how many Gaussians keep which effects (time, view direction, the network AGR).

    The list has one entry for each scene and each model with its settings. It is empty if no run removed an effect or
    chose its effects automatically.
    """
    configurations = [c for c in group.configurations if c.on_demand]
    shared = Counter(c.series for c in configurations)
    names = [c.series if shared[c.series] == 1 else c.name for c in configurations]
    return [
        _average(group, scene, configuration, name, runs)
        for scene in group.scenes
        for configuration, name in zip(configurations, names, strict=True)
        if (runs := [r for r in configuration.runs.get(scene, []) if r.on_demand])
    ]


def _average(group: Group, scene: str, configuration: Configuration, name: str, runs: list[Record]) -> Decided:
    gates = [r.on_demand.gates for r in runs if r.on_demand and r.on_demand.gates]
    at_end = [(r, r.on_demand.gates[-1]) for r in runs if r.on_demand and _ends(r.on_demand.gates)]
    evaluated = all(gate.eval_loss_db is not None for _, gate in at_end)
    loss: Callable[[Gate], float | None] = lambda g: g.eval_loss_db if evaluated else g.measured_db  # noqa: E731
    here = [gate for r, gate in at_end if r.provenance.machine == group.machine]
    splits = [str(r.protocol.get("eval_split", "evaluated")) if evaluated else gate.checked_on for r, gate in at_end]
    kinds = [*EFFECT_SETS, REMOVED] if gates else []
    return Decided(
        scene,
        configuration,
        name,
        runs,
        len(gates),
        {kind: fmean(_rows(one, kind) for one in gates) for kind in kinds},
        [fmean(_of_degree(one[-1], degree) for one in gates) for degree in range(DEGREES)] if gates else [],
        next(iter(splits), ""),
        _mean([_less(loss(gate), 0.0) for _, gate in at_end]),
        _mean([_less(gate.frame_ms_before, gate.frame_ms) for gate in here]),
        _mean([math.nan if gate.frame_ms_before is None else gate.frame_ms_before for gate in here]).mean,
        fmean(one[0].bytes_before for one in gates) / 1e6 if gates else math.nan,
        fmean(one[-1].bytes for one in gates) / 1e6 if gates else math.nan,
        fmean(-gate.predicted_db for _, gate in at_end) if at_end else math.nan,
        fmean(gate.asleep or 0.0 for _, gate in at_end) if at_end else math.nan,
    )


def _ends(gates: list[Gate]) -> bool:
    return bool(gates) and gates[-1].step is None


def _rows(gates: list[Gate], name: str) -> int:
    """Count the Gaussians that keep a certain set of effects to the end of a run, such as time without direction.

    For the name "removed", count all Gaussians that were removed.
    """
    of = gates if name == REMOVED else gates[-1:]
    return sum(max(0, gate.rows.get(name, 0)) for gate in of)


def _of_degree(gate: Gate, degree: int) -> int:
    """Count the Gaussians whose colours have SH of the given degree, whether or not the colours change with time."""
    return sum(max(0, n) for name, n in gate.orders.items() if re.match(rf"degree {degree}\b", name))


def _less(before: float | None, after: float | None) -> float:
    """Return the change of a value, `after` minus `before`; NaN if one of the two is missing."""
    return math.nan if before is None or after is None else after - before


def _mean(values: list[float]) -> Estimate:
    """Estimate a mean over seeds with its interval; missing values (NaN) are left out."""
    known = np.array([value for value in values if math.isfinite(value)])
    return estimate([known[:, None]] if len(known) else [], generalise=False)

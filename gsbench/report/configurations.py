"""Group the run records of an experiment by model, variant and scene, and read measured quantities from them.

A configuration is a model with a variant (settings that differ from the experiment, such as another training length).
The runs of a configuration differ only in scene and seed. A configuration is one point in a figure.
"""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from gsbench.measure.record import Record

Values = npt.NDArray[np.float64]


def psnr_val(record: Record) -> float:
    """Return the PSNR in dB on the validation views at the end of a run; NaN if it was not measured.

    If the run was evaluated on the validation views, this is its final PSNR. Otherwise it is the last value of the
    training curve, or that of the iteration whose Gaussians `train.patience` kept. The curve ends before effects (time,
    view direction, the network AGR) are removed from the Gaussians of the finished model, so the PSNR that this removal
    costs is subtracted.
    """
    if record.protocol.get("eval_split") == "val":
        return _number((record.metrics or {}).get("psnr"))
    gates = record.on_demand.gates if record.on_demand else []
    lost = sum(gate.measured_db for gate in gates if gate.step is None and gate.checked_on == "val")
    kept = [p for p in record.curve if record.stop is None or p.iteration == record.stop.kept]
    return _number(kept[-1].psnr_val) - lost if kept else math.nan


QUANTITIES: dict[str, Callable[[Record], float]] = {
    "psnr": lambda r: _number((r.metrics or {}).get("psnr")),  # dB, the evaluated split
    "psnr_val": psnr_val,  # dB
    "seconds": lambda r: r.cost.train_s if r.cost else math.nan,  # of training
    "cpu_s": lambda r: _number(r.cost.train_cpu_s if r.cost else None),  # of all threads in those seconds
    "load": lambda r: _number(r.cost.load if r.cost else None),  # of the machine
    "ms": lambda r: r.cost.render_ms.p50 if r.cost else math.nan,  # median of the milliseconds per frame
    "mb": lambda r: r.cost.bytes / 1e6 if r.cost else math.nan,  # of the model's parameters
}
BUSY = 0.5  # load by other work from which a run counts as measured beside it
GATES = ("off", "end", "both")  # values of the setting effects.gate: when effects are removed from Gaussians
OF_THE_MACHINE = ("seconds", "cpu_s", "ms")  # quantities that can be compared only between runs on one machine


@dataclass(frozen=True)
class Configuration:
    """The finished runs of one model with the same settings, on all scenes and with all seeds."""

    model: str
    variant: str  # settings that differ from the experiment's own; empty if none does
    runs: dict[str, list[Record]]  # by scene, in order of the seeds
    name: str  # the model, and its variant if the runs of the group have several
    series: str  # the name of its curve in figures: `Group.series_of`

    @property
    def on_demand(self) -> bool:
        """Tell whether a run chose the effects of its Gaussians automatically, so that some Gaussians may lack effects.

        The effects are time, view direction and the network AGR.
        """
        return any(r.on_demand for runs in self.runs.values() for r in runs)

    @property
    def iterations(self) -> int | None:
        """Return the number of training iterations, or None if the runs differ in it."""
        lengths = {iterations(r) for runs in self.runs.values() for r in runs}
        return lengths.pop() if len(lengths) == 1 else None


@dataclass(frozen=True)
class Group:
    """The run records of one experiment on one data set."""

    records: list[Record]  # sorted by scene, model, variant, seed

    @property
    def experiment(self) -> str:
        """Return the name of the experiment."""
        return self.records[0].experiment

    @property
    def dataset(self) -> str:
        """Return the name of the data set."""
        return self.records[0].dataset

    @cached_property
    def finished(self) -> list[Record]:
        """Return the records of the runs that finished without error."""
        return [r for r in self.records if r.status == "ok"]

    @cached_property
    def scenes(self) -> list[str]:
        """Return the scene names of all runs, failed runs included."""
        return sorted({r.scene for r in self.records})

    @cached_property
    def models(self) -> list[str]:
        """Return the model names of all runs, failed runs included."""
        return sorted({r.model for r in self.records})

    @cached_property
    def configurations(self) -> list[Configuration]:
        """List the configurations (a model with its settings) that finished on at least one scene, sorted by name.

        A model with the experiment's own settings comes before its variants.
        """
        runs: dict[tuple[str, str], dict[str, list[Record]]] = {}
        for r in self.finished:
            runs.setdefault((r.model, r.variant), {}).setdefault(r.scene, []).append(r)
        several = len({variant for _, variant in runs}) > 1
        names = {(m, v): f"{m}, {v}" if v and several else m for m, v in runs}
        series = {(r.model, r.variant): self.series_of(r) for r in self.finished}
        return [Configuration(m, v, scenes, names[m, v], series[m, v]) for (m, v), scenes in sorted(runs.items())]

    @cached_property
    def series(self) -> list[str]:
        """Return the names of the report's curves.

        Each model has one curve. If effects (time, view direction, the network AGR) were removed from Gaussians in some
        of its runs, these runs have a second curve.
        """
        return sorted({self.series_of(r) for r in self.records})

    def series_of(self, record: Record) -> str:
        """Return the name of the report's curve that a run belongs to.

        All runs of a model share one curve, with one exception: the setting `effects.gate`. It says when effects (time,
        view direction, the network AGR) are removed from Gaussians that do not need them. Runs with a value of
        `effects.gate` that is not the model's default have their own curve, unless all runs of the group have the same
        value.
        """
        own = gating(record)
        return f"{record.model}, {own}" if own and len(self._gatings) > 1 else record.model

    @cached_property
    def _gatings(self) -> set[str]:
        return {gating(r) for r in self.records}

    @cached_property
    def variant(self) -> str:
        """Return the settings with which models are compared: those that most models have.

        Settings without an ablation (a change of one part of a model) are preferred.
        """
        shared = Counter(c.variant for c in self.configurations)
        return min(shared, key=lambda variant: (-shared[variant], is_ablated(variant), variant), default="")

    @cached_property
    def main_configurations(self) -> list[Configuration]:
        """Return each model with the settings that most models share (one configuration for each model)."""
        return [c for c in self.configurations if c.variant == self.variant]

    @cached_property
    def compared(self) -> list[Configuration]:
        """Return the configurations (a model with its settings) that the report compares in pairs.

        Their settings are those that most models share. Only ablations and the removal of time, direction and AGR (a
        network) from Gaussians may differ.
        """
        return [c for c in self.configurations if _common(c.variant) == _common(self.variant)]

    def label(self, configuration: Configuration) -> str:
        """Return a name for a compared model, and its settings in brackets if they are not the common ones."""
        model, variant = configuration.model, configuration.variant
        return model if variant == self.variant else f"{model} ({variant or 'default'})"

    @cached_property
    def covered(self) -> list[str]:
        """Return the scenes over which averages are taken.

        Every model has finished these scenes with the settings that most runs share.
        """
        main = self.main_configurations
        return [s for s in self.scenes if main and all(s in c.runs for c in main)]

    @cached_property
    def basis(self) -> list[str]:
        """Return the scenes over which the report averages its conclusions.

        These are the scenes that every model finished. If there is no such scene, the report uses the one scene that
        most models and settings finished.
        """
        if self.covered or not self.configurations:
            return self.covered
        return [max(self.scenes, key=lambda s: sum(s in c.runs for c in self.configurations))]

    @cached_property
    def machine(self) -> str:
        """Return the machine on which most runs were made; times from other machines are left out."""
        return Counter(r.provenance.machine for r in self.finished or self.records).most_common(1)[0][0]

    @cached_property
    def elsewhere(self) -> int:
        """Return the number of finished runs that were not made on the machine of most runs."""
        return sum(r.provenance.machine != self.machine for r in self.finished)

    def value(self, record: Record, quantity: str) -> float:
        """Read a quantity, such as PSNR, from a run's record; NaN if it is missing.

        A time is also NaN if it was not measured on the machine that most runs used.
        """
        if quantity in OF_THE_MACHINE and record.provenance.machine != self.machine:
            return math.nan
        return QUANTITIES[quantity](record)

    def sample(self, configuration: Configuration, scene: str, quantity: str) -> Values:
        """Return the values of a quantity for a model with its settings on a scene, one for each seed that has it."""
        values = np.array([self.value(r, quantity) for r in configuration.runs.get(scene, [])])
        return values[np.isfinite(values)]

    def contrast(self, weights: list[tuple[float, Configuration]], quantity: str) -> list[Values]:
        """Return a weighted sum of models' results as one array [seeds, views] for each scene.

        For example, the weights 1 and -1 give the difference of two models. The results are paired: only those scenes,
        seeds and views are used that all models in the sum have. PSNR has one column for each view. Other quantities,
        and PSNR from records without values for each view, have one column.
        """
        scenes = [s for s in self.scenes if all(s in c.runs for _, c in weights)]
        return [paired for s in scenes if (paired := self._paired(weights, s, quantity)).size]

    def _paired(self, weights: list[tuple[float, Configuration]], scene: str, quantity: str) -> Values:
        """Return the weighted sum of models' results on one scene, [seeds, views].

        The array is empty if the models share no seed or no view.
        """
        by_seed = [{r.seed: s for r in c.runs[scene] if (s := self.scores(r, quantity))} for _, c in weights]
        seeds = sorted(set.intersection(*map(set, by_seed)))
        every = [scores[seed] for scores in by_seed for seed in seeds]
        views = sorted(set.intersection(*map(set, every))) if every else []
        total = np.zeros((len(seeds), len(views)))
        for (weight, _), scores in zip(weights, by_seed, strict=True):
            total += weight * np.array([[scores[seed][view] for view in views] for seed in seeds])
        return total

    def scores(self, record: Record, quantity: str) -> dict[str, float]:
        """Return a quantity of a run for each view, or a single value if the quantity is not measured for each view.

        A run without the quantity has no value; nor has one whose PSNR is not a number in some views, because it would
        be compared without the views in which it failed.
        """
        value = self.value(record, quantity)
        if quantity == "psnr" and record.per_view and math.isfinite(value):
            return {v.name: v.psnr for v in record.per_view if v.psnr is not None}
        return {"": value} if math.isfinite(value) else {}


def groups(records: list[Record]) -> list[Group]:
    """Group run records by experiment and data set, and sort the groups by name."""
    found: dict[tuple[str, str], list[Record]] = {}
    for r in sorted(records, key=lambda r: (r.experiment, r.dataset, r.scene, r.model, r.variant, r.seed)):
        found.setdefault((r.experiment, r.dataset), []).append(r)
    return [Group(runs) for runs in found.values()]


def gating(record: Record) -> str:
    """Return the setting `effects.gate` of a run as text, such as "gate=end"; "" if it is the model's default.

    The setting says when effects (time, view direction, the network AGR) are removed from Gaussians that do not need
    them.
    """
    config = record.provenance.config
    effects, model = (part if isinstance(part := config.get(name), dict) else {} for name in ("effects", "model"))
    gate = effects.get("gate", "off")
    return f"gate={gate}" if gate in GATES and gate != model.get("gate", "off") else ""


def is_beside_others(record: Record) -> bool:
    """Tell whether the machine had other work while a run was trained, so that a quiet machine may be faster.

    The load of the run itself is subtracted: its CPU-seconds per second, or its threads if these are not recorded.
    """
    cost = record.cost
    if cost is None or cost.load is None:
        return False
    known = cost.train_cpu_s is not None and cost.train_s > 0
    return cost.load - ((cost.train_cpu_s or 0.0) / cost.train_s if known else record.provenance.threads) > BUSY


def is_ablated(variant: str) -> bool:
    """Tell whether a variant (a text of settings) changes one part of a model, through a file in conf/ablation."""
    return any(word.startswith("ablation=") and word != "ablation=none" for word in variant.split(","))


def without(variant: str, *names: str) -> str:
    """Return a variant (a text such as "train.iterations=500,model.x=1") without some of its settings.

    Args:
        variant: settings with their values, separated by commas.
        names: the settings to leave out, each named by the last part of its key, such as "iterations".
    """
    return ",".join(word for word in variant.split(",") if word.partition("=")[0].rpartition(".")[2] not in names)


def _common(variant: str) -> str:
    """Return a variant (a text of settings) without the settings for ablations and `effects.gate`."""
    return without(variant, "gate", "budget_db", "ablation")


def iterations(record: Record) -> int | None:
    """Return the iterations of the training that a record is of, or None if the record does not hold them.

    With `train.lengths`, they are those of the length that was kept.
    """
    if record.length_choice is not None:
        return record.length_choice.kept
    train = record.provenance.config.get("train")
    value = train.get("iterations") if isinstance(train, dict) else None
    return value if isinstance(value, int) else None


def _number(value: float | None) -> float:
    return math.nan if value is None else value

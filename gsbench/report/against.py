"""Compare the runs in two folders of records, and judge for each quantity whether the folders agree.

For example, this compares the results of this machine with published results. Runs are compared if their model, scene,
data, training settings and evaluation settings are equal. Equal code with equal seeds gives equal bits. If all runs of
a model on a scene whose seed both folders have are bit-equal, quality and size agree, and no statistics are needed.

Other code or another device rounds floating-point numbers differently, and different rounding changes the result of a
training as much as another seed does. Therefore the other runs of one model on one scene form two samples, one for each
folder. Student's t compares the two means, and Holm's method adjusts the p-values for all models and scenes.

A few seeds do not give a reliable variance. Therefore the variance of the compared runs is averaged with the variance
pooled over the models and scenes of an experiment, which counts as `POOLED_RUNS` runs (a moderated t: Smyth 2004). With
it, even one run in one folder can be compared with three runs in the other: the interval of the difference is then the
prediction interval, in which one more run of the other folder would lie.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from statistics import fmean, variance

from gsbench.config_roles import listed, training_differences
from gsbench.errors import printable
from gsbench.measure.record import Record
from gsbench.report.configurations import OF_THE_MACHINE, QUANTITIES
from gsbench.report.intervals import LEVEL, Estimate, Spread, holm

AGREES, DIFFERS, UNTOLD = "agrees", "differs", "cannot be told"
# Settings of a run's evaluation.
MEASURING = ("eval_split", "quantise", "resolution", "background", "downscale", "resize")
OF_THE_BITS = ("psnr", "gaussians", "mb")  # quantities that are equal if the trained Gaussians are bit-equal
POOLED_RUNS = 4  # degrees of freedom of the pooled variance, beside those of the row's own
SAME_LOAD = 0.5  # if the mean loads of two machines differ more, times are not compared


@dataclass(frozen=True)
class Limit:
    """Two limits for the comparison of two means: `equal` and `widest`.

    Means whose difference is at most `equal` count as equal. A larger difference that is not significant also counts as
    equal, but only if the 95 % interval of the difference is no wider than ± `widest`. If one folder has a single run,
    its difference must be at most `widest` instead. If `relative` is true, both limits are fractions of the mean in the
    second folder.
    """

    equal: float
    widest: float
    relative: bool = True


LIMITS = {  # by quantity; most are those of gsbench.report.configurations
    "psnr": Limit(0.01, 1.0, relative=False),  # dB
    "seconds": Limit(0.25, 0.5),
    "ms": Limit(0.25, 0.5),
    "gaussians": Limit(0.1, 0.25),
    "mb": Limit(0.1, 0.25),
}
RULE = (
    "Rule: runs of a model on a scene are compared where training, data and measuring are equal; seconds and ms only "
    "of one machine with one load (within 0.5). PSNR, Gaussians and MB agree where every run is bit-equal with the "
    "other folder's run of its seed. A row also agrees where the means are within 0.01 dB, 25 % of seconds or ms, 10 % "
    "of Gaussians or MB. Otherwise it differs where p < 0.05 after Holm over all rows. Otherwise it agrees where the "
    "95 % interval over seeds is no wider than ± 1 dB, 50 %, 25 %, or, if a folder has a single run, where the means "
    "are as near; else it cannot be told. The spread over seeds is the row's own, averaged with that of all rows, "
    "which counts as four runs. The verdict of the whole is that of PSNR: it differs where one row does, and agrees "
    "where all rows do."
)

NONE = Estimate(math.nan, 0, 0, "")
EQUAL = Estimate(0.0, 1, 1, "")  # the difference of bit-equal runs


@dataclass(frozen=True)
class Judged:
    """One quantity (such as PSNR) of a model on a scene in two folders: the values, their difference and a verdict."""

    ours: list[float]  # by run
    theirs: list[float]
    reason: str = ""  # why there is no verdict
    verdict: str = UNTOLD
    difference: Estimate = NONE
    p_holm: float = math.nan
    is_bit_equal: bool = False  # whether all runs whose seed both folders have are bit-equal


@dataclass(frozen=True)
class ComparedRuns:
    """The runs of one model variant on one scene in two folders, with the verdict on each quantity."""

    experiment: str
    dataset: str
    scene: str
    model: str
    ours: dict[int, Record]  # by seed
    theirs: dict[int, Record]
    reason: str = ""  # why the runs cannot be compared at all
    judged: dict[str, Judged] = field(default_factory=dict)  # by quantity

    @property
    def shared(self) -> list[int]:
        """Return the seeds of the runs that finished in both folders and can be compared."""
        seeds = [] if self.reason else sorted(self.ours.keys() & self.theirs.keys())
        return [seed for seed in seeds if self.ours[seed].status == self.theirs[seed].status == "ok"]

    @property
    def bit_equal(self) -> list[int]:
        """Return those of the `shared` seeds whose two runs are bit-equal."""
        return [seed for seed in self.shared if is_bit_equal(self.ours[seed], self.theirs[seed])]


@dataclass(frozen=True)
class Comparison:
    """The comparison of the runs in two folders; it also lists the models and scenes that only one folder has."""

    ours: str  # the folder
    theirs: str
    rows: list[ComparedRuns]
    only_ours: list[str]  # models on scenes that the other folder lacks
    only_theirs: list[str]
    otherwise: dict[str, list[str]]  # those of `only_ours` that the other folder trained otherwise, by the difference

    def of(self, quantity: str, verdict: str) -> list[ComparedRuns]:
        """List the compared models and scenes for which a quantity has the given verdict."""
        return [row for row in self.rows if row.judged[quantity].verdict == verdict]

    @property
    def verdict(self) -> str:
        """Return the overall verdict of the comparison, which depends on PSNR only.

        The folders differ if PSNR differs for at least one model on one scene. They agree if PSNR agrees for all models
        and scenes.
        """
        if self.of("psnr", DIFFERS):
            return DIFFERS
        return AGREES if self.rows and len(self.of("psnr", AGREES)) == len(self.rows) else UNTOLD

    @property
    def largest(self) -> ComparedRuns | None:
        """Return the model and scene with the largest difference in PSNR; None if no difference is known."""
        known = [row for row in self.rows if not math.isnan(row.judged["psnr"].difference.mean)]
        return max(known, key=lambda row: abs(row.judged["psnr"].difference.mean), default=None)


def compare(ours: Sequence[Record], theirs: Sequence[Record], names: tuple[str, str]) -> Comparison:
    """Compare the runs of two folders for each model and scene that both folders have.

    Args:
        ours: run records of the first folder.
        theirs: run records of the second folder.
        names: the names of the two folders, for messages.
    """
    here, there = _by_configuration(ours), _by_configuration(theirs)
    rows = [_row(here[key], there[key]) for key in sorted(here.keys() & there.keys())]
    for quantity, limit in LIMITS.items():
        experiments: dict[tuple[str, str], list[ComparedRuns]] = {}
        for row in rows:
            if not row.judged[quantity].reason:
                experiments.setdefault((row.experiment, row.dataset), []).append(row)
        for of_one in experiments.values():
            for row, found in zip(of_one, differences([r.judged[quantity] for r in of_one], limit), strict=True):
                row.judged[quantity] = replace(row.judged[quantity], difference=found)
        adjusted = holm([row.judged[quantity].difference.p for row in rows])
        for row, p in zip(rows, adjusted, strict=True):
            row.judged[quantity] = _judge(row.judged[quantity], limit, p)
    return Comparison(*names, rows, _missing(here, there), _missing(there, here), _otherwise(here, there))


RunsByConfiguration = dict[tuple[str, str, str, str, str], dict[int, Record]]


def _by_configuration(records: Sequence[Record]) -> RunsByConfiguration:
    found: RunsByConfiguration = {}
    for r in records:
        found.setdefault((r.experiment, r.dataset, r.scene, r.model, r.variant), {})[r.seed] = r
    return found


def _missing(of: RunsByConfiguration, other: RunsByConfiguration) -> list[str]:
    """List the models and scenes that only the first folder has."""
    return [_name(key) for key in sorted(of.keys() - other)]


def _otherwise(ours: RunsByConfiguration, theirs: RunsByConfiguration) -> dict[str, list[str]]:
    """List the models on scenes that the second folder has with other settings, by the smallest difference in these."""
    found: dict[str, list[str]] = {}
    for key in sorted(ours.keys() - theirs.keys()):
        first = next(iter(ours[key].values()))
        others = [next(iter(runs.values())) for other, runs in theirs.items() if other[:4] == key[:4]]
        if others:
            smallest = min((_differing(other, first) for other in others), key=len)
            found.setdefault(printable(listed(smallest)) or "another variant", []).append(_name(key))
    return found


def _name(key: tuple[str, str, str, str, str]) -> str:
    _, _, scene, model, variant = key
    return f"{model} {variant}".rstrip() + f" on {scene}"


def _row(ours: dict[int, Record], theirs: dict[int, Record]) -> ComparedRuns:
    """Collect the values of a model on a scene from both folders, and why some of these values are not comparable."""
    first = next(iter(ours.values()))
    label = f"{first.model} {first.variant}".rstrip()
    mine, other = ([r for r in runs.values() if r.status == "ok"] for runs in (ours, theirs))
    row = ComparedRuns(first.experiment, first.dataset, first.scene, label, ours, theirs, _incomparable(mine, other))
    repeats = bool(row.shared) and row.bit_equal == row.shared
    for quantity in LIMITS:
        known = [[v for r in runs if not math.isnan(v := value(r, quantity))] for runs in (mine, other)]
        reason = row.reason or (_other_machine(mine, other) if quantity in OF_THE_MACHINE else "")
        if not reason and not all(known):
            reason = f"{'here' if not known[0] else 'there'} it was not measured"
        equal = repeats and not reason and quantity in OF_THE_BITS
        row.judged[quantity] = Judged(known[0], known[1], reason, is_bit_equal=equal)
    return row


def is_bit_equal(one: Record, other: Record) -> bool:
    """Tell whether two runs have the same PSNR of every view, to the last bit, and as many Gaussians and bytes.

    A record does not hold the Gaussians. A training that differs in one bit ends with another PSNR of every view.
    """
    return _bits(one) == _bits(other)


def _bits(record: Record) -> tuple[object, ...]:
    views = [(view.name, view.psnr) for view in record.per_view]
    return views, *(value(record, quantity) for quantity in OF_THE_BITS)


def value(record: Record, quantity: str) -> float:
    """Read a quantity, such as PSNR or training seconds, from the record of a run; NaN if it is missing."""
    if quantity == "gaussians":
        return record.cost.num_gaussians if record.cost else math.nan
    return QUANTITIES[quantity](record)


def differences(rows: list[Judged], limit: Limit) -> list[Estimate]:
    """Estimate the difference between the two folders' means for each model and scene, with an interval.

    The variance over seeds is the mean of that of the model on the scene and of that pooled over all given models and
    scenes, weighted by degrees of freedom; the pooled one has at most `POOLED_RUNS`, as models and scenes differ in
    spread. Bit-equal runs count once, and their difference is zero.
    """
    units = [abs(fmean(row.theirs)) if limit.relative else 1.0 for row in rows]
    samples = [[[v / (unit or 1.0) for v in runs] for runs in (row.ours, row.theirs)]
               for row, unit in zip(rows, units, strict=True)]  # fmt: skip
    own = [_squares(*(of_row[1:] if row.is_bit_equal else of_row)) for row, of_row in zip(rows, samples, strict=True)]
    freedom = sum(free for _, free in own)
    pooled = sum(squares for squares, _ in own) / freedom if freedom else math.nan
    shared = min(freedom, POOLED_RUNS)
    found = []
    for row, (ours, theirs), (squares, free), unit in zip(rows, samples, own, units, strict=True):
        if row.is_bit_equal:
            found.append(EQUAL)
            continue
        mean, count = (fmean(ours) - fmean(theirs)) * unit, min(len(ours), len(theirs))
        if not freedom:
            found.append(Estimate(mean, 1, count, ""))
            continue
        moderated = (shared * pooled + squares) / (shared + free)
        spread = Spread(moderated * unit**2 * (1 / len(ours) + 1 / len(theirs)), shared + free)
        found.append(Estimate(mean, 1, count, "seeds", (spread,)))
    return found


def _squares(*samples: list[float]) -> tuple[float, int]:
    """Return the sum of squared deviations of the samples from their means, and its degrees of freedom."""
    squares = sum(variance(sample) * (len(sample) - 1) for sample in samples if len(sample) > 1)
    return squares, sum(len(sample) - 1 for sample in samples)


def _incomparable(ours: list[Record], theirs: list[Record]) -> str:
    """Return the reason why two sets of runs cannot be compared at all, or an empty string if they can."""
    if not ours or not theirs:
        return f"no run finished {'here' if not ours else 'there'}"
    first = theirs[0]
    for r in (*ours, *theirs):
        if differing := _differing(first, r):
            return f"another training: {printable(listed(differing))}"
        if r.provenance.data_hash != first.provenance.data_hash:
            return "other data"
        for name in MEASURING:
            if r.protocol.get(name) != first.protocol.get(name):
                return f"measured otherwise: {name} {printable(first.protocol.get(name))} there, " + printable(
                    r.protocol.get(name)
                )
    return ""


def _differing(theirs: Record, ours: Record) -> list[str]:
    """Describe the settings of two trainings that differ, except the seed."""
    there, here = ({**one.provenance.config, "seed": None} for one in (theirs, ours))
    return training_differences(there, here)


def _other_machine(ours: list[Record], theirs: list[Record]) -> str:
    """Return the reason why the times of two sets of runs cannot be compared, or an empty string if they can.

    Times are comparable if all were measured on one machine under about the same load.
    """
    here, there = ({r.provenance.machine for r in runs} for runs in (ours, theirs))
    if here != there or len(here) > 1:
        named = [printable("; ".join(sorted(machines)))[:200] for machines in (here, there)]
        return f"other machines: {named[0]} here, {named[1]} there"
    loads = [[r.cost.load for r in runs if r.cost and r.cost.load is not None] for runs in (ours, theirs)]
    if not all(loads):
        return "the load of the machine is not known"
    means = [fmean(known) for known in loads]
    if abs(means[0] - means[1]) > SAME_LOAD:
        return f"the machine had other work: load {means[0]:.1f} here, {means[1]:.1f} there"
    return ""


def _judge(found: Judged, limit: Limit, p: float) -> Judged:
    """Decide whether two means agree, differ, or allow no decision, by the criteria in the constant RULE."""
    if found.reason:
        return found
    unit = abs(fmean(found.theirs)) if limit.relative else 1.0
    difference = found.difference
    if found.is_bit_equal or abs(difference.mean) <= limit.equal * unit:
        return replace(found, verdict=AGREES, p_holm=p)
    if not difference.over:
        return replace(found, reason="one run of each model on both sides: no spread over seeds is known")
    if p < 1 - LEVEL:
        return replace(found, verdict=DIFFERS, p_holm=p)
    is_single = min(len(found.ours), len(found.theirs)) == 1
    if (abs(difference.mean) if is_single else difference.half) > limit.widest * unit:
        return replace(found, reason="the interval is too wide: more seeds are needed", p_holm=p)
    return replace(found, verdict=AGREES, p_holm=p)

"""Write the blocks of docs/results.md about the suite: each scene, effects by kind of scene, what foretells them."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from operator import itemgetter
from pathlib import Path
from statistics import fmean

from published import (
    CASES,
    MODELS,
    NAMES,
    Experiment,
    best,
    cost,
    experiments,
    machine,
    metric,
    number,
    signed,
    table,
)
from scipy import stats

from gsbench.measure.record import Record, model_folder
from gsbench.report.configurations import QUANTITIES, Values
from gsbench.report.intervals import estimate
from gsbench.report.messages import count

MOVING = ("monocular", "rig", "array")
EFFECTS = {
    "time, given direction": ("7dgs_noagr", "6dgs"),
    "direction": ("6dgs", "3dgs"),
    "direction, given time": ("7dgs_noagr", "7dgs_nodir"),
    "AGR, given time and direction": ("7dgs", "7dgs_noagr"),
    "7DGS instead of 4DGS": ("7dgs", "4dgs"),
    "`model=auto` instead of 7DGS": ("auto", "7dgs"),
}
LENGTHS = {name: CASES[name] for name in ("500", "1,000", "2,000")}  # variants of runs, by iterations
Choice = Callable[[dict[str, Record]], Record]
COMPARED = "auto,compare=true"  # model=auto that compares its candidates on val
WHOLE = [model for model in MODELS if model != "auto"]  # models whose effects are chosen by the user


def scenes(published: Path) -> str:
    """Return the table of PSNR of every model on every scene of the suite."""
    rows, seeds = [], set()
    for found in experiments(published / "suite"):
        for scene in found.group.scenes:
            psnr = _psnr(found, scene, MODELS)
            seeds |= {len(values) for values in psnr.values()}
            shown = _means(psnr)
            rows.append([scene, found.group.dataset, *(shown.get(model, "–") for model in MODELS)])
    assert len(seeds) == 1, f"expected the same number of seeds for all, got {seeds}"
    said = (
        f"Each number is the mean of {min(seeds)} seeds; bold: the highest of a row; –: the model does not train there."
    )
    return f"{table(['scene', 'kind', *MODELS], rows, left=2)}\n\n{said}"


def kinds(published: Path, shown: Iterable[str] = EFFECTS) -> str:
    """Return the table of what each effect changes in PSNR, by kind of scene, and what its cells say.

    Args:
        published: the folder of reference records.
        shown: the names of the rows, keys of EFFECTS.
    """
    suite = {found.group.dataset: found for found in experiments(published / "suite")}
    columns = {
        "monocular": ["monocular"],
        "fixed cameras": ["rig", "array"],
        "all dynamic": list(MOVING),
        "static": ["static"],
    }
    rows = [
        [
            f"{name}: {' - '.join(f'`{model}`' for model in EFFECTS[name])}",
            *(_price(chain(*(suite[kind].contrast(*EFFECTS[name]).values() for kind in each)))
              for each in columns.values()),
        ]
        for name in shown
    ]  # fmt: skip
    said = (
        "A cell has the mean difference in PSNR of the two models in dB ± half the width of its 95 % interval over "
        "scenes, and on how many scenes PSNR rises. *X, given Y*: both models have Y, and the first has X too. Scenes "
        "on which one of the two models does not train are left out, so counts differ. Bold: the interval excludes "
        "zero (no correction for many cells)."
    )
    return f"{table(['effect', *columns], rows)}\n\n{said}"


def lengths(published: Path) -> str:
    """Return the tables of what models reach and what effects change after three lengths, over the dynamic scenes."""
    moving = [found for found in experiments(published / "suite") if found.group.dataset in MOVING]
    shared = {
        scene: found
        for found in moving
        for scene in found.group.scenes
        if all(scene in found.configuration(model, variant).runs for model in MODELS for variant in LENGTHS.values())
    }
    reached, prices = [], [[name] for name in EFFECTS]
    for name, variant in LENGTHS.items():
        of = {m: [found.configuration(m, variant).runs[scene] for scene, found in shared.items()] for m in MODELS}
        psnr = [fmean(metric(runs, "psnr") for runs in by_scene) for by_scene in of.values()]
        seconds = [fmean(cost(runs, "train_s") for runs in by_scene) for by_scene in of.values()]
        shown = best(psnr, [f"{value:.2f}" for value in psnr])
        reached.append([name, *(f"{dB}, {number(s, 1)}" for dB, s in zip(shown, seconds, strict=True))])
        for line, (model, other) in zip(prices, EFFECTS.values(), strict=True):
            line.append(_price(
                values
                for found in moving
                for scene, values in found.contrast(model, other, variant).items()
                if scene in shared
            ))  # fmt: skip
    text = table(["iterations", *MODELS], reached, left=0)
    said = f"Means over the {count(len(shared), 'dynamic scene')} on which all models train, on {machine(moving[0])}."
    return f"{text}\n\n{said}\n\n{table(['effect', *(f'{name} iterations' for name in LENGTHS)], prices)}"


def _price(by_scene: Iterable[Values]) -> str:
    """Format differences in PSNR of two models: their mean over scenes, and on how many scenes the first is higher."""
    of = estimate(list(by_scene))
    mean = f"**{signed(of.mean)}**" if of.half_over_scenes < abs(of.mean) else signed(of.mean)
    return f"{mean} ± {number(of.half_over_scenes)}, {of.gaining} of {of.scenes}"


def _psnr(found: Experiment, scene: str, models: Sequence[str], variant: str = "") -> dict[str, Values]:
    """Return PSNR of the runs of each model that trains on a scene, dB."""
    psnr = {model: found.group.sample(found.configuration(model, variant), scene, "psnr") for model in models}
    return {model: values for model, values in psnr.items() if len(values)}


def _means(psnr: dict[str, Values]) -> dict[str, str]:
    """Format the mean PSNR of each model over its runs, with the highest one bold."""
    means = [float(values.mean()) for values in psnr.values()]
    return dict(zip(psnr, best(means, [f"{mean:.2f}" for mean in means]), strict=True))


@dataclass(frozen=True)
class Forecast:
    """Something known before or early in a training that might tell what an effect is worth on a scene."""

    name: str
    effect: str  # of EFFECTS
    value: Callable[[Experiment, str], float]  # of a scene; NaN: not known


def forecasts(published: Path) -> str:
    """Return the table of rank correlations between early statistics and prices of effects, over the dynamic scenes."""
    suite = [found for found in experiments(published / "suite") if found.group.dataset in MOVING]
    asked = [
        Forecast("the time screen's z", "AGR, given time and direction", _of_auto(_z)),
        Forecast("the time screen's z", "direction, given time", _of_auto(_z)),
        Forecast("loss without direction at the end of `auto`", "direction, given time", _of_auto(_probe)),
        Forecast("share of Gaussians that `auto` refines", "AGR, given time and direction", _of_auto(_refined)),
        *(Forecast("the same effect on val after 30 % of the iterations", effect, _early(effect))
          for effect in ("direction, given time", "AGR, given time and direction")),
    ]  # fmt: skip
    rows, unsure = [], 0
    for one in asked:
        pairs = [
            (one.value(found, scene), float(values.mean()))
            for found in suite
            for scene, values in found.contrast(*EFFECTS[one.effect]).items()
        ]
        known = [pair for pair in pairs if not math.isnan(pair[0])]
        rank = float(stats.spearmanr(*zip(*known, strict=True)).statistic)
        low, high = _interval(rank, len(known))
        unsure += low <= 0 <= high
        rows.append(
            [one.name, one.effect, f"{signed(rank)} ({signed(low)} to {signed(high)})", count(len(known), "scene")]
        )
    text = table(["known early", "effect", "rank correlation", "over"], rows, left=2)
    said = f"{unsure} of {len(rows)} intervals contain zero."
    if unsure == len(rows):
        said += " No prediction is shown to work."
    return f"{text}\n\n{said}"


def choices(published: Path) -> str:
    """Return the table of what choices of a model lose in PSNR to the best model of each scene that moves."""
    rows = [
        [name, signed(fmean(lost)), signed(min(lost)), f"{sum(loss >= -0.1 for loss in lost)} of {len(lost)}"]
        for name, lost in ((name, [*losses(published, choose).values()]) for name, choose in RULES.items())
    ]
    said = [f"{scene} {why}" for scene, _, why in _moving(published) if why]
    text = table(["choice", "mean, dB", "worst scene, dB", "at most 0.1 dB below on"], rows)
    return f"{text}\n\nLeft out: {'; '.join(said)}." if said else text


def losses(published: Path, choose: Choice) -> dict[str, float]:
    """Return what a choice of a model loses in PSNR to the best model, dB, by scene that moves and has val and test."""
    psnr = QUANTITIES["psnr"]
    return {
        scene: fmean(psnr(choose(runs)) - max(map(psnr, _whole(runs).values())) for runs in by_seed)
        for scene, by_seed, why in _moving(published)
        if not why
    }


def _moving(published: Path) -> Iterator[tuple[str, list[dict[str, Record]], str]]:
    """Yield each scene that moves, its runs by seed and model, and why no model can be chosen on its val, or ""."""
    for found in (found for found in experiments(published / "suite") if found.group.dataset in MOVING):
        for scene in found.group.scenes:
            by_seed = _by_seed(found, scene)
            every = [run for runs in by_seed for run in runs.values()]
            if any(math.isnan(val_after(run, 1)) for run in every):
                yield scene, by_seed, "has no val"
            else:
                on_val = any(run.protocol["eval_split"] == "val" for run in every)
                yield scene, by_seed, "is measured on val" if on_val else ""


def _whole(runs: dict[str, Record]) -> dict[str, Record]:
    """Return the runs whose effects are chosen by the user, which are all but those of model=auto."""
    return {model: run for model, run in runs.items() if model in WHOLE}


def _best_on_val(part: float, runs: dict[str, Record]) -> Record:
    return max(_whole(runs).values(), key=lambda run: val_after(run, part))


RULES: dict[str, Choice] = {
    **{NAMES[model]: itemgetter(model) for model in ("4dgs", "7dgs_noagr", "7dgs", "auto")},
    "`model=auto effects.compare=true`": itemgetter(COMPARED),
    **{f"the best model on val after {100 * part:.0f} % of the iterations": partial(_best_on_val, part)
       for part in (0.3, 0.5, 0.7, 1.0)},
}  # fmt: skip


def _by_seed(found: Experiment, scene: str) -> list[dict[str, Record]]:
    """Return the runs of all models that train on a scene, and of COMPARED, for each seed."""
    runs: dict[int, dict[str, Record]] = {}
    by_name = {model_folder(c.model, c.variant): c for c in found.group.configurations}
    for model in (name for name in (*MODELS, COMPARED) if name in by_name):
        for run in by_name[model].runs.get(scene, []):
            runs.setdefault(run.seed, {})[model] = run
    return list(runs.values())


def val_after(run: Record, part: float) -> float:
    """Return PSNR on val after a part of the training; NaN without val."""
    value = run.curve[round(part * len(run.curve)) - 1][2]
    return math.nan if value is None else value


def _interval(rank: float, n: int) -> tuple[float, float]:
    """Return the 95 % interval of Spearman's rank correlation of n pairs (Bonett and Wright 2000)."""
    half = 1.96 * math.sqrt((1 + rank**2 / 2) / (n - 3))
    middle = math.atanh(min(max(rank, -0.999), 0.999))
    return math.tanh(middle - half), math.tanh(middle + half)


def _of_auto(value: Callable[[Record], float | None]) -> Callable[[Experiment, str], float]:
    """Average a number of the records of model=auto over the seeds of a scene."""

    def mean(found: Experiment, scene: str) -> float:
        values = [value(run) for run in found.configuration("auto").runs[scene]]
        return fmean(math.nan if one is None else one for one in values)

    return mean


def _z(run: Record) -> float | None:
    screen = run.on_demand.screen if run.on_demand else None
    return screen.z if screen else None


def _probe(run: Record) -> float | None:
    direction = run.on_demand.direction if run.on_demand else None
    return direction.loss_db if direction else None


def _refined(run: Record) -> float | None:
    if not run.on_demand or not run.on_demand.gates:
        return None
    rows = run.on_demand.gates[-1].rows
    return rows["refined"] / sum(number for name, number in rows.items() if name != "removed")


def _early(effect: str) -> Callable[[Experiment, str], float]:
    """Return what an effect has changed in PSNR on val after 30 % of the training, by experiment and scene."""
    model, other = EFFECTS[effect]

    def mean(found: Experiment, scene: str) -> float:
        first, second = (
            fmean(val_after(run, 0.3) for run in found.configuration(m).runs[scene]) for m in (model, other)
        )
        return first - second

    return mean


BLOCKS = {
    "suite_scenes": scenes,
    "suite_kinds": kinds,
    "suite_lengths": lengths,
    "suite_choices": choices,
    "suite_forecasts": forecasts,
}

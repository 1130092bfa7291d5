"""Make the tables of README.md and docs/results.md from the published studies: each block is one function."""

from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd

from gsbench.report import paper, stats
from gsbench.report.frame import Results, load
from gsbench.report.intervals import estimate
from gsbench.report.render.text import table as markdown
from gsbench.report.section import EMPTY, Column, Section, number
from gsbench.report.sections import tested
from gsbench.report.sections.budgets import contests
from gsbench.report.sections.lengths import by_length

MODELS = ["3dgs", "6dgs", "4dgs", "7dgs_noagr", "7dgs_nodir", "7dgs", "auto"]
SUCCESSORS = ["freetime", "dbs", "ndgs", "ubs", "dgs"]
LENGTHS = {"250": "iterations=250", "500": "iterations=500", "1,000": "",
           "1,000, threshold 4e-4": "densify.grad_threshold=0.0004", "2,000": "iterations=2000",
           "4,000": "iterations=4000"}  # fmt: skip
MOVING = ["monocular", "rig", "array"]
KINDS = {"monocular": ["monocular"], "fixed cameras": ["rig", "array"], "all dynamic": MOVING, "static": ["static"]}
CHANGES = {"time, given direction": ("7dgs_noagr", "6dgs"), "direction": ("6dgs", "3dgs"),
           "direction, given time": ("7dgs_noagr", "7dgs_nodir"),
           "AGR, given time and direction": ("7dgs", "7dgs_noagr"),
           "7DGS instead of 4DGS": ("7dgs", "4dgs"), "`model=auto` instead of 7DGS": ("auto", "7dgs")}  # fmt: skip
COMPARED = "auto,compare=true"
AT_PAPER = "best_on_test=true"  # trex at the paper's resolution, batch size and iterations
ON_GPU = f"device=cuda,{AT_PAPER}"
PARTS = (0.3, 0.5, 0.7, 1.0)  # of the training after which the best model on val is chosen
ABLATIONS = {
    "none": "nothing", "no_agr": "no AGR", "time_only": "no direction: 4DGS with AGR",
    "direction_only": "no time: 6DGS with AGR", "no_effects": "neither time nor direction: 3DGS with AGR",
    "paper_order": "Cholesky factor over (position, time, direction), as in the paper",
    "row_scaled": "off-diagonals of the factor as parts of their row's diagonal",
    "raw_off_diagonal": "off-diagonals of the factor as raw entries", "schur": "slices by a Schur complement",
    "cholesky": "slices by a Cholesky factor", "no_time_split": "Gaussians split in space only",
    "fixed_lambda": "constant λ, the coefficients in the exponents of the opacity",
}  # fmt: skip


@cache
def study(folder: Path) -> dict[str, Results]:
    """Return the finished runs of a published study by data set."""
    results = load(folder)
    assert not results.faults, results.faults
    return {chapter.runs.dataset.iloc[0]: chapter.finished for chapter in results.chapters()}


def only(published: Path, name: str) -> Results:
    """Return the runs of a study of one data set."""
    (chapter,) = study(published / name).values()
    return chapter


def mean(chapter: Results, *quantities: str) -> pd.DataFrame:
    """Return means and intervals over seeds by model and variant; times are not of one machine."""
    runs = chapter.runs.assign(timed_on=chapter.runs.machine)
    return stats.means(runs, ["model", "variant"], quantities).set_index(["model", "variant"])


def block(rows: Iterable[dict[str, Any]], numbers: Sequence[str] = ()) -> str:
    """Return rows of texts as a Markdown table; the columns `numbers` are aligned at the right."""
    lines = list(rows)
    marks = ["---:" if name in numbers else "---" for name in lines[0]]
    texts = [list(lines[0]), marks, *(list(map(str, line.values())) for line in lines)]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in texts)


def bold_best(values: dict[str, float], texts: dict[str, str] | None = None, digits: int = 2) -> dict[str, str]:
    """Return texts by name, of which the highest value is bold, as it is shown."""
    shown = {name: number(value, digits) for name, value in values.items()}
    best = max((value for value in values.values() if value == value), default=0.0)
    return {
        name: f"**{shown[name]}**{more}" if shown[name] == number(best, digits) else f"{shown[name]}{more}"
        for name in values
        for more in [(texts or {}).get(name, "")]
    }


def with_half(row: pd.Series, name: str = "psnr_db") -> str:
    """Return a mean with half its interval, if it has one."""
    half = row[f"{name} ±"]
    return number(row[name], 2) + ("" if half != half else f" ± {half:.2f}")


def change(test: pd.Series, digits: int = 2) -> str:
    """Return a difference with half its interval over three or more scenes, bold if it is significant."""
    shown = number(test["mean"], digits, signed=True)
    shown = f"**{shown}**" if test.significant else shown
    return f"{shown} ± {number((test.high - test.low) / 2, digits)}"


# ---- mini and frontier


def table1(published: Path) -> str:
    """Return the means of `make table1`, PSNR also by scene, with the newer methods last."""
    chapter = only(published, "mini")
    of = mean(chapter, "psnr_db", "ssim", "lpips_alex", "train_s", "fps", "gaussians").xs("", level="variant")
    scenes = chapter.runs.groupby(["model", "scene"]).psnr_db.mean().unstack()
    shown = of.loc[
        [m for m in [*MODELS, *SUCCESSORS] if m in of.index],
        ["psnr_db", "ssim", "lpips_alex", "train_s", "fps", "gaussians"],
    ]
    return markdown(Section("", "", "", scenes.loc[shown.index].join(shown).reset_index(), {"fps": Column("FPS", 0)}))


def cost(published: Path, lengths: Iterable[str] = ("250", "1,000", "4,000"), models: Iterable[str] = MODELS) -> str:
    """Return PSNR and seconds of models after some lengths of training."""
    of, names = mean(only(published, "frontier"), "psnr_db", "train_s"), list(models)
    rows = []
    for length in lengths:
        at = of.xs(LENGTHS[length], level="variant").reindex(names)
        seconds = {m: f", {number(at.train_s[m], 1)}" for m in names}
        rows.append({"iterations": length} | bold_best(at.psnr_db.to_dict(), seconds))
    return block(rows, ["iterations", *names])


def frontier(published: Path) -> str:
    """Return all lengths of `make frontier`, and the best model within each budget."""
    chapter = only(published, "frontier")
    best = [
        {
            "budget": budget,
            "best": f"`{table.model.iloc[0]}` {table.variant.iloc[0]}".rstrip(),
            "PSNR": number(table.psnr_db.iloc[0], 2),
        }
        for budget, table in contests(chapter).items()
    ]
    newer = [m for m in SUCCESSORS if m in set(chapter.runs.model)]
    parts = [cost(published, LENGTHS)]
    parts += [cost(published, ["1,000", "2,000"], newer)] if newer else []
    return "\n\n".join([*parts, block(best, ["PSNR"])])


def effects(published: Path) -> str:
    """Return what time, direction and AGR gain and cost, given the other effects."""
    chapter = only(published, "frontier")
    tests = tested(chapter)
    of = {quantity: rows.set_index("name") for quantity, rows in tests[tests.section == "effects"].groupby("quantity")}
    gains = of["psnr_db"]
    single = [name for name in gains.index if " × " not in name and "mean over" not in name and "nested" not in name]
    rows = []
    for name in single:
        key = f"{name}, nested" if f"{name}, nested" in gains.index else name
        scenes = zip(sorted(chapter.runs.scene.unique()), gains.loc[key, "by scene"], strict=True)
        rows.append(
            {"effect": name.replace(" alone", "").replace(", with", " given"), "PSNR, dB": change(gains.loc[key])}
            | {scene: number(value, 2, signed=True) for scene, value in scenes}
            | {
                title: number(of[quantity].loc[key, "mean"], digits, signed=True)
                for title, quantity, digits in (
                    ("training, s", "train_s", 1),
                    ("frame, ms", "frame_ms", 2),
                    ("model, MB", "model_mb", 2),
                )
            }
        )
    return block(rows, list(rows[0])[2:])


def ablation(published: Path) -> str:
    """Return what each part of 7DGS is worth: the first row has its PSNR, the others the differences to it."""
    chapter = only(published, "ablation")
    tests = tested(chapter)
    pairs = {
        key: test for test in tests[tests.section == "pairs"].to_dict("records") for key in [frozenset(test["weights"])]
    }
    keys = {
        variant: (model, variant) for model, variant in chapter.runs[["model", "variant"]].drop_duplicates().to_numpy()
    }
    arrays, rows = stats.grids(chapter), []
    for name, words in ABLATIONS.items():
        key, whole = keys[f"ablation={name}"], keys["ablation=none"]
        weights = {key: 1.0} if name == "none" else {key: 1.0, whole: -1.0}
        of = estimate(stats.contrast(arrays, weights))
        test = (
            pd.Series(stats.row_of(of))
            if name == "none"
            else pd.Series(stats.row_of(of) | {"significant": pairs[frozenset((key, whole))]["significant"]})
        )
        rows.append(
            {
                "changed": words,
                "`+ablation=`": f"`{name}`",
                "PSNR, dB": number(of.mean, 2) if name == "none" else change(test),
            }
            | {
                scene: number(value, 2, signed=name != "none")
                for scene, value in zip(sorted(arrays), of.each, strict=True)
            }
        )
    return block(rows, list(rows[0])[3:])


# ---- the suite


def suite_scenes(published: Path) -> str:
    """Return PSNR of every model on every scene of the suite."""
    rows = []
    for kind, chapter in sorted(study(published / "suite").items()):
        runs = chapter.runs[(chapter.runs.variant == "") & chapter.runs.model.isin(MODELS)]
        for scene, values in (
            runs.groupby(["scene", "model"]).psnr_db.mean().unstack().reindex(columns=MODELS).iterrows()
        ):
            rows.append({"scene": scene, "kind": kind} | bold_best(values.to_dict()))
    return block(rows, MODELS)


def suite_kinds(published: Path, changes: Iterable[str] = CHANGES) -> str:
    """Return what each effect changes in PSNR, by kind of scene: mean ± half the interval, and scenes that gain."""
    arrays = {kind: stats.grids(chapter) for kind, chapter in study(published / "suite").items()}
    rows = [
        {"effect": f"{name}: {' - '.join(f'`{model}`' for model in CHANGES[name])}"}
        | {
            title: _price([v for kind in kinds for v in stats.contrast(arrays[kind], _minus(name))])
            for title, kinds in KINDS.items()
        }
        for name in changes
    ]
    return block(rows, list(KINDS))


def _minus(name: str, variant: str = "") -> stats.Weights:
    a, b = CHANGES[name]
    return {(a, variant): 1.0, (b, variant): -1.0}


def _price(scenes: list[Any]) -> str:
    of = estimate(scenes)
    shown = number(of.mean, 2, signed=True)
    shown = f"**{shown}**" if of.half_over_scenes < abs(of.mean) else shown
    return f"{shown} ± {number(of.half_over_scenes, 2)}, {of.gaining} of {of.scenes}"


def suite_lengths(published: Path) -> str:
    """Return what models reach and what effects change after three lengths, over the dynamic scenes that all have."""
    variants = {n: LENGTHS[n] for n in ("500", "1,000", "2,000")}
    chapters = [study(published / "suite")[kind] for kind in MOVING]
    runs = pd.concat([of.runs for of in chapters])
    runs = runs[runs.model.isin(MODELS) & runs.variant.isin(variants.values())]
    counts = runs.drop_duplicates(["scene", "model", "variant"]).scene.value_counts()
    shared = set(counts.index[counts == len(MODELS) * len(variants)])
    of = (
        runs[runs.scene.isin(shared)]
        .groupby(["variant", "model", "scene"])[["psnr_db", "train_s"]]
        .mean()
        .groupby(["variant", "model"])
        .mean()
    )
    arrays = {scene: grid for chapter in chapters for scene, grid in stats.grids(chapter).items() if scene in shared}
    reached = [
        {"iterations": n}
        | bold_best(of.loc[v].psnr_db[MODELS].to_dict(), {m: f", {number(of.loc[(v, m)].train_s, 1)}" for m in MODELS})
        for n, v in variants.items()
    ]
    prices = [
        {"effect": name}
        | {f"{n} iterations": _price(stats.contrast(arrays, _minus(name, v))) for n, v in variants.items()}
        for name in CHANGES
    ]
    return f"{block(reached, list(reached[0]))}\n\n{block(prices, list(prices[0])[1:])}"


def suite_choices(published: Path) -> str:
    """Return what choices of a model lose in PSNR to the best of six models, over dynamic scenes with val and test."""
    parts = []
    for kind in MOVING:
        chapter = study(published / "suite")[kind]
        runs = chapter.runs.assign(
            model=chapter.runs.model.where(chapter.runs.variant == "", chapter.runs.model + "," + chapter.runs.variant)
        )
        place = chapter.curves.groupby("run").cumcount() + 1
        size = chapter.curves.groupby("run").run.transform("size")
        for part in PARTS:
            at = chapter.curves[place == (part * size).round()].set_index("run").psnr_val_db
            runs = runs.assign(**{f"val {part}": at.reindex(runs.index)})
        parts.append(runs[runs.model.isin([*MODELS, COMPARED])])
    runs = pd.concat(parts)
    unusable = (runs["val 1.0"].isna() | (runs.protocol_eval_split == "val")).groupby(runs.scene).any()
    runs = runs[~runs.scene.map(unusable)]
    whole = [model for model in MODELS if model != "auto"]
    psnr = runs.pivot(index=["scene", "seed"], columns="model", values="psnr_db")
    best = psnr[whole].max(axis=1)
    names = {
        "4DGS": "4dgs",
        "7DGS without AGR": "7dgs_noagr",
        "7DGS": "7dgs",
        "`model=auto`": "auto",
        "`model=auto effects.compare=true`": COMPARED,
    }
    lost = {title: psnr[model] - best for title, model in names.items()}
    for part in PARTS:
        val = runs[runs.model.isin(whole)].pivot(index=["scene", "seed"], columns="model", values=f"val {part}")
        chosen = pd.Series([psnr.at[key, model] for key, model in val.idxmax(axis=1).items()], val.index)
        lost[f"the best model on val after {100 * part:.0f} % of the iterations"] = chosen - best
    scenes = pd.DataFrame(lost).groupby("scene").mean()
    rows = [
        {
            "choice": name,
            "mean, dB": number(of.mean(), 2, signed=True),
            "worst scene, dB": number(of.min(), 2, signed=True),
            "at most 0.1 dB below on": f"{(of >= -0.1).sum()} of {len(of)}",
        }
        for name, of in scenes.items()
    ]
    return block(rows, list(rows[0])[1:])


def lengths(published: Path) -> str:
    """Return PSNR after four lengths, and after the one that `train.lengths=4` keeps."""
    long = (
        only(published, "lengths").runs
        if len(study(published / "lengths")) == 1
        else pd.concat([c.runs for c in study(published / "lengths").values()])
    )
    runs = pd.concat([long, *(c.runs for c in study(published / "suite").values())])
    runs = runs[runs.variant.isin(["", "iterations=2000", "iterations=4000", "iterations=8000"])]
    table = by_length(runs).dropna()
    rows = [
        {"scene": scene, "model": model}
        | bold_best(row.drop(["kept", "tried"]).to_dict())
        | {"kept": number(row.kept, 2)}
        for (scene, model, _), row in table.iterrows()
    ]
    return block(rows, list(rows[0])[2:])


# ---- D-NeRF and recipes


def trex(published: Path) -> str:
    """Return README's table of trex at the paper's resolution, batch size and iterations."""
    of = mean(only(published, "dnerf"), "psnr_db", "psnr_best_on_test_db")
    keys = {"7dgs": ON_GPU, "7dgs_noagr": ON_GPU, "4dgs": AT_PAPER}
    rows = {model: of.loc[(model, variant)] for model, variant in keys.items()}
    numbers = {model: paper.average("D-NeRF", ["trex"], model) for model in keys}
    return block(
        [
            {"": "seeds"} | {m: str(int(row.seeds)) for m, row in rows.items()},
            {"": "last iteration, dB"} | {m: with_half(row) for m, row in rows.items()},
            {"": "best on test, dB"} | {m: with_half(row, "psnr_best_on_test_db") for m, row in rows.items()},
            {"": "paper (best on test), dB"}
            | {m: number(row.psnr_db, 2) for m, row in numbers.items() if row is not None},
        ],
        list(keys),
    )


def _at_paper(of: pd.Series, *, gpu: bool) -> dict[str, str]:
    minutes = (of.train_s if gpu else of.train_cpu_s) / 60
    return {
        "seeds": str(int(of.seeds)),
        "PSNR, last iteration": with_half(of),
        "best on test (leaks)": with_half(of, "psnr_best_on_test_db"),
        "val": number(of.psnr_val_db, 2),
        "training views": number(of.psnr_train_db, 1),
        "SSIM": number(of.ssim, 3),
        "LPIPS-Alex": number(of.lpips_alex, 3),
        "minutes of CPU or GPU": f"{minutes:.1f} {'GPU' if gpu else 'CPU'}",
        "Gaussians": number(of.gaussians, 0),
    }


OF_TREX = (
    "psnr_db",
    "psnr_best_on_test_db",
    "psnr_val_db",
    "psnr_train_db",
    "ssim",
    "lpips_alex",
    "train_s",
    "train_cpu_s",
    "gaussians",
)


def trex400(published: Path) -> str:
    """Return trex as the paper trains it, beside the paper's rows, and with other recipes."""
    of = mean(load(published / "dnerf").finished, *OF_TREX)  # a chapter has times of one machine
    rows = []
    for model in ("7dgs", "7dgs_noagr", "4dgs"):
        for variant, place in ((ON_GPU, "H200"), (AT_PAPER, "CPU")):
            if (model, variant) in of.index:
                rows.append(
                    {"trex, 400 x 400": f"{model}, {place}"}
                    | _at_paper(of.loc[(model, variant)], gpu=variant == ON_GPU)
                )
        numbers = paper.average("D-NeRF", ["trex"], model)
        assert numbers is not None
        minutes = EMPTY if numbers.train_min != numbers.train_min else f"{numbers.train_min:.1f} GPU"
        rows.append(
            dict.fromkeys(rows[0], EMPTY)
            | {
                "trex, 400 x 400": "paper",
                "best on test (leaks)": number(numbers.psnr_db, 2),
                "SSIM": number(numbers.ssim, 3),
                "LPIPS-Alex": number(numbers.lpips_alex, 3),
                "minutes of CPU or GPU": minutes,
                "Gaussians": number(numbers.gaussians, 0),
            }
        )
    others = {
        ("7dgs_noagr", "paper"): f"recipe=paper,{AT_PAPER}",
        ("7dgs_noagr", "authors"): f"recipe=authors,{AT_PAPER}",
    } | {(model, "quick"): "recipe=quick" for model in ("7dgs", "4dgs", "7dgs_noagr")}
    for (model, name), variant in others.items():
        row = _at_paper(of.loc[(model, variant)], gpu=False)
        rows.append({"trex, 400 x 400": f"{model}, `+recipe={name}`, CPU"} | row)
    return block(rows, list(rows[0])[1:])


def on_demand(published: Path) -> str:
    """Return what the removal of effects from Gaussians changes, as a range over scenes."""
    quantities = {
        "PSNR on test, dB": ("psnr_db", 2),
        "frame time, %": ("frame_ms", 0),
        "size of the model, %": ("model_mb", 0),
    }
    columns: dict[str, dict[str, str]] = {}
    for model in ("7dgs", "7dgs_noagr", "4dgs"):
        changes = pd.concat([_removal(chapter, model) for chapter in study(published / "effects").values()])
        title = f"{model}, {len(changes)} scenes"
        columns[title] = {
            name: " to ".join(number(value, digits, signed=True) for value in (changes[q].min(), changes[q].max()))
            for name, (q, digits) in quantities.items()
        }
    return block([{"": name} | {title: of[name] for title, of in columns.items()} for name in quantities])


def _removal(chapter: Results, model: str) -> pd.DataFrame:
    """Return by scene the change of PSNR, and of frame time and size in per cent, where effects are removed."""
    names = ["psnr_db", "frame_ms", "model_mb"]
    runs = chapter.runs[chapter.runs.model == model]
    of = runs.groupby(["variant", "scene"])[names].mean()
    gated = runs.groupby("variant").on_demand.any()
    rows = []
    for less in gated.index[gated]:
        words = set(less.split(","))
        full = max(gated.index[~gated], key=lambda variant: len(words & set(variant.split(","))))
        new, old = of.loc[less], of.loc[full].reindex(of.loc[less].index)
        rows.append((100 * (new / old - 1)).assign(psnr_db=new.psnr_db - old.psnr_db))
    return pd.concat(rows) if rows else pd.DataFrame(columns=names)


README: dict[str, Callable[[Path], str]] = {
    "cost": lambda published: cost(published, models=[model for model in MODELS if model != "6dgs"]),
    "worth": lambda published: suite_kinds(published, list(CHANGES)[:4]),
    "trex": trex,
}
RESULTS: dict[str, Callable[[Path], str]] = {
    "table1": table1,
    "frontier": frontier,
    "effects": effects,
    "suite_scenes": suite_scenes,
    "suite_kinds": suite_kinds,
    "suite_lengths": suite_lengths,
    "suite_choices": suite_choices,
    "lengths": lengths,
    "ablation": ablation,
    "trex400": trex400,
    "on_demand": on_demand,
}

"""Make the tables of README.md and docs/ from the published studies: each block is one function."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import pandas as pd

from gsbench.report import paper, paper_tables, stats
from gsbench.report.frame import Results, load, names_of, without
from gsbench.report.intervals import Values, estimate
from gsbench.report.render.text import bold
from gsbench.report.render.text import table as markdown
from gsbench.report.section import EMPTY, Column, Section, number
from gsbench.report.sections.lengths import by_length
from gsbench.report.sections.protocol import TUNED

MODELS = ["3dgs", "6dgs", "4dgs", "7dgs_noagr", "7dgs_nodir", "7dgs", "auto"]
MOVING = ["monocular", "rig", "array"]
DNERF, DNERF_VARIANT = "D-NeRF", "downscale=4,iterations=1000"  # the studies dnerf100 and networks
UNTUNED = "D-NeRF, untuned"
KINDS = {
    DNERF: [DNERF],
    UNTUNED: [UNTUNED],
    "monocular": ["monocular"],
    "fixed cameras": ["rig", "array"],
}
CHANGES = {
    "time, given direction": ("7dgs_noagr", "6dgs"),
    "direction": ("6dgs", "3dgs"),
    "direction, given time": ("7dgs_noagr", "7dgs_nodir"),
    "AGR, given time": ("4dgs_agr", "4dgs"),
    "AGR, given time and direction": ("7dgs", "7dgs_noagr"),
    "a field": ("hexplane", "3dgs"),
    "a field instead of these": ("hexplane", "7dgs"),
    "7DGS instead of 4DGS": ("7dgs", "4dgs"),
    "7DGS instead of 4DGS with AGR": ("7dgs", "4dgs_agr"),
    "`model=auto` instead of 7DGS": ("auto", "7dgs"),
}
EFFECTS = list(CHANGES)[:7]
PRICES = {"train_cpu_s": Column("CPU s", 1, signed=True), "frame_ms": Column("ms a frame", 2, signed=True)}
CHOICES = {
    "hexplane": "4DGaussians, a field",
    "4dgs": "4DGS",
    "7dgs_noagr": "7DGS without AGR",
    "7dgs": "7DGS",
    "auto": "`model=auto`",
    "auto compare=true": "`model=auto effects.compare=true`",
}
POINTS = "initial_points=100000"  # trained with as many as in the paper, before D-NeRF had 10,000
LAMBDA_T = f"lambda_t=0.05,{POINTS}"  # trained before lambda_t started at 0.5 on D-NeRF
# Rows of trex at the paper's resolution, batch size and iterations: title, model and variant.
TREX = {
    "7dgs, λ_t from 0.05, H200": ("7dgs", f"device=cuda,{LAMBDA_T},best_on_test=true"),
    "7dgs, λ_t from 0.05, CPU": ("7dgs", f"{LAMBDA_T},best_on_test=true"),
    "7dgs_noagr, λ_t from 0.05, H200": ("7dgs_noagr", f"device=cuda,{LAMBDA_T},best_on_test=true"),
    "7dgs_noagr, λ_t from 0.05, CPU": ("7dgs_noagr", f"{LAMBDA_T},best_on_test=true"),
    "4dgs, CPU": ("4dgs", f"{POINTS},best_on_test=true"),
    "7dgs_noagr, `+recipe=paper`, CPU": ("7dgs_noagr", "recipe=paper,best_on_test=true"),
    "7dgs_noagr, `+recipe=authors`, CPU": ("7dgs_noagr", "recipe=authors,best_on_test=true"),
}
OF_TABLE_1 = list(paper_tables.NAMES)  # its models, in its order
NEAR = 0.1  # dB below the best model
ABLATIONS = {
    "none": "nothing",
    "paper_order": "Cholesky factor over (position, time, direction), as in the paper",
    "row_scaled": "off-diagonals of the factor as parts of their row's diagonal",
    "raw_off_diagonal": "off-diagonals of the factor as raw entries",
    "schur": "slices by a Schur complement",
    "cholesky": "slices by a Cholesky factor",
    "no_time_split": "Gaussians split in space only",
    "fixed_lambda": "constant λ, the coefficients in the exponents of the opacity",
}
# Of conf/trial/; the last is that of models whose rates are constant in the recipe.
TRIALS = ["recipe", "many", "fast", "slow", "further", "long_rates", "constant", "falling"]
OF_TREX = {
    "psnr_db": Column("PSNR, last iteration"),
    "psnr_best_on_test_db": Column("best on test"),
    "train_cpu_s": Column("CPU min", 1),
    "gaussians": Column("Gaussians", 0),
}


@cache
def study(folder: Path) -> dict[str, Results]:
    """Return the finished runs of a published study, which has one experiment, by data set."""
    results = load(folder)
    assert not results.faults, results.faults
    return {chapter.runs.dataset.iloc[0]: chapter.finished for chapter in results.chapters()}


def only(published: Path, name: str) -> Results:
    """Return the finished runs of a study that has only one data set."""
    (chapter,) = study(published / name).values()
    return chapter


def means(results: Results, *quantities: str) -> pd.DataFrame:
    """Return means and intervals over seeds by model and variant; times of all machines count."""
    runs = results.runs.assign(is_timed=True)  # `stats.means` drops times of other machines
    return stats.means(runs, ["model", "variant"], quantities).set_index(["model", "variant"])


def block(table: pd.DataFrame, **columns: Column) -> str:
    """Return a table as Markdown, its index first."""
    return markdown(Section("", "", "", table.reset_index(), columns))


def shown(table: pd.DataFrame, digits: int = 2) -> pd.DataFrame:
    """Return numbers as texts, those of rank 1 bold."""
    columns = {name: Column(name, digits) for name in table}
    return Section("", "", "", table.reset_index(drop=True), columns).shown(bold).set_axis(table.index)


def reached(psnr: pd.DataFrame, seconds: pd.DataFrame) -> str:
    """Return PSNR, the best of a row bold, and seconds as a table of cells such as "17.10, 0.9"."""
    return block(shown(stats.ranked_rows(psnr)) + ", " + shown(seconds, 1))


def changes(tests: pd.DataFrame) -> pd.DataFrame:
    """Return tested differences: mean (bold if significant) ± half the interval."""
    table = pd.DataFrame({"mean": tests["mean"], "mean ±": tests.high - tests["mean"]})
    table["mean rank"] = tests.significant.astype(int)  # rank 1 is shown bold
    return table


def gain_text(scenes: list[Values]) -> str:  # for each scene the differences [seeds, views]
    """Return a difference ± half its interval over scenes, bold if significant, and on how many scenes it is positive.

    Without scenes, the text is a dash.
    """
    if not scenes:
        return EMPTY
    gain = estimate(scenes)
    mean = bold(number(gain.mean, 2, signed=True), int(gain.half_over_scenes < abs(gain.mean)))
    return f"{mean} ± {number(gain.half_over_scenes, 2)}, {gain.gaining}/{gain.scenes}"


# ---- mini and frontier


def table1(published: Path) -> str:
    """Return means of all models on the embedded scenes, those of `make table1` first."""
    quantities = ["psnr_db", "lpips_alex", "train_s", "fps", "gaussians"]
    table = means(only(published, "mini"), *quantities).xs("", level="variant")
    first = [model for model in MODELS if model in table.index]
    return block(table.loc[[*first, *table.index.difference(first)], quantities], fps=Column("FPS", 0))


def cost(published: Path) -> str:
    """Return PSNR and seconds of models after two lengths of training."""
    lengths, models = {"1,000": "", "4,000": "iterations=4000"}, ["3dgs", "4dgs", "7dgs_noagr", "7dgs", "auto"]
    table = means(only(published, "frontier"), "psnr_db", "train_s").unstack("model")
    table = table.loc[list(lengths.values())].set_axis(pd.Index(lengths, name="iterations"))
    return reached(table.psnr_db[models], table.train_s[models])


def ablation(published: Path) -> str:
    """Return what each part of 7DGS is worth: the first row has its PSNR, the others the differences to it."""
    chapter = only(published, "ablation")
    keys = {variant: (model, variant) for model, variant in zip(chapter.runs.model, chapter.runs.variant, strict=True)}
    full, *ablated = [keys[f"ablation={name}"] for name in ABLATIONS]
    arrays = stats.grids(chapter)
    tests = [
        stats.differences(arrays, [{full: 1.0}]).assign(significant=False),  # no difference, but PSNR itself
        stats.differences(arrays, [{part: 1.0, full: -1.0} for part in ablated]),
    ]
    table = changes(pd.concat(tests, ignore_index=True))
    table.insert(0, "`+ablation=`", [f"`{name}`" for name in ABLATIONS])
    columns = {"mean": Column("PSNR, dB")}
    return block(table.set_axis(pd.Index(ABLATIONS.values(), name="changed")), **columns)


# ---- the suite


def suite_kinds(published: Path) -> str:
    """Return what each effect changes in PSNR, by kind of scene, with the models that are compared."""
    table = by_kind(published, list(CHANGES), list(KINDS))
    names = {name: f"{name}: {' - '.join(f'`{model}`' for model in CHANGES[name])}" for name in CHANGES}
    return block(table.rename(names))


def by_kind(published: Path, names: list[str], titles: list[str]) -> pd.DataFrame:
    """Return texts of what effects (keys of CHANGES) change in PSNR, a column a kind of scene (keys of KINDS)."""
    arrays = {kind: stats.grids(chapter) for kind, chapter in study(published / "suite").items()}
    arrays[DNERF] = _of_dnerf100(published)
    arrays[UNTUNED] = {scene: values for scene, values in arrays[DNERF].items() if scene not in TUNED}
    columns = {
        title: [gain_text([v for kind in KINDS[title] for v in _gains(arrays, kind, name)]) for name in names]
        for title in titles
    }
    return pd.DataFrame(columns, pd.Index(names, name="effect"))


def worth(published: Path) -> str:
    """Return what effects gain, and what they cost on D-NeRF: mean differences of runs with the same scene and seed."""
    table = by_kind(published, EFFECTS, [DNERF, UNTUNED])
    for quantity in PRICES:
        costs = {DNERF: _of_dnerf100(published, quantity)}
        table[quantity] = [estimate(_gains(costs, DNERF, name)).mean for name in EFFECTS]
    return block(table, **PRICES)


def _of_dnerf100(published: Path, quantity: str = "psnr_db") -> stats.Grids:
    """Return a quantity of all models on D-NeRF at 100 x 100 pixels; `networks` has those with another network."""
    models, networks = (stats.grids(only(published, name), quantity) for name in ("dnerf100", "networks"))
    return {scene: networks[scene] | models[scene] for scene in models}


def _gains(arrays: dict[str, stats.Grids], kind: str, name: str) -> list[Values]:
    """Return one of CHANGES as differences [seeds, views] of each scene of a kind."""
    variant = DNERF_VARIANT if kind in (DNERF, UNTUNED) else ""
    return list(stats.contrast(arrays[kind], minus(*CHANGES[name], variant)).values())


def minus(a: str, b: str, variant: str) -> stats.Weights:
    """Return the difference of two models, both trained with the settings of `variant`."""
    return {(a, variant): 1.0, (b, variant): -1.0}


def choices(published: Path) -> str:
    """Return what choices of a model lose in PSNR to the best model, over scenes with val and test of two studies."""
    runs = {
        "suite": [_with_val(study(published / "suite")[kind]) for kind in MOVING],
        DNERF: [_with_val(_of_dnerf(only(published, name))) for name in ("dnerf100", "compare100")],
    }
    lost = {title: _lost(pd.concat(tables)) for title, tables in runs.items()}
    table = pd.DataFrame(index=lost[DNERF].columns.rename("choice"))
    for title, gap in lost.items():
        near = (gap >= -NEAR).sum()
        texts = {name: f"{number(mean, 2, signed=True)}, {near[name]}/{len(gap)}" for name, mean in gap.mean().items()}
        table[title] = pd.Series(texts).reindex(table.index).fillna(EMPTY)
        table[f"{title}, worst"] = gap.min()
    return block(table, **{f"{title}, worst": Column(f"{title}, worst", signed=True) for title in lost})


def _of_dnerf(chapter: Results) -> Results:
    """Return a study of D-NeRF with variants that leave out what all its runs have in common."""
    variant = chapter.runs.variant.map(lambda variant: without(variant, "downscale", "iterations"))
    return replace(chapter, runs=chapter.runs.assign(variant=variant))


def _lost(runs: pd.DataFrame) -> pd.DataFrame:
    """Return PSNR of CHOICES (columns) minus that of the model with the best PSNR on test, for each scene (rows)."""
    unusable = (runs.val.isna() | (runs.protocol_eval_split == "val")).groupby(runs.scene).any()  # no val
    runs = runs[~runs.scene.map(unusable)]
    psnr = runs.pivot(index=["scene", "seed"], columns="name", values="psnr_db")
    fixed = [name for name in psnr if not name.startswith("auto")]
    best = psnr[fixed].max(axis=1)
    lost = {text: psnr[name] - best for name, text in CHOICES.items() if name in psnr}
    val = runs[runs.name.isin(fixed)].pivot(index=["scene", "seed"], columns="name", values="val")
    chosen = pd.Series([psnr.at[key, model] for key, model in val.idxmax(axis=1).items()], val.index)
    lost["the best on val"] = chosen - best
    return pd.DataFrame(lost).groupby("scene").mean()


def _with_val(chapter: Results) -> pd.DataFrame:
    """Return runs with their name and their last PSNR on val."""
    runs = chapter.runs.assign(name=names_of(chapter.runs), val=chapter.curves.groupby("run").psnr_val_db.last())
    return runs[runs.name.isin([*MODELS, *CHOICES])]


def lengths(published: Path) -> str:
    """Return PSNR of 7DGS after 1,000 (variant ""), 2,000, 4,000 and 8,000 iterations, and after the one val keeps."""
    # `lengths` has the long trainings, of seed 0 only, and `suite` the others: `by_length` keeps this seed.
    runs = pd.concat([chapter.runs for name in ("lengths", "suite") for chapter in study(published / name).values()])
    runs = runs[runs.variant.isin(["", "iterations=2000", "iterations=4000", "iterations=8000"])]
    table = by_length(runs[runs.model == "7dgs"]).dropna().droplevel(["model", "seed"])
    return block(stats.ranked_rows(table.drop(columns=["kept", "tried"])).assign(kept=table.kept))


# ---- D-NeRF and recipes


# By the end of a column's title, the column psnr_* of `paper_tables.table1`; the paper has only the best on test.
LAST, BEST, OF_PAPER = {"": "db"}, {", best": "best_on_test_db"}, {", paper": "best_on_test_db paper"}


def dnerf(published: Path, quantities: dict[str, dict[str, str]]) -> str:
    """Return PSNR on D-NeRF at the paper's protocol, by scene and on average.

    `quantities` has for each model those of LAST, BEST and OF_PAPER that are shown. Scenes that lack one are left out.
    """
    rows = paper_tables.table1(paper_tables.of_the_paper(load(published / "dnerf")))
    rows = rows[(rows.table == "paper") & (rows.recipe == POINTS)]
    table = _psnr_by_model(rows.set_index(["scene", "model"]), quantities)
    table = table.reindex([*paper.PROTOCOLS[DNERF].scenes, paper.AVERAGE]).dropna()
    scenes = rows.scenes[rows.scene == paper.AVERAGE].max()
    table = table.astype(float).rename(index={paper.AVERAGE: f"mean of {scenes:.0f}"}).rename_axis("scene")
    return block(table, **{name: Column(name) for name in table})


def _psnr_by_model(scores: pd.DataFrame, quantities: dict[str, dict[str, str]]) -> pd.DataFrame:
    """Return a column of scenes for each quantity of each model, from scores by scene and model."""
    return pd.DataFrame(
        {
            f"{model}{title}": scores[f"psnr_{quantity}"].xs(model, level="model")
            for model, columns in quantities.items()
            for title, quantity in columns.items()
        }
    )


def dnerf400(published: Path, quantities: dict[str, dict[str, str]]) -> str:
    """Return the table of `dnerf` for trainings with `+recipe=quick`, with all scenes of the study dnerf400."""
    averages = only(published, "dnerf400").runs.groupby(["scene", "model"]).mean(numeric_only=True)
    scores = averages.join(paper.table1().loc[DNERF].psnr_db.rename("psnr_best_on_test_db paper"))
    table = _psnr_by_model(scores, quantities)
    table = pd.concat([table, table.mean().to_frame(f"mean of {len(table)}").T]).rename_axis("scene")
    return block(table, **{name: Column(name) for name in table})


def dnerf400_costs(published: Path) -> str:
    """Return SSIM, CPU minutes and Gaussians of the trainings of `dnerf400`, and the paper's, on average."""
    runs = only(published, "dnerf400").runs.set_index(["scene", "model"])
    in_paper = paper.table1().loc[DNERF][["ssim", "gaussians"]].add_suffix(" paper")
    runs = runs.assign(cpu_min=runs.train_cpu_s / 60).join(in_paper)
    columns = {
        "cpu_min": Column("CPU min", 1),
        "ssim": Column("SSIM", 3),
        "ssim paper": Column("SSIM, paper", 3),
        "gaussians": Column("Gaussians", 0),
        "gaussians paper": Column("Gaussians, paper", 0),
    }
    return block(runs[list(columns)].groupby("model").mean().loc[[*OF_TABLE_1, "auto"]], **columns)


def dnerf200(published: Path) -> str:
    """Return PSNR of models on the scenes of D-NeRF at 200 x 200 pixels with `+recipe=quick`, and average costs."""
    runs, models = only(published, "dnerf200").runs, OF_TABLE_1
    costs = runs.assign(cpu_min=runs.train_cpu_s / 60).groupby("model")[["cpu_min", "gaussians"]].mean()
    columns = {"cpu_min": Column("CPU min", 1), "gaussians": Column("Gaussians", 0)}
    texts = Section("", "", "", costs.loc[models], columns).shown(bold).set_axis(models)
    return block(pd.concat([_by_scene(runs, models), texts.T]).rename_axis("scene"))


def _by_scene(runs: pd.DataFrame, models: list[str]) -> pd.DataFrame:
    """Return PSNR of models by scene and on average as texts, the best of a row bold."""
    psnr = runs.groupby(["scene", "model"]).psnr_db.mean().unstack()[models]
    return shown(stats.ranked_rows(pd.concat([psnr, psnr.mean().to_frame("mean").T]).rename_axis("scene")))


def dnerf100(published: Path) -> str:
    """Return what models reach and cost on D-NeRF at 100 x 100 pixels, on average, the best first.

    Models that have AGR only here are left out; docs/images/networks.png has them.
    """
    runs = only(published, "dnerf100").runs
    runs = runs[~runs.model.str.endswith("_agr")]
    columns = {
        "psnr_db": Column("PSNR", 2),
        "train_cpu_s": Column("CPU s", 1),
        "frame_ms": Column("ms a frame", 2),
        "gaussians": Column("Gaussians", 0),
    }
    table = runs.groupby(["model", "scene"])[list(columns)].mean().groupby("model").mean()
    return block(table.sort_values("psnr_db", ascending=False), **columns)


def dnerf_signs(published: Path) -> str:
    """Return differences of models beside those in the paper, and on how many scenes both have the same sign."""
    in_paper = paper.table1().psnr_db[DNERF].unstack()
    variants = {
        "100 × 100": ("dnerf100", DNERF_VARIANT),
        "400 × 400": ("dnerf400", "recipe=quick,downscale=1,best_on_test=true"),
    }
    arrays = {size: stats.grids(only(published, study)) for size, (study, _) in variants.items()}
    rows = {}
    for a, b in (("7dgs", "4dgs"), ("7dgs_noagr", "4dgs"), ("7dgs", "7dgs_noagr")):
        expected, cells, same = in_paper[a] - in_paper[b], {}, []
        for size, (_, variant) in variants.items():
            gains = stats.contrast(arrays[size], minus(a, b, variant))
            cells[size] = gain_text(list(gains.values()))
            agree = sum((gain.mean() > 0) == (expected[scene] > 0) for scene, gain in gains.items())
            same.append(f"{agree}/{len(gains)}")
        mean = number(expected.mean(), 2, signed=True)
        rows[f"`{a}` - `{b}`"] = {**cells, "paper": mean, "same sign": ", ".join(same)}
    return block(pd.DataFrame(rows).T.rename_axis("difference"))


def trex400(published: Path) -> str:
    """Return trex as the paper trains it, with both initial lambda_t, and by other recipes."""
    results = load(published / "dnerf").finished  # no chapters, which drop times of other machines
    averages = means(results.of(results.runs.scene == "trex"), *OF_TREX)
    rows = {title: averages.loc[key] for title, key in TREX.items()}
    table = pd.DataFrame(rows).T.rename_axis("trex, 400 x 400").astype(float)
    table["train_cpu_s"] = (table.train_cpu_s / 60).where(table.index.str.endswith("CPU"))
    intervals = ["psnr_db ±", "psnr_best_on_test_db ±"]
    return block(table[["seeds", *OF_TREX, *intervals]], **OF_TREX)


def on_demand(published: Path) -> str:
    """Return what the removal of effects from Gaussians changes: the least and the largest change over scenes."""
    rows: dict[str, dict[str, float]] = {}
    columns: dict[str, Column] = {}
    for model in ("7dgs", "7dgs_noagr", "4dgs"):
        by_scene = pd.concat([_removal(chapter, model) for chapter in study(published / "effects").values()])
        ends = {f"{name} {end}": by_scene[name].agg(end) for name in by_scene for end in ("min", "max")}
        rows[model] = ends | {"scenes": len(by_scene)}
    for name, title, digits in (("psnr_db", "dB", 2), ("frame_ms", "frame time, %", 0), ("model_mb", "MB, %", 0)):
        columns |= {f"{name} {end}": Column(f"{title}, {end}", digits, signed=True) for end in ("min", "max")}
    return block(pd.DataFrame(rows).T[["scenes", *columns]].rename_axis("model"), **columns)


def _removal(chapter: Results, model: str) -> pd.DataFrame:
    """Return by scene the change of PSNR, and of frame time and size in per cent, where effects are removed."""
    names = ["psnr_db", "frame_ms", "model_mb"]
    runs = chapter.runs[chapter.runs.model == model]
    averages = runs.groupby(["variant", "scene"])[names].mean()
    gated = runs.groupby("variant").on_demand.any()
    rows = [pd.DataFrame(columns=names)]  # also if no effect was removed
    for with_gate in gated.index[gated]:
        words = set(with_gate.split(","))
        # The variant without a gate that has the most settings in common.
        full = max(gated.index[~gated], key=lambda variant: len(words & set(variant.split(","))))
        new, old = averages.loc[with_gate], averages.loc[full].reindex(averages.loc[with_gate].index)
        rows.append((100 * (new / old - 1)).assign(psnr_db=new.psnr_db - old.psnr_db))
    return pd.concat(rows).astype(float)


def trials(published: Path) -> str:
    """Return PSNR on val of each model with the recipe, and its changes by conf/trial/: means over six scenes."""
    studies = [study(published / f"tuning.{trial}")["tuning"].runs.assign(trial=trial) for trial in TRIALS[:-1]]
    others = pd.concat([only(published, f"tuning.{models}").runs for models in ("successors", "rivals")])
    others = others.assign(trial=others.variant.str.removeprefix("trial=").str.split(".").str[-1])
    runs = pd.concat([*studies, others])
    psnr = runs.pivot(index=["model", "trial"], columns="scene", values="psnr_db").mean(axis=1, skipna=False).unstack()
    table = psnr.sub(psnr.recipe, axis=0).assign(recipe=psnr.recipe)[TRIALS]
    columns = {name: Column(f"`{name}`", signed=name != "recipe") for name in TRIALS}
    return block(table.rename_axis("model"), **columns)


README: dict[str, Callable[[Path], str]] = {
    "cost": cost,
    "worth": worth,
    "dnerf400": lambda published: dnerf400(published, dict.fromkeys(["4dgs", "7dgs"], BEST | OF_PAPER)),
    "dnerf_signs": dnerf_signs,
}
_OF_RESULTS = (
    dnerf100,
    dnerf200,
    table1,
    suite_kinds,
    choices,
    lengths,
    ablation,
    trex400,
    on_demand,
)
RESULTS: dict[str, Callable[[Path], str]] = {
    "dnerf400": lambda published: dnerf400(
        published, dict.fromkeys(OF_TABLE_1, LAST | BEST | OF_PAPER) | {"auto": LAST}
    ),
    "dnerf400_costs": dnerf400_costs,
    "dnerf": lambda published: dnerf(published, dict.fromkeys(OF_TABLE_1, LAST | BEST | OF_PAPER)),
    **{write.__name__: write for write in _OF_RESULTS},
}

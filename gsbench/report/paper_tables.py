"""Make Tables 1 and 2 of the 7DGS paper and the table of its successors, beside measured runs (``make tables``).

Each table is a function from the tables of runs to a table of numbers, which is written as CSV; its sections show it.
A measured row is a model with its experiment and its recipe: the training settings that differ from the experiment's.
"""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from gsbench.errors import printable
from gsbench.measure.atomic import write_atomically
from gsbench.measure.record import Record
from gsbench.report import paper, stats
from gsbench.report.frame import TIMES, Results, iterations, of_one_machine, value_at, without
from gsbench.report.paper import departure
from gsbench.report.render import text
from gsbench.report.section import Column, Section

MODELS = ("3dgs", "4dgs", "6dgs", "7dgs_noagr", "7dgs")
SUCCESSORS = ("dgs", "ubs", "dbs", "freetime", "freetime_plus", "sharptime")
RIVALS = ("stg", "stg_full", "ex4dgs", "hexplane", "deformable", "deformable_narrow", "scgs")
OWED = {  # measured beside the rows of the paper's Table 2, by the method's name there
    "3dgs": "3DGS",
    "4dgs": "4DGS",
    "hexplane": "4DGaussians",
    "stg": "STG",
    "stg_full": "STG",
    "ex4dgs": "Ex4DGS",
    "7dgs": "7DGS",
}
BESIDE_7DGS = (*SUCCESSORS, "7dgs", "7dgs_noagr", "4dgs", *RIVALS)  # the measured rows of the table of successors
SUCCESSOR_SCENES = {name: list(paper.PROTOCOLS[name].scenes) for name in ("D-NeRF", "7DGS-PBR")}
TABLE_1 = ["psnr_db", "psnr_best_on_test_db", "ssim", "lpips_alex", "train_min", "fps", "gaussians"]
TABLE_2 = ["psnr_db", "psnr_best_on_test_db", "ssim", "lpips_alex"]
TABLE_SUCCESSORS = ["psnr_db", "psnr_best_on_test_db", "gaussians"]
RECIPE = ["order", "model", "experiment", "recipe"]  # what the runs of a row of Table 1 and 2 have in common
SUCCESSOR_RECIPE = ["order", "model", "recipe", "experiment", "protocol"]  # the same, for the table of successors
# Settings of a variant that belong to no recipe: they change what is measured, or a heading or a protocol names them.
MEASURING = ("iterations", "downscale", "eval_split", "best_on_test", "curve_points", "device")
IN_THE_PROTOCOL = (*MEASURING, "protocol", "resize", "batch_size")
NAMES = {"4dgs": "4DGS", "7dgs_noagr": "7DGS without AGR", "7dgs": "7DGS"}  # in the paper's tables
FILES = [f"{name}.{end}" for name in ("table1", "table2", "table_successors") for end in ("md", "csv")]

TEXT_1 = (
    "“paper”: Table 1 of the 7DGS paper (ICCV 2025). Its PSNR is the best on test seen during training, which leaks: "
    "like stands beside like in the column psnr_best_on_test (leaks). Its times are of a V100, so no difference is "
    "taken. It does not name the network of its LPIPS. ± is half the width of the 95 % interval over seeds. Minutes "
    "and FPS are of the machine of most runs; a time of another one, or of runs that shared a GPU, is left out."
)
TEXT_OTHER = (
    "Measured otherwise than in the paper, or on scenes rendered for gsbench in place of the paper's, so the paper's "
    "rows are not shown. Of each data set these are the runs nearest to the paper's protocol."
)
TEXT_SEEDS = "Finished seeds of each model at the paper's protocol. Valid intervals need three."
TEXT_2 = (
    "Rows of the paper's Table 2, and measured averages over all scenes of a data set at the paper's protocol; without "
    "all scenes, there is no average. Technicolor's images must be asked for from their authors. LPIPS of D-NeRF and "
    "7DGS-PBR is of a network that the paper does not name; of Technicolor it is AlexNet's."
)
SOURCES_2 = {
    "quoted": "quoted by the 7DGS paper (Table 2) from earlier publications",
    "retrained": "quoted by the 7DGS paper (Table 2) from the paper of Ex4DGS, whose authors trained the method again; "
    "STG's own paper has 33.6 dB",
    "reproduced": "reproduced by the 7DGS paper (Table 2) with the method's official code; 4DGS' and 7DGS' PSNR is "
    "the best on test seen during training, so it stands in the column that leaks too",
    "table 1": "the average of the 7DGS paper's Table 1 (its Table 2 lacks this data set), best on test",
}
TEXT_SUCCESSORS = (
    "Published rows beside measured rows, which may follow any protocol and name it: name, width of the images beside "
    "that of 7DGS' paper, iterations x batch. Measured rows have lego on val. ± is half the width of the 95 % interval "
    "over seeds."
)
SOURCES = {
    "dgs": "the authors of dGS (under review, 2026): black background, half resolution (D-NeRF: 400x400), lego on val. "
    "They test every 500 iterations and keep the best: treat as best on test",
    "ubs": "the authors of UBS (ICLR 2026): iteration 30,000, and the mean of the channels' PSNR, which is never lower",
    "ubs_others": "in the table of UBS' authors, which does not say the iteration: treat as best on test",
    "4dgaussians": "the authors of 4DGaussians (CVPR 2024): white background, 800x800, last iteration, lego on test",
    "deformable": "the authors of Deformable-3DGS (CVPR 2024): black background, 800x800, lego on val. Their code "
    "tests every 1,000 iterations and prints the best: treat as best on test",
    "ldg": "later code of Deformable-3DGS' authors (Lightweight-Deformable-GS): black background, 400x400; it does not "
    "say the iteration: treat as best on test",
    "scgs": "in the table of SC-GS' authors (CVPR 2024): black background, 400x400, best on test",
}
AT_THE_END = ("ubs", "4dgaussians")  # sources whose PSNR is of the last iteration
COMPUTED = "the mean is computed here from the published scenes"


def of_the_paper(results: Results, models: Sequence[str] = MODELS) -> pd.DataFrame:
    """Return the runs of some models on data of the 7DGS paper or on stand-ins, their recipe and how they depart.

    `departs` names the settings in which a run differs from the paper's protocol; "" if there are none. `pool` names
    runs with one protocol, which may share a table: (data of the paper, data, experiment, size of the images beside the
    paper's, filter, iterations).
    """
    runs = results.runs[results.runs.model.isin(models)]
    named = [str(record.protocol.get("paper_dataset")) for record in runs.record]
    runs = runs[pd.Series(named, runs.index, dtype=object).isin(list(paper.PROTOCOLS))]
    pools = [
        (
            str(r.protocol["paper_dataset"]),
            r.dataset,
            r.experiment,
            paper.relative_size(r),
            str(r.protocol.get("resize")),
            int(iterations(r)) if iterations(r) > 0 else 0,  # NaN: not recorded
        )
        for r in runs.record
    ]
    recipes = [without(variant, *MEASURING).split(",") for variant in runs.variant]
    # protocol=published belongs to no recipe: it only measures the best PSNR on test too.
    return runs.assign(
        order=runs.model.map(models.index),
        departs=runs.record.map(departure),
        recipe=[",".join(word for word in recipe if word != "protocol=published") for recipe in recipes],
        pool=pd.Series(pools, runs.index, dtype=object),
        size=[printable(r.protocol.get("resolution", "a size not recorded")) for r in runs.record],
    )


def table1(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the measured rows of Table 1 by scene and on average, with the paper's numbers and the differences.

    Args:
        runs: the runs of `of_the_paper`. Those at the paper's protocol come first; then other ones on
            the paper's data; then those on data that stand in for it.
    """
    numbers = [name + end for name in TABLE_1 for end in ("", " ±", " paper", " difference")]
    names = ["table", "dataset", "experiment", "scene", "scenes", "model", "recipe", "seeds", *numbers]
    rows = [_rows(kind, dataset, group) for kind, dataset, group in _tables(runs) if (group.status == "ok").any()]
    return pd.concat([pd.DataFrame(columns=names), *rows], ignore_index=True)[names]


def _tables(runs: pd.DataFrame) -> Iterator[tuple[str, str, pd.DataFrame]]:
    """Yield the kind, the data set and the runs of each table.

    "paper" has the runs at the paper's protocol. "other protocol" has runs of the most scenes of the paper's data; if
    several pools have as many, those nearest to its protocol. "other data" has the nearest on data that stand in.
    """
    for dataset in paper.PROTOCOLS:
        yield "paper", dataset, _at_paper(runs, dataset)
    nearest: dict[tuple[str, str], pd.DataFrame] = {}
    pools = [pool for _, pool in runs[runs.departs != ""].groupby("pool")]
    for pool in sorted(pools, key=_effort, reverse=True):  # equal ones stay in order of their names
        if (pool.status == "ok").any():
            nearest.setdefault(pool.pool.iloc[0][:2], pool)  # by (data of the paper, data)
    for kind in ("other protocol", "other data"):
        for (paper_dataset, dataset), pool in nearest.items():
            if (kind == "other protocol") == (paper_dataset == dataset):
                yield kind, dataset, pool


def _at_paper(runs: pd.DataFrame, dataset: str) -> pd.DataFrame:
    """Return the runs on a data set at the paper's protocol."""
    return runs[(runs.departs == "") & (runs.dataset == dataset)]


def _effort(runs: pd.DataFrame) -> tuple[int, int]:
    """Return the number of scenes of the paper's data; and the pixels of the largest image times the iterations."""
    sizes = [size.split("x") for size in runs["size"] if re.fullmatch(r"[0-9]{1,6}x[0-9]{1,6}", size)]
    pixels = max((int(width) * int(height) for width, height in sizes), default=0)
    of_paper, dataset, *_, iterations = runs.pool.iloc[0]
    scenes = runs[runs.status == "ok"].scene.nunique() if dataset == of_paper else 0
    return scenes, iterations * pixels


def _rows(kind: str, dataset: str, runs: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of one table: by scene, and on average over the scenes that all models finished.

    Averages of different models are then over the same scenes. They are of the recipe that has the most rows; of equal
    ones the first by name, and that without changes before all.
    """
    ok = _once(of_one_machine(runs))
    scenes = list(paper.PROTOCOLS[dataset].scenes) if kind == "paper" else sorted(set(runs.scene))
    averaged = {scene: [scene] for scene in scenes}  # the scenes of each row
    groups = [(scene, ok[ok.scene == scene]) for scene in scenes]
    rows = ok.drop_duplicates(["scene", *RECIPE])
    main = rows.groupby("recipe").size().idxmax() if len(rows) else ""
    averaged_runs = ok[ok.recipe == main]
    models = rows[rows.recipe == main].groupby("scene").size()  # their number on each scene
    covered = [scene for scene in scenes if models.get(scene) == len(averaged_runs[RECIPE].drop_duplicates())]
    if runs.scene.nunique() > 1 and covered:
        averaged[paper.AVERAGE] = covered
        groups.append((paper.AVERAGE, averaged_runs[averaged_runs.scene.isin(covered)]))
    tables = [stats.means(group, RECIPE, TABLE_1).assign(scene=name) for name, group in groups if len(group)]
    table = pd.concat(tables, ignore_index=True).assign(table=kind, dataset=dataset)
    numbers = [
        paper.average(dataset if kind == "paper" else "", averaged[scene], model)
        for scene, model in zip(table.scene, table.model, strict=True)
    ]
    of_paper = pd.DataFrame(numbers, columns=TABLE_1, dtype=float)
    of_paper["psnr_best_on_test_db"] = of_paper.psnr_db  # the paper's PSNR is the best on test
    difference = (table[TABLE_1] - of_paper).drop(columns=TIMES, errors="ignore")  # its times are of a V100
    return table.join(of_paper.add_suffix(" paper")).join(difference.add_suffix(" difference"))


def _once(runs: pd.DataFrame, by: Sequence[str] = RECIPE) -> pd.DataFrame:
    """Return one finished run for each seed of a row: the one that also has the best PSNR on test, if there is one."""
    ok = runs[runs.status == "ok"]
    ok = ok.loc[ok.psnr_best_on_test_db.notna().sort_values(kind="stable").index]  # those that have it are last
    return ok.drop_duplicates(["scene", *by, "seed"], keep="last")


def table2(results: Results) -> pd.DataFrame:
    """Return the paper's averages over each of its data sets, and below each those of the same method measured here.

    A measured average is over all scenes. A model of `OWED` without one has a row that says how many it has finished.
    """
    runs = of_the_paper(results, [*dict.fromkeys((*MODELS, *OWED))])
    tables = [_beside(_quoted(dataset), _measured(runs, dataset)) for dataset in paper.PROTOCOLS]
    names = ["dataset", "method", "source", "recipe", "seeds", *(name + end for name in TABLE_2 for end in ("", " ±"))]
    return pd.concat(tables, ignore_index=True).reindex(columns=names)


def _measured(runs: pd.DataFrame, dataset: str) -> pd.DataFrame:
    """Return the measured rows of Table 2 for a data set, those of `OWED` also without numbers."""
    scenes, runs = paper.PROTOCOLS[dataset].scenes, _at_paper(runs, dataset)
    finished = runs[runs.status == "ok"]
    rows = pd.DataFrame({"model": [], "experiment": []}, dtype=object)
    if len(finished):
        rows = stats.means(_once(of_one_machine(finished)), RECIPE, TABLE_2)
        rows = rows[rows.scenes == len(scenes)]
    rows = rows.assign(source="measured: " + rows.model + ", experiment " + rows.experiment)
    lacking = [model for model in OWED if model not in set(rows.model)]
    counts = [finished[finished.model == model].scene.nunique() for model in lacking]
    reasons = [
        f"not measured: {model}, {count} of {len(scenes)} scenes" for model, count in zip(lacking, counts, strict=True)
    ]
    rows = pd.concat([rows, pd.DataFrame({"model": lacking, "source": reasons})], ignore_index=True)
    return rows.assign(dataset=dataset, method=[(OWED | NAMES).get(model, model) for model in rows.model])


def _beside(quoted: pd.DataFrame, measured: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of both; a measured row follows the quoted ones of its method."""
    rows = pd.concat([quoted, measured], ignore_index=True)
    methods = [*dict.fromkeys(rows.method)]
    return rows.sort_values("method", key=lambda names: names.map(methods.index), kind="stable", ignore_index=True)


def _quoted(dataset: str) -> pd.DataFrame:
    """Return the rows of the paper's Table 2, or the averages of its Table 1 where Table 2 lacks a data set."""
    rows = paper.read_table("paper_table2.csv")
    rows = rows[rows.dataset == dataset].rename(columns={"lpips": "lpips_alex"})
    if rows.empty:
        rows = paper.table1().loc[(dataset, paper.AVERAGE)].loc[list(paper.MODELS)]
        rows = rows.rename(columns={"lpips": "lpips_alex"}).assign(source="table 1", dataset=dataset)
        rows["method"] = [NAMES[model] for model in rows.index]
    leaks = rows.psnr_db.where((rows.source == "table 1") | rows.method.isin(list(NAMES.values())))
    return rows.assign(source="paper, " + rows.source, recipe="", psnr_best_on_test_db=leaks)


def successors(results: Results) -> pd.DataFrame:
    """Return the published and the measured numbers of 7DGS' successors and rivals, by scene and as means over scenes.

    A measured row has finished all scenes of its mean. Trials, which are measured on val where the data set has a test
    split, are left out.
    """
    runs = _successor_runs(results.finished.runs)
    rows: list[dict[str, Any]] = []
    for dataset, every in SUCCESSOR_SCENES.items():
        # One scene, all scenes, and all but lego, which some published means leave out.
        but_lego = [[scene for scene in every if scene != "lego"]] if "lego" in every else []
        for scenes in [*([scene] for scene in every), every, *but_lego]:
            name = scenes[0] if len(scenes) == 1 else paper.AVERAGE
            place = {"dataset": dataset, "scene": name}
            rows += [row | place for row in _published(dataset, name, scenes)]
            of_scenes = runs[(runs.dataset == dataset) & runs.scene.isin(scenes)]
            if of_scenes.empty:
                continue
            measured = stats.means(of_scenes, SUCCESSOR_RECIPE, TABLE_SUCCESSORS)
            for row in measured[measured.scenes == len(scenes)].to_dict("records"):
                rows.append(row | place | {"row": "measured", "method": row["model"]})
    named = ["dataset", "scene", "scenes", "row", "method", "recipe", "experiment", "protocol", "seeds"]
    return pd.DataFrame(rows, columns=[*named, *(name + end for name in TABLE_SUCCESSORS for end in ("", " ±"))])


def _successor_runs(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the runs of 7DGS and its successors on the split that the paper evaluates, one for each seed of a row."""
    runs = runs[runs.model.isin(BESIDE_7DGS) & runs.dataset.isin(list(SUCCESSOR_SCENES))]
    is_comparable = [
        r.scene in SUCCESSOR_SCENES[r.dataset]
        and r.protocol.get("eval_split") == paper.PROTOCOLS[r.dataset].split(r.scene)
        for r in runs.record
    ]
    runs = runs[pd.Series(is_comparable, runs.index, dtype=bool)]
    runs = runs.assign(
        order=runs.model.map(BESIDE_7DGS.index),
        protocol=runs.record.map(_protocol),
        recipe=[without(variant, *IN_THE_PROTOCOL) for variant in runs.variant],
    )
    return of_one_machine(_once(runs, SUCCESSOR_RECIPE)) if len(runs) else runs


def published(dataset: str) -> pd.DataFrame:
    """Return the published numbers of a data set, "D-NeRF" or "7DGS-PBR": a row for each method and scene or mean."""
    table = paper.read_table("successors.csv")
    table = table.assign(gaussians=1000 * table.thousand_gaussians)[table.dataset == dataset]
    return table.drop(columns="thousand_gaussians")


def _published(dataset: str, scene: str, scenes: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield the published rows of a scene, or of the mean over some scenes.

    A mean over other scenes than those asked for is replaced by that of the method's rows of the scenes asked for.
    """
    table = published(dataset)
    every = SUCCESSOR_SCENES[dataset]
    for row in table[table.scene == scene].to_dict("records"):
        is_unknown = pd.isna(row["scenes"])  # then it is shown as the mean over all
        note = "; the number of scenes of this mean is not stated" if is_unknown else ""
        is_of_scenes = row["scenes"] == len(scenes) or (is_unknown and len(scenes) == len(every))
        if scene == paper.AVERAGE and not is_of_scenes:
            if row["scenes"] != len(every):
                continue
            rows = table[(table.method == row["method"]) & (table.source == row["source"]) & table.scene.isin(scenes)]
            row |= {
                "psnr_db": rows.psnr_db.mean(),
                "gaussians": rows.gaussians.mean(skipna=False),
                "scenes": len(scenes),
            }
            note = f"; {COMPUTED}"
        names = {"row": "published", "method": row["method"], "recipe": "", "experiment": "", "scenes": row["scenes"]}
        key = "psnr_db" if row["source"] in AT_THE_END else "psnr_best_on_test_db"
        yield names | {"protocol": SOURCES[row["source"]] + note, key: row["psnr_db"], "gaussians": row["gaussians"]}


def _protocol(record: Record) -> str:
    """Return the protocol of a run as a text such as "gsbench, 1/2, 30,000 x 4".

    Parts that the name of a protocol does not imply are added: another filter, rounding or background.
    """
    settings = record.protocol
    batch = value_at(record, "provenance.config.train.batch_size")
    steps = iterations(record)
    name = settings.get("name", "protocol not recorded")
    implied = {"resize": "pillow" if name == "dgs2026" else None, "quantise": name == "dgs2026", "background": "black"}
    more = [f"{key} {settings.get(key)}" for key, value in implied.items() if settings.get(key) != value]
    length = f"{steps if steps > 0 else 0:,.0f} x {batch}"
    return printable(", ".join([name, paper.relative_size(record), length, *more]))


def sections(results: Results) -> dict[str, list[Section]]:
    """Return the sections of each table by the name of its file."""
    return {
        "table1": list(_sections1(of_the_paper(results))),
        "table2": list(_sections2(results)),
        "table_successors": list(_sections_of_successors(results)),
    }


def _sections1(runs: pd.DataFrame) -> Iterator[Section]:
    """Yield the tables of measured rows, each with the paper's row and the difference below it."""
    rows = table1(runs)
    for kind, dataset, group in _tables(runs):
        table = _with_paper(rows[(rows.table == kind) & (rows.dataset == dataset)])
        is_paper = kind == "paper"
        title = f"Table 1, {dataset}, at the paper's protocol" if is_paper else f"{kind.upper()}, {_heading(group)}"
        if len(table):
            yield Section(f"table1-{kind}-{dataset}", title, TEXT_1 if is_paper else TEXT_OTHER, table)
        if is_paper and len(group):
            yield Section(f"seeds-{dataset}", f"Seeds, {dataset}", TEXT_SEEDS, seeds(group, dataset))


def _with_paper(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows of Table 1 as lines: measured, and the paper's line and the difference below it, where they are."""
    several = rows.experiment.nunique() > 1
    label = [" ".join(filter(None, (r.model, r.recipe, r.experiment if several else ""))) for r in rows.itertuples()]
    averages = "average over " + rows.scenes.astype(str) + " scenes"
    rows = rows.assign(scene=rows.scene.where(rows.scenes == 1, averages))
    has_paper = rows["psnr_db paper"].notna()
    halves = [f"{name} ±" for name in TABLE_1]
    tables = [rows[["scene", *TABLE_1, *halves, "seeds"]].assign(model=label)]
    for end in ("paper", "difference"):
        lines = rows.loc[has_paper, [f"{name} {end}" for name in TABLE_1]].set_axis(TABLE_1, axis=1)
        tables.append(lines.assign(scene=rows.scene[has_paper], model=end))
    order = [name for column in TABLE_1 for name in (column, f"{column} ±")]
    table = pd.concat(tables).sort_index(kind="stable").reset_index(drop=True)  # lines of one row have its index
    return table[["scene", "model", *order, "seeds"]].astype(dict.fromkeys([*order, "seeds"], float))


def seeds(runs: pd.DataFrame, dataset: str) -> pd.DataFrame:
    """Count the finished seeds of each model (rows) on each scene (columns), with the recipe that has most."""
    scenes = list(paper.PROTOCOLS[dataset].scenes)
    by_recipe = runs[runs.status == "ok"].groupby(["model", "scene", "recipe"]).seed.nunique()
    counts = by_recipe.groupby(["model", "scene"]).max().unstack().reindex(index=list(MODELS), columns=scenes)
    return counts.fillna(0).astype(int).rename_axis(index="model", columns=None).reset_index()


def _heading(runs: pd.DataFrame) -> str:
    """Return a heading with the data set, the experiment, the image sizes and the training length of a pool."""
    _, dataset, experiment, _, resize, steps = runs.pool.iloc[0]
    resized = f" by {resize}" if resize != "None" else ""
    sizes = ", ".join(sorted(set(runs["size"])))
    return printable(f"{dataset}: experiment {experiment}, {sizes}{resized}, {steps:,} iterations")


def _sections2(results: Results) -> Iterator[Section]:
    rows = table2(results)
    for dataset, protocol in paper.PROTOCOLS.items():
        lines = rows[rows.dataset == dataset].drop(columns="dataset").reset_index(drop=True)
        notes = tuple(f"{name}: {text}" for name, text in SOURCES_2.items() if f"paper, {name}" in set(lines.source))
        title = f"Table 2, {dataset}, average over {len(protocol.scenes)} scenes, at the paper's protocol"
        yield Section(f"table2-{dataset}", title, TEXT_2, lines, notes=notes)


def _sections_of_successors(results: Results) -> Iterator[Section]:
    rows = successors(results)
    for dataset in SUCCESSOR_SCENES:
        lines = rows[rows.dataset == dataset].drop(columns="dataset").reset_index(drop=True)
        sources = list(lines.protocol[lines.row == "published"].unique())
        lines["protocol"] = [f"published ({sources.index(p) + 1})" if p in sources else p for p in lines.protocol]
        notes = tuple(f"({i}) {source}" for i, source in enumerate(sources, 1))
        columns = {"scenes": Column("scenes", 0), "seeds": Column("seeds", 0)}
        table, title = lines.drop(columns="row"), f"Successors and rivals of 7DGS, {dataset}"
        yield Section(f"successors-{dataset}", title, TEXT_SUCCESSORS, table, columns, notes=notes)


def numbers(results: Results) -> dict[str, pd.DataFrame]:
    """Return the tables by the names of their files."""
    return {"table1": table1(of_the_paper(results)), "table2": table2(results), "table_successors": successors(results)}


def write(results: Results, folder: Path) -> None:
    """Write the three tables as Markdown and CSV to a folder."""
    for name, shown in sections(results).items():
        write_atomically(folder / f"{name}.md", text.markdown(shown).encode())
    for name, table in numbers(results).items():
        write_atomically(folder / f"{name}.csv", text.csv(table).encode())

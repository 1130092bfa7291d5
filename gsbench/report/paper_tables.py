"""Make Tables 1 and 2 of the 7DGS paper and the table of its successors, beside measured runs (``make tables``).

Each table is a function from the tables of runs to a table of numbers, which is written as CSV; its sections show it.
A measured row is a model with its experiment and its recipe: the training settings that differ from the experiment's.
"""

import re
from collections.abc import Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import pandas as pd

from gsbench.errors import printable
from gsbench.measure.atomic import write_atomically
from gsbench.measure.record import Record
from gsbench.report import frame, paper, stats
from gsbench.report.frame import Results, of_one_machine, without
from gsbench.report.paper_protocol import departure
from gsbench.report.render import text
from gsbench.report.section import Column, Section

MODELS = ("3dgs", "4dgs", "6dgs", "7dgs_noagr", "7dgs")
SUCCESSORS = ("dgs", "ubs", "dbs", "freetime", "7dgs", "7dgs_noagr", "4dgs")
SUCCESSOR_SCENES = {name: list(paper.PROTOCOLS[name].scenes) for name in ("D-NeRF", "7DGS-PBR")}
TABLE_1 = ["psnr_db", "psnr_best_on_test_db", "ssim", "lpips_alex", "train_min", "fps", "gaussians"]
TABLE_2 = ["psnr_db", "psnr_best_on_test_db", "ssim", "lpips_alex"]
TABLE_SUCCESSORS = ["psnr_db", "psnr_best_on_test_db", "gaussians"]
RECIPE = ["order", "model", "experiment", "recipe"]  # what the runs of a row of Table 1 and 2 have in common
# Settings of a variant that belong to no recipe: they change what is measured, or a heading or a protocol names them.
MEASURING = ("iterations", "downscale", "eval_split", "best_on_test", "curve_points")
IN_THE_PROTOCOL = (*MEASURING, "protocol", "resize", "batch_size")
SEEDS = 3  # the fewest seeds for a valid interval
NAMES = {"4dgs": "4DGS", "7dgs_noagr": "7DGS without AGR", "7dgs": "7DGS"}  # in the paper's tables
FILES = [f"{name}.{end}" for name in ("table1", "table2", "table_successors") for end in ("md", "csv")]

TEXT_1 = (
    "“paper”: Table 1 of the 7DGS paper (ICCV 2025). Its PSNR is the best on test seen during training, which leaks: "
    "like stands beside like in the column psnr_best_on_test (leaks). Its times are of a V100, so no difference is "
    "taken. It does not name the network of its LPIPS. ± is half the width of the 95 % interval over seeds."
)
TEXT_2 = (
    "Rows of the paper's Table 2, and measured averages over all scenes of a data set at the paper's protocol. LPIPS "
    "of D-NeRF and 7DGS-PBR is of a network that the paper does not name; of Technicolor it is AlexNet's."
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
    "Published rows beside measured rows, which may follow any protocol and name it: name, downscale, iterations x "
    "batch. Measured rows have lego on val. ± is half the width of the 95 % interval over seeds."
)
SOURCES = {
    "dgs": "the authors of dGS (under review, 2026): black background, half resolution (D-NeRF: 400x400), lego on val. "
    "They test every 500 iterations and keep the best: treat as best on test",
    "ubs": "the authors of UBS (ICLR 2026): iteration 30,000, and the mean of the channels' PSNR, which is never lower",
    "ubs_others": "in the table of UBS' authors, which does not say the iteration: treat as best on test",
}
COMPUTED = "the mean is computed here from the published scenes"


def of_the_paper(results: Results) -> pd.DataFrame:
    """Return the runs on data of the 7DGS paper or on stand-ins for them, with their recipe and how they depart.

    `departs` names the settings in which a run differs from the paper's protocol; "" if there are none. `pool` names
    runs with one protocol, which may share a table: (data of the paper, data, experiment, downscaling, filter,
    iterations).
    """
    runs = results.runs[results.runs.model.isin(MODELS)]
    named = [str(record.protocol.get("paper_dataset")) for record in runs.record]
    runs = runs[pd.Series(named, runs.index, dtype=object).isin(list(paper.PROTOCOLS))]
    pools = [(str(r.protocol["paper_dataset"]), r.dataset, r.experiment, str(r.protocol.get("downscale")),
              str(r.protocol.get("resize")), int(frame.iterations(r)) if frame.iterations(r) > 0 else 0)
             for r in runs.record]  # fmt: skip
    recipes = runs.variant.map(lambda variant: without(variant, *MEASURING))
    return runs.assign(
        order=runs.model.map(MODELS.index), departs=runs.record.map(departure),
        recipe=[",".join(word for word in recipe.split(",") if word != "protocol=published") for recipe in recipes],
        pool=pd.Series(pools, runs.index, dtype=object), size=[_size(record) for record in runs.record],
    )  # fmt: skip


def table1(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the measured rows of Table 1 by scene and on average, with the paper's numbers and the differences.

    Args:
        runs: the runs of `of_the_paper`. Those at the paper's protocol come first; then those nearest to it; then those
            nearest to it on data that stand in for the paper's.
    """
    rows = [row for kind, dataset, of in _tables(runs) for row in _rows(kind, dataset, of)]
    numbers = [name + end for name in TABLE_1 for end in ("", " ±", " paper", " difference")]
    named = ["table", "dataset", "experiment", "scene", "scenes", "model", "recipe", "seeds"]
    return pd.DataFrame(rows, columns=[*named, *numbers])


def _tables(runs: pd.DataFrame) -> Iterator[tuple[str, str, pd.DataFrame]]:
    """Yield the kind, the data set and the runs of each table."""
    for dataset in paper.PROTOCOLS:
        yield "paper", dataset, runs[(runs.departs == "") & (runs.dataset == dataset)]
    nearest: dict[tuple[str, str], pd.DataFrame] = {}
    for pool, of in sorted(_pools(runs).items(), key=lambda item: (-_effort(item[1]), item[0])):
        if (of.status == "ok").any():
            nearest.setdefault(pool[:2], of)
    for kind in ("other protocol", "other data"):
        for (named, dataset), of in nearest.items():
            if (kind == "other protocol") == (named == dataset):
                yield kind, dataset, of


def _pools(runs: pd.DataFrame) -> dict[tuple[Any, ...], pd.DataFrame]:
    return dict(iter(runs[runs.departs != ""].groupby("pool")))


def _effort(runs: pd.DataFrame) -> int:
    """Return the pixels of the largest image times the iterations: the more, the nearer to the paper's protocol."""
    sizes = [size.split("x") for size in runs["size"] if re.fullmatch(r"[0-9]{1,6}x[0-9]{1,6}", size)]
    return int(runs.pool.iloc[0][-1]) * max((int(width) * int(height) for width, height in sizes), default=0)


def _size(record: Record) -> str:
    return printable(record.protocol.get("resolution", "a size not recorded"))


def _rows(kind: str, dataset: str, runs: pd.DataFrame) -> Iterator[dict[str, Any]]:
    """Yield the rows of one table: by scene, and on average over the scenes that all models finished."""
    ok = _once(of_one_machine(runs)) if len(runs) else runs
    protocol = paper.PROTOCOLS.get(dataset) if kind == "paper" else None
    scenes = list(protocol.scenes) if protocol else sorted(set(runs.scene))
    groups = [(scene, [scene], ok[ok.scene == scene]) for scene in scenes]
    plain = ok[ok.recipe == ""]
    finished = plain.drop_duplicates(["scene", *RECIPE]).groupby("scene").size()
    covered = [scene for scene in scenes if finished.get(scene) == len(plain[RECIPE].drop_duplicates())]
    if runs.scene.nunique() > 1 and covered:
        groups.append((paper.AVERAGE, covered, plain[plain.scene.isin(covered)]))
    for name, of_scenes, of in groups:
        for row in stats.means(of, RECIPE, TABLE_1).to_dict("records") if len(of) else ():
            numbers = paper.average(dataset, of_scenes, row["model"]) if kind == "paper" else None
            values = {} if numbers is None else numbers.to_dict() | {"psnr_best_on_test_db": numbers.psnr_db}
            row |= {f"{column} paper": value for column, value in values.items()}
            row |= {f"{c} difference": row[c] - value for c, value in values.items() if c not in frame.TIMES}
            yield row | {"table": kind, "dataset": dataset, "scene": name}


def _once(runs: pd.DataFrame) -> pd.DataFrame:
    """Return one finished run for each seed of a row: the one that also has the best PSNR on test, if there is one."""
    ok = runs[runs.status == "ok"]
    ok = ok.loc[ok.psnr_best_on_test_db.notna().sort_values(kind="stable").index]
    return ok.drop_duplicates(["scene", *RECIPE, "seed"], keep="last")


def table2(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the paper's averages over each of its data sets, and those of models that finished all its scenes."""
    rows: list[dict[str, Any]] = []
    for dataset, protocol in paper.PROTOCOLS.items():
        methods = [(m.method, m.source, m) for m in paper.table2().get(dataset, [])]
        averages = [(NAMES[model], "table 1", paper.paper_row(dataset, paper.AVERAGE, model)) for model in paper.MODELS]
        for method, source, of in methods or averages:
            if of is not None:
                leaks = of.psnr if source == "table 1" or method in NAMES.values() else None
                values = zip(TABLE_2, (of.psnr, leaks, of.ssim, of.lpips), strict=True)
                rows.append(
                    {"dataset": dataset, "method": method, "source": f"paper, {source}", "recipe": ""} | dict(values)
                )
        at_paper = runs[(runs.departs == "") & (runs.dataset == dataset)]
        ok = _once(of_one_machine(at_paper)) if len(at_paper) else at_paper
        ok = ok[ok.scene.isin(protocol.scenes)]
        if len(ok):
            means = stats.means(ok, RECIPE, TABLE_2)
            for row in means[means.scenes == len(protocol.scenes)].to_dict("records"):
                named = {"method": row["model"], "source": f"measured, experiment {row['experiment']}"}
                rows.append({"dataset": dataset, **named} | row)
    numbers = [name + end for name in TABLE_2 for end in ("", " ±")]
    return pd.DataFrame(rows, columns=["dataset", "method", "source", "recipe", "seeds", *numbers])


def successors(results: Results) -> pd.DataFrame:
    """Return the published and the measured numbers of 7DGS' successors, by scene and as means over scenes.

    A measured row has finished all scenes of its mean. Trials, which are measured on val where the data set has a test
    split, are left out.
    """
    runs = results.finished.runs
    runs = runs[runs.model.isin(SUCCESSORS) & runs.dataset.isin(list(SUCCESSOR_SCENES))]
    kept = [r.scene in SUCCESSOR_SCENES[r.dataset] and r.protocol.get("eval_split") == _split(r) for r in runs.record]
    runs = runs[pd.Series(kept, runs.index, dtype=bool)]
    runs = runs.assign(
        order=runs.model.map(SUCCESSORS.index), protocol=runs.record.map(_protocol),
        recipe=[without(variant, *IN_THE_PROTOCOL) for variant in runs.variant],
    )  # fmt: skip
    by = ["order", "model", "recipe", "experiment", "protocol"]
    runs = runs.loc[runs.psnr_best_on_test_db.notna().sort_values(kind="stable").index]
    runs = of_one_machine(runs.drop_duplicates(["scene", *by, "seed"], keep="last")) if len(runs) else runs
    rows: list[dict[str, Any]] = []
    for dataset, scenes in SUCCESSOR_SCENES.items():
        means = [[scene for scene in scenes if scene != "lego"]] if "lego" in scenes else []
        for of_scenes in (*([scene] for scene in scenes), scenes, *means):
            name = of_scenes[0] if len(of_scenes) == 1 else paper.AVERAGE
            place = {"dataset": dataset, "scene": name}
            rows += [row | place for row in _published(dataset, name, of_scenes)]
            of = runs[(runs.dataset == dataset) & runs.scene.isin(of_scenes)]
            measured = stats.means(of, by, TABLE_SUCCESSORS) if len(of) else pd.DataFrame({"scenes": []})
            for row in measured[measured.scenes == len(of_scenes)].to_dict("records"):
                rows.append(row | place | {"row": "measured", "method": row["model"]})
    named = ["dataset", "scene", "scenes", "row", "method", "recipe", "experiment", "protocol", "seeds"]
    return pd.DataFrame(rows, columns=[*named, *(name + end for name in TABLE_SUCCESSORS for end in ("", " ±"))])


def published(dataset: str) -> pd.DataFrame:
    """Return the published numbers of a data set, "D-NeRF" or "7DGS-PBR": a row for each method and scene or mean."""
    with resources.files(__package__).joinpath("successors.csv").open() as file:
        table = pd.read_csv(file)
    table = table.assign(gaussians=1000 * table.thousand_gaussians)[table.dataset == dataset]
    return table.drop(columns="thousand_gaussians")


def _published(dataset: str, scene: str, scenes: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield the published rows of a scene, or of the mean over some scenes."""
    table = published(dataset)
    every = SUCCESSOR_SCENES[dataset]
    for of in table[table.scene == scene].to_dict("records"):
        note = "" if of["scenes"] == of["scenes"] else "; the number of scenes of this mean is not stated"
        if scene == paper.AVERAGE and of["scenes"] != len(scenes) and not (note and len(scenes) == len(every)):
            if of["scenes"] != len(every):
                continue
            rows = table[(table.method == of["method"]) & (table.source == of["source"]) & table.scene.isin(scenes)]
            of |= {
                "psnr_db": rows.psnr_db.mean(),
                "gaussians": rows.gaussians.mean(skipna=False),
                "scenes": len(scenes),
            }
            note = f"; {COMPUTED}"
        row = {"row": "published", "method": of["method"], "recipe": "", "experiment": "", "scenes": of["scenes"]}
        key = "psnr_db" if of["source"] == "ubs" else "psnr_best_on_test_db"
        yield row | {"protocol": SOURCES[of["source"]] + note, key: of["psnr_db"], "gaussians": of["gaussians"]}


def _split(record: Record) -> str:
    """Return the split on which a scene of a data set is tested: "val" for D-NeRF's lego, else "test"."""
    splits = paper.PROTOCOLS[record.dataset].splits
    return splits.get(record.scene, splits["*"])


def _protocol(record: Record) -> str:
    """Return the protocol of a run as a text such as "gsbench, 2, 30,000 x 4".

    Parts that the name of a protocol does not imply are added: another filter, rounding or background.
    """
    of = record.protocol
    train = record.provenance.config.get("train")
    batch = train.get("batch_size") if isinstance(train, dict) else None
    steps = frame.iterations(record)
    name = of.get("name", "protocol not recorded")
    implied = {"resize": "pillow" if name == "dgs2026" else None, "quantise": name == "dgs2026", "background": "black"}
    more = [f"{key} {of.get(key)}" for key, value in implied.items() if of.get(key) != value]
    return printable(", ".join([f"{name}, {of.get('downscale')}, {steps if steps > 0 else 0:,.0f} x {batch}", *more]))


def sections(results: Results) -> dict[str, list[Section]]:
    """Return the sections of each table by the name of its file."""
    runs = of_the_paper(results)
    return {
        "table1": list(_sections1(runs)),
        "table2": list(_sections2(runs)),
        "table_successors": list(_newer(results)),
    }


def _sections1(runs: pd.DataFrame) -> Iterator[Section]:
    rows = table1(runs)
    shown = [_heading(of) for kind, _, of in _tables(runs) if kind != "paper"]
    for kind, dataset, of in _tables(runs):
        lines = []
        for row in rows[(rows.table == kind) & (rows.dataset == dataset)].to_dict("records"):
            label = " ".join(
                filter(None, [row["model"], row["recipe"], row["experiment"] * (of.experiment.nunique() > 1)])
            )
            scene = row["scene"] if row["scenes"] == 1 else f"average over {row['scenes']} scenes"
            beside = (
                {"paper": " paper", "difference": " difference"} if row["psnr_db paper"] == row["psnr_db paper"] else {}
            )
            for name, end in {label: "", **beside}.items():
                lines.append({"scene": scene, "model": name} | {column: row[column + end] for column in TABLE_1})
            lines[-1 - len(beside)] |= {f"{column} ±": row[f"{column} ±"] for column in TABLE_1} | {
                "seeds": row["seeds"]
            }
        order = [name for column in TABLE_1 for name in (column, f"{column} ±")]
        table = pd.DataFrame(lines, columns=["scene", "model", *order, "seeds"])
        title = f"Table 1, {dataset}, at the paper's protocol" if kind == "paper" else f"{kind.upper()}, {_heading(of)}"
        yield Section(f"table1-{kind}-{dataset}", title, TEXT_1 if kind == "paper" else "", table,
                      notes=tuple(_notes(kind, dataset, of, runs, shown)))  # fmt: skip


def _notes(kind: str, dataset: str, of: pd.DataFrame, runs: pd.DataFrame, shown: list[str]) -> Iterator[str]:
    """Yield what is missing, which runs are in no table, how runs depart, and which failed."""
    if kind == "paper":
        yield missing(dataset, of)
        left = [pool for pool in _pools(runs).items() if pool[0][0] == dataset and _heading(pool[1]) not in shown]
        if left:
            named = [f"{len(pool)} run{'s' * (len(pool) > 1)} of {_heading(pool)}" for _, pool in left]
            more = f"; and {len(left) - 5} more" if len(left) > 5 else ""
            yield f"Left out, at another protocol than the paper's: {'; '.join(named[:5])}{more}."
    elif kind == "other data":
        yield "Rendered for this project in place of the paper's scenes; the paper's rows are not shown."
    else:
        what = sorted({word for departs in of.departs for word in departs.split(", ")})
        yield f"Measured otherwise than in the paper (in {', '.join(what)}), so the paper's rows are not shown."
    machines = of[of.status == "ok"].machine.value_counts()
    if len(machines) > 1:
        timed = of_one_machine(of).timed_on.iloc[0]
        named = [f"{name} ({n} run{'s' * (n > 1)})" for name, n in machines.items() if name != timed]
        yield printable(f"train min and FPS are of one machine, {timed}. Left out: {'; '.join(sorted(named))}.")
    for run in of[of.status != "ok"].itertuples():
        yield printable(f"{run.scene}, {run.model} {run.recipe} seed {run.seed} {run.status}: {run.reason}")


def _heading(runs: pd.DataFrame) -> str:
    """Return a heading with the data set, the experiment, the image sizes and the training length of a pool."""
    _, dataset, experiment, _, resize, steps = runs.pool.iloc[0]
    resized = f" by {resize}" if resize != "None" else ""
    sizes = ", ".join(sorted(set(runs["size"])))
    return printable(f"{dataset}: experiment {experiment}, {sizes}{resized}, {steps:,} iterations")


def missing(dataset: str, runs: pd.DataFrame) -> str:
    """Return a line that lists which scenes, models and seeds of a data set still have to be run at its protocol."""
    plain = runs[(runs.status == "ok") & (runs.recipe == "")]
    scenes = paper.PROTOCOLS[dataset].scenes
    seeds = {(s, m): plain.seed[(plain.scene == s) & (plain.model == m)].nunique() for s in scenes for m in MODELS}
    none = [s for s in scenes if not any(seeds[s, m] for m in MODELS)]
    if len(none) == len(scenes):
        return f"Missing: all {len(scenes)} scenes ({', '.join(scenes)})."
    parts = [f"all models of {', '.join(none)}"] if none else []
    for s in scenes:
        lacking = [m for m in MODELS if not seeds[s, m]]
        parts += [f"{s}: {', '.join(lacking)}"] if lacking and s not in none else []
    few = [f"{s} {m} has {n}" for (s, m), n in seeds.items() if 0 < n < SEEDS]
    parts += [f"seeds, of {SEEDS}: {', '.join(few)}"] if few else []
    return f"Missing: {'; '.join(parts)}." if parts else f"Complete: all scenes and models, {SEEDS} seeds or more."


def _sections2(runs: pd.DataFrame) -> Iterator[Section]:
    rows = table2(runs)
    for dataset, protocol in paper.PROTOCOLS.items():
        of = rows[rows.dataset == dataset].drop(columns="dataset").reset_index(drop=True)
        sources = {source.removeprefix("paper, "): source for source in of.source if source.startswith("paper, ")}
        notes = [missing(dataset, runs[(runs.departs == "") & (runs.dataset == dataset)])]
        notes += [f"{name}: {SOURCES_2[name]}" for name in sources]
        title = f"Table 2, {dataset}, average over {len(protocol.scenes)} scenes, at the paper's protocol"
        yield Section(f"table2-{dataset}", title, TEXT_2, of, notes=tuple(notes))


def _newer(results: Results) -> Iterator[Section]:
    rows = successors(results)
    for dataset in SUCCESSOR_SCENES:
        of = rows[rows.dataset == dataset].drop(columns="dataset").reset_index(drop=True)
        sources = list(of.protocol[of.row == "published"].unique())
        of["protocol"] = [f"published ({sources.index(p) + 1})" if p in sources else p for p in of.protocol]
        measured = set(of.method[of.row == "measured"])
        lacking = [model for model in SUCCESSORS if model not in measured]
        notes = [f"({i}) {source}" for i, source in enumerate(sources, 1)]
        notes += [f"No finished run here of {', '.join(lacking)}."] if lacking else []
        columns = {"scenes": Column("scenes", 0), "seeds": Column("seeds", 0)}
        table, title = of.drop(columns="row"), f"Successors of 7DGS, {dataset}"
        yield Section(f"successors-{dataset}", title, TEXT_SUCCESSORS, table, columns, notes=tuple(notes))


def numbers(results: Results) -> dict[str, pd.DataFrame]:
    """Return the tables by the names of their files."""
    runs = of_the_paper(results)
    return {"table1": table1(runs), "table2": table2(runs), "table_successors": successors(results)}


def write(results: Results, folder: Path) -> None:
    """Write the three tables as Markdown and CSV to a folder."""
    for name, of in sections(results).items():
        write_atomically(folder / f"{name}.md", text.markdown(of).encode())
    for name, table in numbers(results).items():
        write_atomically(folder / f"{name}.csv", text.csv(table).encode())

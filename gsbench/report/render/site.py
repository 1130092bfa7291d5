"""Write a merged set of runs as pages that need no server: tables, all sections, and each model on a scene.

`index.html` has the result table of every experiment and protocol, whose rows a reader sorts and filters. A folder for
each of them has the page of all sections, and a page for each pair of a scene and a model below it.
"""

import hashlib
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

import pandas as pd

from gsbench.measure.atomic import write_atomically
from gsbench.report import contributors
from gsbench.report.columns import VIEWS
from gsbench.report.frame import Results, title_of
from gsbench.report.render import page
from gsbench.report.section import SECTIONS, Section
from gsbench.report.sections.experiment import table

INDEX, SCRIPTS = "index.html", "charts.js"
OF_PAIR = ("curves", "on_demand", "stages", "flicker", "gallery", "protocol", "runs")  # sections of a pair's page


def write(results: Results, folder: Path) -> list[Path]:
    """Write the pages of a merged set to a folder, and return their paths, ``index.html`` first.

    Files of other names in the folder stay, such as those of its git repository.
    """
    name, about = folder.resolve().name, contributors.sections(results)
    pages = {Path(INDEX): page.rendered(name, _tables(results), results.faults, about, scripts_at=SCRIPTS)}
    for chapter in results.chapters():
        pages |= dict(_of_chapter(results, chapter))
    write_atomically(folder / SCRIPTS, page.library().encode())
    for path, text in pages.items():
        write_atomically(folder / path, text.encode())
    return [folder / path for path in pages]


def _tables(results: Results) -> list[page.Article]:
    """Return the result table of each experiment, whose models lead to their pages."""
    articles = []
    for chapter in results.chapters():
        key, section = _key(chapter), table(chapter, [])
        models = section.table.model.str.partition(" ")[0]  # without variant
        is_pair = section.table.scene.isin(set(chapter.runs.scene))  # not an average
        addresses = [
            quote(_file(key, scene, model).as_posix()) if has_page else ""
            for scene, model, has_page in zip(section.table.scene, models, is_pair, strict=True)
        ]
        linked = replace(section, table=section.table.assign(**{"model link": addresses}))
        links = [("Figures and statistics", quote(f"{key}/{INDEX}"))]
        articles.append(page.article(key, chapter, [linked], links=links))
    return articles


def _of_chapter(results: Results, chapter: Results) -> Iterator[tuple[Path, str]]:
    """Yield the page of an experiment, and one of each model on a scene with the times of its own machine."""
    key, title = _key(chapter), title_of(chapter.runs)
    whole = page.article("all", chapter)
    links = [("All tables", f"../{INDEX}")]
    experiment = chapter.runs.record.iloc[0].experiment
    yield Path(key, INDEX), page.rendered(experiment, [whole], links=links, scripts_at=f"../{SCRIPTS}")
    for (scene, model), runs in chapter.runs.groupby(["scene", "model"]):
        (pair,) = results.of(results.runs.index.isin(runs.index)).chapters()
        shown = [table(pair, []), _views(pair), *(SECTIONS[name].build(pair, pd.DataFrame()) for name in OF_PAIR)]
        about = page.article("pair", pair, [section for section in shown if section is not None])
        links = [("All tables", f"../../{INDEX}"), (title, f"../{INDEX}")]
        text = page.rendered(f"{model} on {scene}", [about], links=links, scripts_at=f"../../{SCRIPTS}")
        yield _file(key, scene, model), text


def _key(chapter: Results) -> str:
    """Return the name of the folder of an experiment, which stays when other contributors join."""
    run = chapter.runs.iloc[0]
    digest = hashlib.sha256(f"{run.experiment}\n{run.dataset}".encode()).hexdigest()
    return f"{run.record.experiment}-{digest[:8]}"


def _file(key: str, scene: str, model: str) -> Path:
    """Return the path of the page about a model on a scene."""
    return Path(key, re.sub(r"[^\w.+-]+", "_", scene), f"{model}.html")


def _views(pair: Results) -> Section | None:
    """Return the scores of each view, averaged over the runs of each contributor."""
    runs = pair.runs[["label", "contributor"]]
    views = pair.views.merge(runs, left_on="run", right_index=True).dropna(axis=1, how="all")
    scores = [name for name in VIEWS if name in views]
    if views.empty or not scores:
        return None
    means = views.groupby(["view", "label", "contributor"])[scores].mean().reset_index()
    means = means if pair.runs.label.nunique() > 1 else means.drop(columns="label")
    return Section("views", "Every view", "Mean over seeds.", means, folded=True, sortable=True)

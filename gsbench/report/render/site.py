"""Write a merged set of runs as pages that need no server: `index.html` with the result tables, a page an experiment.

A reader sorts and filters the rows of the result tables. The page of an experiment and protocol has all sections.
"""

import hashlib
from pathlib import Path
from urllib.parse import quote

from gsbench.measure.atomic import write_atomically
from gsbench.report import contributors
from gsbench.report.frame import Results
from gsbench.report.render import page
from gsbench.report.sections.experiment import table

INDEX = "index.html"


def write(results: Results, folder: Path) -> list[Path]:
    """Write the pages of a merged set to a folder, and return their paths, ``index.html`` first.

    Files of other names in the folder stay, such as those of its git repository.
    """
    articles, pages = [], {}
    for i, chapter in enumerate(results.chapters()):
        run = chapter.runs.iloc[0]
        digest = hashlib.sha256(f"{run.experiment}\n{run.dataset}".encode()).hexdigest()
        name = f"{run.record.experiment}-{digest[:8]}.html"  # stays when other contributors join
        links = [("Figures and statistics", quote(name))]
        articles.append(page.article(f"g{i}", chapter, [table(chapter, [])], links=links))
        whole = page.article("all", chapter)
        pages[name] = page.rendered(run.record.experiment, [whole], links=[("All tables", INDEX)])
    about = contributors.sections(results)
    pages = {INDEX: page.rendered(folder.resolve().name, articles, results.faults, about)} | pages
    for name, text in pages.items():
        write_atomically(folder / name, text.encode())
    return [folder / name for name in pages]

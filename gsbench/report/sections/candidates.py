"""What each candidate of `effects.compare` reached on val and cost, and how often it was chosen."""

import pandas as pd

from gsbench.report.frame import Results
from gsbench.report.section import COLUMNS, Column, Section, section


@section()
def candidates(chapter: Results, tests: pd.DataFrame) -> Section | None:
    """Make the table: a row for each candidate on a scene."""
    runs = chapter.finished.runs
    rows = [
        {
            "scene": run.scene,
            "model": run.label,
            "candidate": candidate.name,
            "psnr_val_db": candidate.psnr_val,
            "train_s": candidate.seconds if run.is_timed else None,
            "frame_ms": candidate.frame_ms if run.is_timed else None,
            "chosen": candidate.name == comparison.chosen,
            "why": candidate.reason,
        }
        for run in runs[runs.on_demand].itertuples()
        if (comparison := run.record.on_demand.comparison)
        for candidate in comparison.candidates
    ]
    if not rows:
        return None
    numbers = ["psnr_val_db", "train_s", "frame_ms"]
    groups = (
        pd.DataFrame(rows).astype(dict.fromkeys(numbers, float)).groupby(["scene", "model", "candidate"], sort=False)
    )
    table = groups[numbers].mean().join(groups.chosen.sum()).assign(seeds=groups.size(), why=groups.why.first())
    text = (
        "Seconds are those until candidates are compared; the chosen one is then trained to the end. Means over seeds; "
        "“chosen”: by how many of them."
    )
    columns = {name: COLUMNS[name] for name in numbers} | {
        "chosen": Column("chosen", 0),
        "why": Column("why it cannot be chosen"),
    }
    return Section("candidates", "The choice of model=auto on val", text, table.reset_index(), columns)

"""What flickers in films of one camera: the error of pixels that stand still, and one row of pixels over time."""

import pandas as pd

from gsbench.report import stats
from gsbench.report.frame import Results
from gsbench.report.section import Section, section
from gsbench.report.sections.gallery import images

PICTURE = "flicker.png"
NAMES = ["flicker", "static_drift", "drift_3d", "drift_3d_px", "flicker_truth"]


@section()
def flicker(chapter: Results, tests: pd.DataFrame) -> Section | None:
    """Make the table and the pictures of the first seed of each model; None if no scene has a film."""
    runs = chapter.finished.runs
    runs = runs[runs.flicker.notna()]
    if runs.empty:
        return None
    names = [name for name in NAMES if runs[name].notna().any()]
    scenes = [stats.means(of_scene, ["label"], names).assign(scene=scene) for scene, of_scene in runs.groupby("scene")]
    table = pd.concat(scenes, ignore_index=True).rename(columns={"label": "model"})
    order = ["scene", "model", *(name + end for name in names for end in ("", " ±")), "seeds"]
    first = runs.sort_values("seed", kind="stable").drop_duplicates(["scene", "label"]).sort_values(["scene", "label"])
    files = [(f"{run.scene}, {run.label}", run.path.parent / PICTURE) for run in first.itertuples()]
    text = (
        "Mean change, in steps of 8 bits, of the error of pixels that stand still: from frame to frame (flicker), and "
        "from the first third of the film to the last (static drift). A constant error has 0 in both. “3D drift” is "
        "how far the Gaussians seen in these pixels move over the film, in units of the scene and in pixels. “Flicker "
        "of the truth” is the change of the ground truth itself, sensor noise, which no model can follow. A picture "
        "has one row of pixels of the render, the ground truth and the error; time runs down."
    )
    return Section("flicker", "What flickers", text, table.reindex(columns=order), images=tuple(images(files)))

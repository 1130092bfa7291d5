"""Give every model one colour and one marker, the same in all figures, for the light and the dark theme.

The first hues come from the palette of Okabe and Ito, which readers with common colour deficiencies can distinguish.
The others were chosen one after the other, each as far as possible from those before it (CIEDE2000), in both themes.
Each hue is darkened for a white page and lightened for a black page, so that its contrast is at least 4.5:1. The
markers distinguish the models without colour.
"""

from collections.abc import Iterable

MODELS = ("3dgs", "4dgs", "6dgs", "7dgs", "7dgs_noagr", "3dgs_agr", "4dgs_agr", "6dgs_agr", "auto",
          "7dgs_nodir", "7dgs_nodir_agr", "dgs", "freetime", "dbs", "ubs", "ndgs")  # fmt: skip
PAGE = {  # by variable of the page's style sheet: the colour of the light and of the dark theme
    "ink": ("#1b1d21", "#eceef1"), "muted": ("#565b63", "#a9afb8"), "line": ("#dfe1e4", "#33373d"),
    "paper": ("#ffffff", "#141619"), "raised": ("#f6f7f8", "#1d2024"), "focus": ("#0069a8", "#5cbcf2"),
}  # fmt: skip
OF_MODELS = (
    ("#5c6066", "#b9bec6"), ("#0069a8", "#5cbcf2"), ("#00734f", "#3ccb9f"), ("#b34700", "#ff9454"),
    ("#9c3d82", "#eb9fd0"), ("#1f4291", "#cbcefe"), ("#0b4f51", "#4fe6ea"), ("#0d3e10", "#93ff8e"),
    ("#55450a", "#f9ce00"), ("#7b43ca", "#ac76f0"), ("#900f04", "#ffc4b4"), ("#6a7616", "#9daf19"),
    ("#be2142", "#fd536a"), ("#3c7880", "#63b2bb"), ("#916814", "#d79b15"), ("#078221", "#1cbf38"),
    ("#343718", "#ddf43b"),
)  # fmt: skip
# Stages of a training step are shades of one hue, stages that occur once a run have two other hues, the rest is grey.
OF_STAGES = (
    ("#22476b", "#c9e0f5"), ("#3b6b96", "#a3c6e6"), ("#6390b8", "#7ba8cf"), ("#8fb2d1", "#588ab3"),
    ("#b7cfe3", "#3f6e95"), ("#d7e4ef", "#2c5373"), ("#b9770e", "#f0b35a"), ("#efc06a", "#96651f"),
    ("#7a4a00", "#f7dcae"), ("#9a9da3", "#7d828b"),
)  # fmt: skip
SETS = ("model-3", "model-4", "model-2", "model-1", "model-0", "line")  # effect sets, like models with these effects
DEGREES = ("stage-3", "stage-2", "stage-1", "stage-0")  # a higher degree of harmonics has more contrast
THEMES = (
    PAGE
    | {f"model-{i}": pair for i, pair in enumerate(OF_MODELS)}
    | {f"stage-{i}": pair for i, pair in enumerate(OF_STAGES)}
)
# SVG paths in a square from -1 to 1, for the legend of a page and for charts.
MARKERS = (
    "M0,-1L1,.8L-1,.8Z",
    "M-.8,-.8H.8V.8H-.8Z",
    "M-.5,-.87H.5L1,0L.5,.87H-.5L-1,0Z",
    "M-1,0A1,1,0,1,1,1,0A1,1,0,1,1,-1,0Z",
    "M0,-1L1,0L0,1L-1,0Z",
    "M0,1L1,-.8L-1,-.8Z",
    "M-.35,-1H.35V-.35H1V.35H.35V1H-.35V.35H-1V-.35H-.35Z",
    "M-1,-.6L-.6,-1L0,-.4L.6,-1L1,-.6L.4,0L1,.6L.6,1L0,.4L-.6,1L-1,.6L-.4,0Z",
    "M-1,0L.8,-1V1Z",
    "M1,0L-.8,-1V1Z",
    "M0,-1L.95,-.3L.6,.8H-.6L-.95,-.3Z",
    "M0,-1L.6,0L0,1L-.6,0Z",
    "M0,-1L.25,-.3L1,-.3L.4,.15L.6,.9L0,.45L-.6,.9L-.4,.15L-1,-.3L-.25,-.3Z",
    "M0,-1L.87,-.5V.5L0,1L-.87,.5V-.5Z",
    "M-.4,-1H.4L1,-.4V.4L.4,1H-.4L-1,.4V-.4Z",
    "M0,-1L.3,-.3L1,0L.3,.3L0,1L-.3,.3L-1,0L-.3,-.3Z",
    "M-1,-.5H1V.5H-1Z",
)


def styles(models: Iterable[str]) -> dict[str, int]:
    """Return the number of the colour and the marker of each model.

    A model in MODELS always has the same. Others get the remaining ones in alphabetical order.
    """
    names = sorted(set(models))
    free = [*range(len(MODELS), len(OF_MODELS)), *(i for i, model in enumerate(MODELS) if model not in names)]
    others = [name for name in names if name not in MODELS]
    chosen = {name: MODELS.index(name) for name in names if name in MODELS}
    return chosen | {name: free[i % len(free)] if free else i % len(OF_MODELS) for i, name in enumerate(others)}

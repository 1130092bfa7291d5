"""Give every model one colour and one marker, the same in all figures, for the light and the dark theme.

The first hues come from the palette of Okabe and Ito, which readers with common colour deficiencies can distinguish.
The others were chosen one after the other, each as far as possible from those before it (CIEDE2000), in both themes.
Each hue is darkened for a white page and lightened for a black page, so that its contrast is at least 4.5:1. The
markers distinguish the models without colour.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Marker = str | tuple[int, Literal[1], int]  # of matplotlib; a star as (number of points, 1, angle)
MODELS = ("3dgs", "4dgs", "6dgs", "7dgs", "7dgs_noagr", "3dgs_agr", "4dgs_agr", "6dgs_agr", "auto",
          "7dgs_nodir", "7dgs_nodir_agr", "dgs", "freetime", "dbs", "ubs", "ndgs")  # fmt: skip
EFFECT_SET_LIKE = {  # a Gaussian has the colour of the model with the same effects
    "refined": "7dgs",
    "conditioned": "7dgs_noagr",
    "time": "6dgs",
    "direction": "4dgs",
    "static": "3dgs",
}
PAGE_LIGHT = {"ink": "#1b1d21", "muted": "#565b63", "line": "#dfe1e4", "paper": "#ffffff", "raised": "#f6f7f8",
              "focus": "#0069a8"}  # fmt: skip
PAGE_DARK = {"ink": "#eceef1", "muted": "#a9afb8", "line": "#33373d", "paper": "#141619", "raised": "#1d2024",
             "focus": "#5cbcf2"}  # fmt: skip
LIGHT = ("#5c6066", "#0069a8", "#00734f", "#b34700", "#9c3d82", "#1f4291", "#0b4f51", "#0d3e10", "#55450a",
         "#7b43ca", "#900f04", "#6a7616", "#be2142", "#3c7880", "#916814", "#078221", "#343718")  # fmt: skip
DARK = ("#b9bec6", "#5cbcf2", "#3ccb9f", "#ff9454", "#eb9fd0", "#cbcefe", "#4fe6ea", "#93ff8e", "#f9ce00",
        "#ac76f0", "#ffc4b4", "#9daf19", "#fd536a", "#63b2bb", "#d79b15", "#1cbf38", "#ddf43b")  # fmt: skip
MARKERS: tuple[Marker, ...] = (
    "^",
    "s",
    "h",
    "o",
    "D",
    "v",
    "P",
    "X",
    "<",
    ">",
    "p",
    "d",
    "*",
    "H",
    "8",
    (4, 1, 0),
    (6, 1, 0),
)
# Stages of a training step are shades of one hue, stages that occur once a run have two other hues, the rest is grey.
STAGES_LIGHT = ("#22476b", "#3b6b96", "#6390b8", "#8fb2d1", "#b7cfe3", "#d7e4ef", "#b9770e", "#efc06a", "#7a4a00",
                "#9a9da3")  # fmt: skip
STAGES_DARK = ("#c9e0f5", "#a3c6e6", "#7ba8cf", "#588ab3", "#3f6e95", "#2c5373", "#f0b35a", "#96651f", "#f7dcae",
               "#7d828b")  # fmt: skip


def variables(page: dict[str, str], models: Sequence[str], stages: Sequence[str]) -> dict[str, str]:
    """Return the colours of a theme by the names of their CSS variables: the page, the models, the stages."""
    named = {f"model-{i}": colour for i, colour in enumerate(models)}
    return page | named | {f"stage-{i}": colour for i, colour in enumerate(stages)}


@dataclass(frozen=True)
class Style:
    """The style of a model in figures: the number of its colour and its matplotlib marker."""

    colour: int
    marker: Marker


def styles(models: list[str]) -> dict[str, Style]:
    """Return the style (colour and marker) of each model.

    A model in MODELS always has the same style. Other models get the remaining styles in alphabetical order.
    """
    others = sorted(set(models) - set(MODELS))
    spare = range(len(MODELS), len(LIGHT))
    free = [*spare, *(i for i, m in enumerate(MODELS) if m not in models)]
    chosen = {m: MODELS.index(m) for m in models if m in MODELS}
    chosen |= {m: free[i % len(free)] if free else i % len(LIGHT) for i, m in enumerate(others)}
    return {m: Style(i, MARKERS[i]) for m, i in chosen.items()}

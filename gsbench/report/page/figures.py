"""Write the figures of the HTML report as PDF and SVG files for a paper, in the colours of the light theme."""

import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.artist import Artist
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Text

from gsbench.measure.atomic import write_atomically
from gsbench.report.page.content import Swatch
from gsbench.report.page.palette import LIGHT, PAGE_LIGHT, STAGES_LIGHT, Style, variables
from gsbench.report.page.svg import RC, Panel, variable

LONGEST = 120  # letters of a file name
COLOURS = variables(PAGE_LIGHT, LIGHT, STAGES_LIGHT)  # by variable of the style sheet
PARTS = ("color", "facecolor", "edgecolor", "markerfacecolor", "markeredgecolor")  # properties that hold colours
FILES: dict[Any, Any] = {**RC, "pdf.fonttype": 42}  # TrueType, which publishers ask for
LegendEntry = tuple[str, Style] | Swatch


def file_name(*words: str) -> str:
    """Return a file name without ending from different words; other characters than a-z and 0-9 become dashes."""
    return "-".join(re.findall("[a-z0-9]+", " ".join(dict.fromkeys(words)).lower()))[:LONGEST]


def write(panel: Panel, legend: Sequence[LegendEntry], stem: Path) -> list[Path]:
    """Write a figure with its legend to `stem`.pdf and `stem`.svg, and return these paths.

    Args:
        panel: the figure, whose placeholder colours are replaced.
        legend: the entries of its section; those that the figure does not show are left out.
        stem: the path of the files without their ending.
    """
    paths = []
    with mpl.rc_context(FILES):
        panel.figure.draw_without_rendering()  # makes the tick labels, which have colours too
        shown = _recolour(panel.figure)
        entries = [entry for entry in legend if _variable_of(entry) in shown]
        if entries:
            panel.figure.legend(handles=list(map(_handle, entries)), loc="upper center", bbox_to_anchor=(0.5, 0.0),
                                ncols=3, frameon=False, labelcolor=COLOURS["ink"])  # fmt: skip
        for kind, dates in (("pdf", {"CreationDate": None}), ("svg", {"Date": None})):
            file = io.BytesIO()
            panel.figure.savefig(file, format=kind, bbox_inches="tight", metadata=dates)
            paths.append(stem.with_name(f"{stem.name}.{kind}"))
            write_atomically(paths[-1], file.getvalue())
    return paths


def _recolour(figure: Figure) -> set[str]:
    """Replace the placeholder colours of a figure, and return the variables of the style sheet that they stand for."""
    found = set()
    boxes = [box for text in figure.findobj(Text) if (box := text.get_bbox_patch())]
    for artist in (*figure.findobj(), *boxes):
        for part in PARTS:
            colours = _colours(artist, part)
            named = [variable(to_hex(colour[:3])) for colour in colours]
            if any(named):
                found |= set(filter(None, named))
                new = [(COLOURS[name], c[3]) if name else tuple(c) for name, c in zip(named, colours, strict=True)]
                getattr(artist, f"set_{part}")(new if len(new) > 1 else new[0])
    return found


def _colours(artist: Artist, part: str) -> list[Any]:
    """Return the colours that a property of an artist holds, as (red, green, blue, alpha) from 0 to 1."""
    get = getattr(artist, f"get_{part}", None)
    return [] if get is None else list(mpl.colors.to_rgba_array(get()))


def _variable_of(entry: LegendEntry) -> str:
    return entry.variable if isinstance(entry, Swatch) else f"model-{entry[1].colour}"


def _handle(entry: LegendEntry) -> Artist:
    """Return the marker of a model, or the box of a swatch, with its name."""
    colour = COLOURS[_variable_of(entry)]
    if isinstance(entry, Swatch):
        return Patch(facecolor=colour, edgecolor="none", label=_plain(entry.name))
    name, style = entry
    return Line2D([], [], linestyle="none", marker=style.marker, color=colour, label=_plain(name))


def _plain(name: str) -> str:
    """Escape a dollar sign, which starts a formula, and a leading underscore, which hides an entry."""
    text = name.replace("$", r"\$")
    return f"\u200b{text}" if text.startswith("_") else text

"""Draw matplotlib figures as inline SVG with real text, whose colours are variables of the page's style sheet.

Figures are drawn in placeholder colours, which are then replaced by CSS variables. Therefore one drawing serves both
the light and the dark theme.
"""

import io
import re
from dataclasses import dataclass, field
from html import escape
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.markers import MarkerStyle
from matplotlib.ticker import NullLocator

from gsbench.report.page.palette import Marker

WIDTH = 360  # width of a figure in pixels, which fits on the screen of a phone
FONT = 11.5
INK, MUTED, LINE, PAPER = "#010101", "#010102", "#010103", "#010104"
VARIABLES = {INK: "ink", MUTED: "muted", LINE: "line", PAPER: "paper"}
LANE = 17  # height in pixels of a row below the axes
HIT = 9  # radius in pixels of the area that reacts to the pointer
RC: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "gsbench",  # the same numbers give the same file
    "font.size": FONT,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": MUTED,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.spines.left": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": LINE,
    "grid.linewidth": 0.8,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "ytick.major.size": 0,
    "xtick.major.size": 3,
    "xtick.minor.size": 0,
}


def model_colour(index: int) -> str:
    """Return a placeholder for the colour of a model; a variable of the style sheet later replaces it."""
    return f"#0200{index:02x}"


def stage_colour(index: int) -> str:
    """Return a placeholder for the colour of a training stage; a variable of the style sheet later replaces it."""
    return f"#0300{index:02x}"


@dataclass
class Panel:
    """A figure with one pair of axes; `hits` are the points that show their run's name at the mouse pointer."""

    height: int
    left: int = 38  # pixels left of the axes
    top: int = 24
    lanes: int = 0  # number of rows below the axes, for events
    width: int = WIDTH
    hits: list[tuple[float, float, int, int]] = field(default_factory=list)  # data coordinates, run, model's colour
    figure: Figure = field(init=False)
    axes: Axes = field(init=False)
    below: Axes = field(init=False)  # the axes of these rows, with the same x axis

    def __post_init__(self) -> None:
        with mpl.rc_context(RC):
            self.figure = Figure(figsize=(self.width / 72, self.height / 72), dpi=72, facecolor="none")
            bottom = 38 + LANE * self.lanes
            self.axes = self._axes(bottom, self.height - bottom - self.top)
            if self.lanes:
                self.axes.tick_params(bottom=False, labelbottom=False)
                self.below = self._axes(38, LANE * self.lanes, sharex=self.axes)
                self.below.set_ylim(0, self.lanes)
                self.below.yaxis.set_major_locator(NullLocator())
            FigureCanvasSVG(self.figure)

    def _axes(self, bottom: float, height: float, **options: Any) -> Axes:
        """Add axes to the figure, at a distance in pixels from its bottom and with a height in pixels."""
        across = self.left / self.width, (self.width - self.left - 12) / self.width
        box = across[0], bottom / self.height, across[1], height / self.height
        return self.figure.add_axes(box, facecolor="none", **options)

    def labels(self, x: str, y: str = "") -> None:
        """Write both axis labels horizontally: x below the axes at the right, y above the axes at the left."""
        style: dict[str, Any] = {"color": MUTED, "fontsize": FONT}
        self.figure.text(1 - 12 / self.width, 2 / self.height, x, ha="right", va="bottom", **style)
        self.figure.text(0, 1 - 2 / self.height, y, ha="left", va="top", **style)

    def above(self, row: float, left: str, right: str) -> None:
        """Write one text at each end of a row; a box in the background colour keeps lines from crossing the texts."""
        box = {"facecolor": PAPER, "edgecolor": "none", "pad": 1.0}
        for x, side, text, colour in ((0, "left", left, INK), (1, "right", right, MUTED)):
            place: dict[str, Any] = {"xycoords": ("axes fraction", "data"), "va": "top", "ha": side}
            self.axes.annotate(text, (x, row), color=colour, fontsize=FONT, bbox=box, **place)

    def svg(self, name: str, alt: str) -> str:
        """Return the figure as an SVG element.

        Args:
            name: a prefix for the element's ids, so that figures on one page do not share ids.
            alt: a description of the figure for readers who cannot see it.
        """
        circles = "".join(self._hit(*hit) for hit in self.hits)
        raw = io.StringIO()
        with mpl.rc_context(RC):
            self.figure.savefig(raw, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
        text = raw.getvalue()
        body = text[text.index(">", text.index("<svg")) + 1 : text.rindex("</svg>")]
        body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.S)
        body = re.sub(r'(id="|url\(#|href="#)', rf"\g<1>{name}-", body)
        body = re.sub(r"font: (?:(bold) )?([\d.]+)px [^;\"]*", _font, body)
        body = re.sub(r"#0[123]0[0-9a-f]{3}", lambda found: f"var(--{variable(found[0]) or 'ink'})", body)
        body = re.sub(r">\s+<", "><", body)
        view = f'viewBox="0 0 {self.width} {self.height}"'
        return f'<svg {view} role="img" aria-label="{escape(alt, quote=True)}">{body}{circles}</svg>'

    def _hit(self, x: float, y: float, run: int, colour: int) -> str:
        across, up = self.axes.transData.transform((x, y))
        place = f'cx="{across:.1f}" cy="{self.height - up:.1f}" r="{HIT}"'
        return f'<circle class="hit" data-run="{run}" data-colour="{colour}" {place}/>'


def _font(found: re.Match[str]) -> str:
    """Reduce a CSS font description to size and weight, so that the text has the font family of the page."""
    return f"font-size: {found[2]}px" + ("; font-weight: 600" if found[1] else "")


def variable(colour: str) -> str:
    """Return the name of the CSS variable that replaces a placeholder colour; empty for any other colour."""
    kind = {"#0200": "model-", "#0300": "stage-"}.get(colour[:5])
    return f"{kind}{int(colour[5:], 16)}" if kind else VARIABLES.get(colour, "")


def marker(shape: Marker, colour: int) -> str:
    """Return the marker of a model as a small SVG element for legends."""
    style = MarkerStyle(shape)
    path = style.get_path().transformed(style.get_transform())
    outlines: Any = path.to_polygons(closed_only=False)
    reach = max(abs(v) for line in outlines for v in (*line[:, 0], *line[:, 1]))
    drawn = "".join("M" + "L".join(f"{5 * x / reach:.2f} {-5 * y / reach:.2f}" for x, y in line) for line in outlines)
    path_of = f'<path d="{drawn}Z" fill="var(--model-{colour})"/>'
    return f'<svg class="marker" viewBox="-6 -6 12 12" aria-hidden="true">{path_of}</svg>'

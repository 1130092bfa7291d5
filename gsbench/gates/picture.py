"""Draw three panels: a rendered image, what each Gaussian depends on, and the rendering cost of each pixel.

In the second panel, the colour of a Gaussian shows whether it depends on time, direction and AGR (the neural
refinement). In the third, the time that each Gaussian takes in a frame (constants of gsbench.gates.gate) is
alpha-composited like a colour. Bright yellow is a Gaussian with AGR and the full SH degree, black is no cost.
"""

import numpy as np
import torch
from torch import Tensor

from gsbench.gates.gate import cost_of, most_cost
from gsbench.gates.messages import EFFECT_SETS
from gsbench.measure.images import GAP, Pixels, in_a_row, inferno, reduced, to_bytes, write_text
from gsbench.models import CameraTime, GaussianModel
from gsbench.models.effect_sets import NAMES
from gsbench.models.render import rasterize_slice, render_slices
from gsbench.scenes import Camera

# RGB colours, as on the report's page: a Gaussian has the colour of the model with the same effects.
COLOURS = {
    "refined": (0xB3, 0x47, 0x00),
    "conditioned": (0x9C, 0x3D, 0x82),
    "static": (0x5C, 0x60, 0x66),
}
LEAST_WIDTH, MOST_WIDTH = 300, 640  # pixels; smaller images are enlarged by an integer factor, larger ones reduced
LINE, BASELINE, MARGIN = 22, 16, 6  # pixels: height of a line of text, its baseline from above, space before a text


@torch.no_grad()
def draw(
    model: GaussianModel, camera: Camera, time: float | None, background: Tensor, antialias: bool = False
) -> Pixels:
    """Draw three panels with a legend: an image, what each Gaussian depends on, and the rendering cost of each pixel.

    Args:
        model: the model; if its Gaussians were not simplified, all have the same colour in the second panel.
        camera: the camera of the image.
        time: the time of the image in [0, 1]; None if the scene has no time.
        background: the background colour of the first panel, [3].
        antialias: whether to scale opacities by the 2D filter of Mip-Splatting, as in `gsbench.raster.rasterize`.

    Returns:
        The picture, uint8 RGB.

    Raises:
        InputError: the model depends on time and `time` is None.
    """
    gaussians = model.slice(CameraTime.of(camera, time))
    most = most_cost(model)  # nanoseconds
    white, black = torch.ones_like(background), torch.zeros_like(background)  # black: no cost
    replaced = ((effect_set_colors(model), white), (cost_colors(model, most), black))  # colours [N, 3] and background
    outputs = [
        render_slices(model, gaussians, [camera], background, antialias),
        *(
            rasterize_slice(gaussians._replace(colors=colors), camera, behind, model.backend, antialias)
            for colors, behind in replaced
        ),
    ]
    panels = [to_bytes(output.image[0].cpu().numpy()) for output in outputs]
    panels[2] = inferno(panels[2][..., 0] / 255)  # grey levels as colours from black to yellow
    return _arrange(panels, model.count_by_effects(), most)


def effect_set_colors(model: GaussianModel) -> Tensor:
    """Return a colour for each Gaussian that shows if it depends on time, direction and AGR (a network), [N, 3]."""
    return torch.tensor([COLOURS[name] for name in NAMES]).to(model.splats["means"])[kinds_of(model)] / 255


def cost_colors(model: GaussianModel, most: float) -> Tensor:
    """Return the rendering time of each Gaussian as a grey level, [N, 3]; 1 stands for `most` nanoseconds."""
    return (cost_of(model).to(model.splats["means"]) / most)[:, None].repeat(1, 3)


def kinds_of(model: GaussianModel) -> Tensor:
    """Return what each Gaussian depends on (AGR's network, time or direction, nothing) as an index into NAMES, [N]."""
    counts = [model.count_by_effects()[name] for name in NAMES]
    return torch.arange(len(NAMES)).repeat_interleave(torch.tensor(counts))


def _arrange(panels: list[Pixels], counts: dict[str, int], most: float) -> Pixels:
    """Put the three panels side by side, with titles above and the legend of the Gaussians' colours below.

    `counts` has the number of Gaussians by effect set, and `most` is the cost in nanoseconds of the brightest pixels.
    """
    factor = max(1, -(-LEAST_WIDTH // panels[0].shape[1]))  # rounded up
    panels = [reduced(panel, MOST_WIDTH) for panel in panels]
    row, step = in_a_row(panels, factor), panels[0].shape[1] * factor + GAP  # pixels from panel to panel
    titles, legend = (np.full((LINE, row.shape[1], 3), 255, np.uint8) for _ in range(2))
    by_set = f"{sum(counts.values()):,} Gaussians by effect set"
    for i, title in enumerate(("image", by_set, f"cost of what a pixel shows, 0 to {most:.0f} ns")):
        write_text(titles, title, i * step + MARGIN, BASELINE)
    for i, (name, count) in enumerate((name, count) for name, count in counts.items() if count):
        left = i * step + MARGIN
        legend[5:17, left : left + 12] = COLOURS[name]  # a square of 12 pixels
        write_text(legend, f"{EFFECT_SETS[name]}: {count:,}", left + 12 + MARGIN, BASELINE)
    return np.concatenate([titles, row, legend])

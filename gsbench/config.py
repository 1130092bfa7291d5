"""The schema of conf/: what every key is, of which type, with which default. A typo in a YAML fails, naming the key.

Needs no torch, so that `--help` and a wrong key answer at once.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING

HERE = Path(__file__).parent
CONF = HERE / "conf" if (HERE / "conf").is_dir() else HERE.parent / "conf"  # in a wheel, else in a checkout


@dataclass
class DataConfig:
    """A data set: where it lies and how it is looked at. An experiment sets these."""

    dataset: str = MISSING  # what tables call it
    paper_dataset: str | None = None  # whose rows of the paper's tables stand beside it
    root: str = MISSING  # folder that holds a folder for each scene; pkg://module for data inside a package
    published: str = ""  # where to get it, for the error message when it is missing
    scenes: list[str] = field(default_factory=list)  # what scene=all means
    background: str = "black"  # or white: what images are composited over and renders stand before
    modulation: float = 0.5  # the initial lambda_t and lambda_d of 7DGS here (7DGS, implementation details)
    initial_points: int = 100_000  # drawn at random where the data set gives none ..
    initial_half_width: float = 1.3  # .. in the cube [-w, w]^3


@dataclass
class SceneConfig:
    """One scene of the data set."""

    name: str = MISSING
    downscale: int = 1  # integer factor by which images are made smaller, area filter
    eval_split: str = "test"  # or val, where the test split is wrong (D-NeRF lego)


@dataclass
class LearningRate:
    """A learning rate over the run, log-linear from start to end."""

    start: float = MISSING
    end: float | None = None  # None: constant
    per_extent: bool = False  # times the scene's extent
    per_run: bool = False  # times sqrt(recipe_iterations / iterations): a shorter run goes as far in fewer steps


@dataclass
class ModelConfig:
    """A model: what every model has, and the options of this one's constructor."""

    name: str = MISSING
    published_with_agr: bool = False  # whether AGR is part of the method as its authors describe it
    agr: bool = "${.published_with_agr}"  # type: ignore[assignment]  # an interpolation, typed when resolved
    agr_octaves: int = 4  # K of AGR's time encoding; the paper's 10 learn every frame by heart: docs/tuning.md
    sh_degree: int = 3
    min_opacity: float = 0.005  # pruned below
    lr: dict[str, LearningRate] = field(default_factory=dict)  # by parameter
    options: dict[str, Any] = field(default_factory=dict)  # keyword arguments of the model's class


@dataclass
class DensifyConfig:
    """Adaptive density control (3DGS, section 5.2). Steps but `every` are those of a run of `recipe_iterations`."""

    start: int = 500
    stop: int = 15_000
    every: int = 100  # steps of any run: what was cloned needs them to part before it is judged again
    reset_every: int = 3_000  # opacity reset
    grad_threshold: float = 2e-4  # mean gradient of a 2D mean, in units of half the picture
    clone_below: float = 0.01  # clone where the largest scale is below this part of the extent, split above
    prune_above: float = 0.1  # prune where it is above this part, after the first opacity reset


@dataclass
class TrainConfig:
    """The recipe. Steps are stated for a run of `recipe_iterations` and scale with the run's length."""

    iterations: int = 30_000
    recipe_iterations: int = 30_000
    batch_size: int = 4  # views a step
    ssim_weight: float = 0.2  # loss = (1 - w) L1 + w (1 - SSIM)
    sh_every: int = 1_000  # one degree of spherical harmonics more
    refine_from: int = 3_000  # AGR acts and learns
    modulation_from: int = 15_000  # lambda_t and lambda_d learn
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    curve_points: int = 20  # measurements on the val split along the run
    checkpoint_minutes: float = 2.0  # a killed run loses at most this much


@dataclass
class RasterConfig:
    """How pictures are drawn."""

    backend: str = "auto"
    antialias: bool = False


@dataclass
class ProtocolConfig:
    """How results are measured; written into every record."""

    name: str = MISSING
    quantise: bool = False  # measure 8-bit pictures
    best_on_test: bool = False  # also the best test PSNR seen in training, as published code reports: it leaks
    lpips_alex: str | None = None  # trunk weights; None: $TORCH_HOME/hub/checkpoints
    lpips_vgg: str | None = None
    renders: int = 30  # timed, at least
    pictures: int = 3  # test views saved as render | ground truth | error


@dataclass
class Config:
    """One run, or one run for each scene of the data set."""

    experiment: str = MISSING  # the name of the +exp= file, a folder in results/
    seed: int = 0
    device: str = "cpu"
    agr: bool = "${model.agr}"  # type: ignore[assignment]
    optim: str = "adam"  # or sparse_adam: what no view of a batch drew does not move
    results: str = "results"
    resume: bool = True  # go on from a checkpoint and keep finished runs of the same config; false: start over
    model: ModelConfig = field(default_factory=ModelConfig)
    scene: SceneConfig = field(default_factory=SceneConfig)
    data: DataConfig = field(default_factory=DataConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    raster: RasterConfig = field(default_factory=RasterConfig)
    protocol: ProtocolConfig = field(default_factory=ProtocolConfig)


def register_schema() -> None:
    """Let Hydra check conf/config.yaml and its groups against the classes above."""
    ConfigStore.instance().store(name="schema", node=Config)

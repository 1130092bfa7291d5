"""Declare the type and the default of every key of the YAML files in conf/, so that Hydra refuses an unknown key.

This module does not import torch, so that `--help` and the message about a wrong key appear at once.
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
    """Describe a data set; an experiment (`+exp=`) sets these keys."""

    dataset: str = MISSING  # name in tables
    paper_dataset: str | None = None  # name in the paper's tables
    root: str = MISSING  # folder of the scenes' folders, or pkg://MODULE
    published: str = ""  # where to get the data
    scenes: list[str] = field(default_factory=list)  # scenes of scene=all
    repair: list[str] | None = None  # damaged images replaced by the frame before (Technicolor)
    background: str = "black"  # or white: background of images
    initial_lambda: float = 0.5  # initial lambda_t and lambda_d of 7DGS
    initial_points: int = 100_000  # random points, if the data have none
    initial_half_width: float | None = 1.3  # of the cube of random points; None: the cameras' common frustum


@dataclass
class SceneConfig:
    """Choose one scene of the data set."""

    name: str = MISSING  # folder in data.root
    released_as: str | None = None  # folder in the published data, if another
    downscale: int = 1  # divisor of the image size
    resize: str | None = None  # its filter; None: area; pillow: bicubic on 8 bits, as 3DGS
    eval_split: str = "test"  # or val (D-NeRF lego)
    val_every: int | None = None  # every n-th training view is of val, where the data have no val; None: none
    frames: list[int] | None = None  # first and last frame (Technicolor); None: all


@dataclass
class InitConfig:
    """Start the training from the Gaussians of a PLY file: `+init.ply=FILE`."""

    ply: str | None = None  # trained 3D Gaussians in the format of 3DGS
    ply_sha256: str | None = None  # hash of that file; computed if not given


@dataclass
class LearningRate:
    """Set a learning rate that falls log-linearly from `start` to `end` over the run."""

    start: float = MISSING
    end: float | None = None  # None: constant
    per_extent: bool = False  # multiplied by the radius of the scene's cameras
    per_run: bool = False  # multiplied by sqrt(recipe_iterations / iterations)


@dataclass
class ModelConfig:
    """Choose the model and its settings."""

    name: str = MISSING  # name of the model's class
    module: str | None = None  # Python module of your own model
    published_with_agr: bool = False  # whether the published method has AGR
    agr: bool = "${.published_with_agr}"  # type: ignore[assignment]  # default of the key agr
    agr_octaves: int = 4  # octaves of AGR's time encoding
    sh_degree: int = 3  # SH degree, 0 to 3
    min_opacity: float = 0.005  # Gaussians of lower opacity are pruned
    gate: str = "off"  # default of effects.gate
    candidates: dict[str, Any] = field(default_factory=dict)  # choices of model=auto
    compared: dict[str, Any] = field(default_factory=dict)  # more choices of it with effects.compare=true
    lr: dict[str, LearningRate] = field(default_factory=dict)  # learning rate of each parameter group
    options: dict[str, Any] = field(default_factory=dict)  # arguments of the model's class


@dataclass
class DensifyConfig:
    """Set the adaptive density control of 3DGS (section 5.2). All steps but `every` scale with `train.iterations`."""

    kind: str = "gradient"  # gradient (3DGS), mcmc (relocation) or multiview (FastGS)
    start: int = 500  # step after which densification starts
    stop: int = 15_000  # step at which densification ends
    every: int = 100  # least number of steps between two rounds
    rounds: int | None = None  # most rounds of a run; None: 36
    reset_every: int = 3_000  # steps between two opacity resets
    grad_threshold: float = 2e-4  # least mean gradient of a 2D mean, in units of half the image
    clone_below: float = 0.01  # clone if the largest scale is below this share of the extent, else split
    prune_above: float = 0.1  # prune if the largest scale is above this share of the extent, after an opacity reset
    thin_to: float | None = None  # share of Gaussians that stay after `stop`, by blend weight; None: all
    max_gaussians: int | None = None  # most Gaussians at full resolution; None: one for 64 training pixels
    noise: float = 5e5  # of mcmc: factor of the noise on means; 0: none


@dataclass
class PenaltyConfig:
    """Set one loss term."""

    weight: float = 0.0  # 0: no term
    start: int = 0  # first step
    stop: int | None = None  # step after the last; None: never


@dataclass
class PenaltiesConfig:
    """Add terms to every view's loss."""

    opacity: PenaltyConfig = field(default_factory=PenaltyConfig)  # mean opacity
    size: PenaltyConfig = field(default_factory=PenaltyConfig)  # mean scale in space, in parts of the scene's extent
    strain: PenaltyConfig = field(default_factory=PenaltyConfig)  # how fast neighbours move apart, for their distance


@dataclass
class TrainConfig:
    """Set the schedule and the loss. Steps are given for `recipe_iterations` iterations, and scaled to `iterations`."""

    iterations: int = 30_000  # steps of this run
    recipe_iterations: int = 30_000  # length of the run that other steps refer to
    batch_size: int = 4  # views in a step
    ssim_weight: float = 0.2  # loss = (1 - w) L1 + w (1 - SSIM)
    sh_every: int = 1_000  # steps until the SH degree rises by one
    refine_from: int = 3_000  # step from which AGR acts and learns
    lambda_from: int = 15_000  # step from which lambda_t and lambda_d learn
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    cooldown_from: int | None = None  # step from which learning rates fall to a tenth; None: never
    average_from: int | None = None  # parameters averaged from this step on end the run if better on val; None: never
    coarse: list[list[int]] | None = None  # [[4, 3000]]: a quarter of the width until step 3,000
    penalties: PenaltiesConfig = field(default_factory=PenaltiesConfig)
    curve_points: int = 20  # measurements on val during the run
    lengths: int | None = None  # 4: also train 1/2, 1/4 and 1/8 of the iterations, and keep the best on val; None: no
    patience: float | None = None  # share of the iterations without a better PSNR on val that ends a run; None: never
    checkpoint_minutes: float = 2.0  # minutes between two checkpoints


@dataclass
class RasterConfig:
    """Choose how images are rendered."""

    backend: str = "auto"  # or reference, cpu, cuda (docs/glossary.md)
    antialias: bool = False  # Mip-Splatting: scale opacities for the 2D filter


@dataclass
class ProtocolConfig:
    """Choose how results are measured."""

    name: str = MISSING  # gsbench, published or dgs2026
    quantise: bool = False  # measure renders rounded to 8 bits
    best_on_test: bool = False  # also record the best test PSNR (a leak)
    lpips_alex: str | None = None  # file of AlexNet's weights; None: in $TORCH_HOME/hub/checkpoints
    lpips_vgg: str | None = None  # file of VGG16's weights
    renders: int = 30  # least number of timed renders
    pictures: int = 3  # test views in pictures.png


@dataclass
class EffectsConfig:
    """Remove time, direction and AGR (a network) from Gaussians that do not need them (docs/effects.md)."""

    gate: str = "${model.gate}"  # off; end: after the training; both: also during it
    budget_db: float = 0.05  # dB of PSNR on val that the removal at the end may cost
    compare: bool = False  # choose the model of model=auto by PSNR on val, after 70 % of the steps


@dataclass
class LaunchConfig:
    """Launch runs here (`+launch=local`), in parallel processes (`parallel`) or as Slurm jobs (`slurm`)."""

    at_once: int = -1  # runs at a time; -1: one for each CPU (parallel) or all (slurm)
    partition: str | None = None  # this and all keys below: Slurm only
    minutes: int = 240  # time limit of a job; longer runs continue in another
    cpus: int = 4  # CPUs of a job
    gpus: int | None = None  # GPUs of a job; use device=cuda
    memory: str = "8G"  # memory of a job, as in sbatch
    setup: str = ":"  # shell line before the run: `module load cuda`
    requeues: int = 20  # most jobs in which a run may continue
    signal_seconds: int = 120  # seconds before the time limit at which a job saves
    container: str | None = None  # Apptainer image in which jobs run; None: none
    container_command: str = "apptainer exec"  # what runs a command in it
    sbatch: dict[str, Any] = field(default_factory=dict)  # other options of sbatch: +launch.sbatch.account=NAME


@dataclass
class Config:
    """Configure one run, or with `scene=all` a run for each scene of the data set."""

    experiment: str = MISSING  # name of the +exp= file
    seed: int = 0  # seed of every random number
    device: str = "cpu"  # or cuda, cuda:1
    agr: bool = "${model.agr}"  # type: ignore[assignment]  # whether the model has AGR, the neural refinement
    optim: str = "adam"  # or sparse_adam: updates only visible Gaussians
    results: str = "results"  # folder of all results
    resume: bool = True  # false: start over
    log: str | None = None  # also send the curve to tensorboard, wandb or mlflow
    model: ModelConfig = field(default_factory=ModelConfig)
    scene: SceneConfig = field(default_factory=SceneConfig)
    data: DataConfig = field(default_factory=DataConfig)
    init: InitConfig = field(default_factory=InitConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    raster: RasterConfig = field(default_factory=RasterConfig)
    protocol: ProtocolConfig = field(default_factory=ProtocolConfig)
    effects: EffectsConfig = field(default_factory=EffectsConfig)
    launch: LaunchConfig = field(default_factory=LaunchConfig)


def register_schema() -> None:
    """Let Hydra check conf/config.yaml and its groups against the dataclasses of this module."""
    ConfigStore.instance().store(name="schema", node=Config)

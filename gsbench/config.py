"""Declare every key of the YAML files in conf/ with its facts, so that Hydra refuses an unknown key.

A key is one line here, see `gsbench.config_key`. The keys of a training hook stand in the hook's own module: it
declares a dataclass with `@joins("train")`, and this module imports all modules of gsbench/train/hooks/. Such a module
imports torch and this module only in functions or for type checkers, as this module imports only Python's own library:
`--help` and the message about a wrong key appear at once, and reports need neither torch nor Hydra.
"""

import importlib
import pkgutil
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any

from gsbench.config_key import REQUIRED, extended, group, key

HERE = Path(__file__).parent
CONF = HERE / "conf" if (HERE / "conf").is_dir() else HERE.parent / "conf"  # in a wheel, else in a checkout

for _hook in pkgutil.iter_modules([str(HERE / "train" / "hooks")]):
    importlib.import_module(f"gsbench.train.hooks.{_hook.name}")


@dataclass
class DataConfig:
    """Describe a data set, as an experiment does."""

    dataset: str = key(REQUIRED, "name in tables", role="measuring")
    paper_dataset: str | None = key(None, "name in the paper", role="measuring")
    root: str = key(REQUIRED, "folder of scenes, or pkg://MODULE", role="place")
    published: str = key("", "where to get the data", role="place")
    scenes: list[str] = key([], "scenes of scene=all", role="place")
    repair: list[str] | None = key(None, "damaged images, replaced by the frame before")
    background: str = key("black", "background of images", choices=("black", "white"))
    initial_lambda: float = key(0.5, "initial lambda_d of 7DGS")
    initial_lambda_t: float = key(0.5, "initial lambda_t of 7DGS", absent=0.5)
    initial_points: int = key(100_000, "random points, if the scene has none", low=4)
    initial_half_width: float | None = key(
        1.3, "of the cube of random points; null: what all cameras see", low=1e-6, high=1e6
    )
    near: float | None = key(None, "least depth, in your units; null: 0.01 units of the training", low=1e-6, high=1e6)


@dataclass
class SceneConfig:
    """Choose one scene of the data set."""

    name: str = key(REQUIRED, "folder in data.root")
    released_as: str | None = key(None, "folder in the published data, if different", role="place")
    downscale: int = key(1, "divisor of the image size", low=1, high=10_000)
    resize: str | None = key(
        None, "filter of downscale; null: area; pillow: bicubic, 8 bits, as 3DGS", choices=("pillow",)
    )
    eval_split: str = key("test", "evaluated views; val for D-NeRF lego", choices=("test", "val"))
    val_every: int | None = key(None, "every n-th training view becomes val", low=2)
    frames: list[int] | None = key(None, "first and last frame; null: all")
    leave_out: list[str] | None = key(None, "training cameras that are not read, such as cam13")


@dataclass
class InitConfig:
    """Start the training from the Gaussians of a PLY file: `+init.ply=FILE`."""

    ply: str | None = key(None, "trained Gaussians of 3DGS", role="place")
    ply_sha256: str | None = key(None, "hash of the file; null: computed")


@dataclass
class LearningRate:
    """Set a learning rate that falls log-linearly from `start` to `end` over the run, or until an earlier step."""

    start: float = key(REQUIRED, "at the first step", low=0, high=inf)
    end: float | None = key(None, "at the last step; null: constant", low=0, high=inf)
    until: int | None = key(None, "step of `end`; null: the last", low=1)
    per_extent: bool = key(False, "the rate is multiplied by the scene's extent")
    per_run: bool = key(False, "the rate is multiplied by sqrt(recipe_iterations / iterations)")


@dataclass
class ModelConfig:
    """Choose the model and its settings."""

    name: str = key(REQUIRED, "the model's class")
    module: str | None = key(None, "Python module of your model")
    published_with_agr: bool = key(False, "whether its authors published it with AGR")
    agr: bool = key("${.published_with_agr}", "default of the key agr")
    agr_octaves: int = key(4, "octaves of AGR's times", low=0, high=32)
    sh_degree: int = key(3, "SH degree", low=0, high=3)
    min_opacity: float = key(0.005, "Gaussians of lower opacity are pruned", low=0, high=0.25)  # resets: to twice it
    gate: str = key("off", "default of effects.gate", role="place", choices=("off", "end", "both"))
    candidates: dict[str, Any] = key({}, "the models among which model=auto chooses")
    compared: dict[str, Any] = key({}, "more candidates, with effects.compare=true", needs="effects.compare")
    lr: dict[str, LearningRate] = key({}, "of each parameter group")
    options: dict[str, Any] = key({}, "arguments of the class")


@dataclass
class DensifyConfig:
    """Set the density control. All steps but `every` scale with `train.iterations`."""

    kind: str = key(
        "gradient",
        "rule: 3DGS, 3DGS-MCMC, FastGS, FreeTimeGS",
        choices=("gradient", "mcmc", "multiview", "relocation"),
        absent="gradient",
    )
    start: int = key(500, "first step", low=0)
    stop: int = key(15_000, "last step", low=0)
    every: int = key(100, "least steps between two rounds", low=1)
    rounds: int | None = key(None, "most rounds; null: 36", low=1)
    reset_every: int | None = key(3_000, "steps between opacity resets; null: none", low=1)
    grad_threshold: float = key(2e-4, "least mean gradient of a 2D mean, per half image", low=0)
    clone_below: float = key(0.01, "clone if the largest scale is below this share of the extent, else split", low=0)
    prune_above: float = key(0.1, "prune above this share of the extent, after an opacity reset", low=0)
    thin_to: float | None = key(None, "share of Gaussians kept after `stop`, by blend weight", low=1e-3, high=1)
    max_gaussians: int | None = key(None, "most Gaussians; null: one for 64 training pixels", low=4)
    noise: float = key(5e5, "of mcmc: factor of noise on means", low=0, absent=5e5)


@extended("train")
@dataclass
class TrainConfig:
    """Set the schedule and the loss. Steps are given for `recipe_iterations` iterations, and scaled to `iterations`."""

    iterations: int = key(30_000, "steps of this run", low=1)
    recipe_iterations: int = key(30_000, "length for which steps are set", low=1)
    batch_size: int = key(4, "views in a step", low=1, high=10_000)
    ssim_weight: float = key(0.2, "loss = (1 - w) L1 + w (1 - SSIM)", low=0, high=1)
    sh_every: int = key(1_000, "steps until the SH degree rises", low=1)
    refine_from: int = key(3_000, "step from which AGR acts and learns", low=0)
    lambda_from: int = key(15_000, "step from which lambda_t and lambda_d learn", low=0)
    densify: DensifyConfig = group(DensifyConfig)
    cooldown_from: int | None = key(None, "step from which rates fall to a tenth", low=0)
    coarse: list[list[int]] | None = key(None, "[[4, 3000]]: a quarter of the width until step 3,000")
    curve_points: int = key(20, "measurements on val", low=1, high=10_000)  # a page can draw so many
    checkpoint_minutes: float = key(2.0, "time between two checkpoints", unit="minutes", low=0, role="place")


@dataclass
class RasterConfig:
    """Choose how images are rendered."""

    backend: str = key("auto", "see docs/glossary.md", choices=("auto", "reference", "cpu", "cuda"))
    antialias: bool = key(False, "Mip-Splatting: scale opacities for the 2D filter")


@dataclass
class ProtocolConfig:
    """Choose how results are measured."""

    name: str = key(REQUIRED, "gsbench, published or dgs2026")
    quantise: bool = key(False, "renders in 8 bits")
    best_on_test: bool = key(False, "record the best test PSNR (a leak)", role="training")  # while it trains
    lpips_alex: str | None = key(None, "AlexNet's weights; null: in $TORCH_HOME/hub/checkpoints", role="place")
    lpips_vgg: str | None = key(None, "VGG16's weights", role="place")  # checked by their hash
    renders: int = key(30, "least timed renders", low=30, high=1_000_000)  # for percentiles
    pictures: int = key(3, "test views in pictures.png", low=0, high=10_000)


@dataclass
class EffectsConfig:
    """Remove time, direction and AGR from Gaussians that do not need them (docs/effects.md)."""

    gate: str = key(
        "${model.gate}", "end: after the training; both: during it too", choices=("off", "end", "both"), absent="off"
    )
    budget_db: float = key(
        0.05, "val PSNR that removal at the end may cost", unit="dB", low=0, high=10, needs="effects.gate"
    )
    static_above: float | None = key(
        None, "lifetime above which Gaussians become static after densification, as in 3D-4DGS", unit="clips", low=0
    )
    compare: bool = key(False, "choose for model=auto by val PSNR, after 70 % of the steps", absent=False)
    most_seconds: float | None = key(
        None, "most seconds of a model until this choice", unit="s", low=0, needs="effects.compare"
    )
    most_frame_ms: float | None = key(
        None, "most milliseconds of a model's frame", unit="ms", low=0, needs="effects.compare"
    )


@dataclass
class LaunchConfig:
    """Launch runs one after the other, in processes (`+launch=parallel`) or as Slurm jobs (`+launch=slurm`)."""

    by: str = key("local", "set by +launch=NAME", choices=("local", "parallel", "slurm"))
    at_once: int = key(-1, "runs at a time; -1: one per CPU (parallel), all (slurm)", low=-1)
    partition: str | None = key(None, "this and all keys below: Slurm only")
    minutes: int = key(240, "limit of a job; longer runs continue in another", unit="minutes", low=1)
    cpus: int = key(4, "CPUs of a job", low=1)
    gpus: int | None = key(None, "GPUs of a job; use device=cuda", low=0)
    memory: str = key("8G", "of a job, as in sbatch")
    setup: str = key(":", "shell line before each job: `module load cuda`")
    requeues: int = key(20, "most jobs that continue a run", low=0)
    signal_seconds: int = key(120, "a job saves so long before its limit", unit="seconds", low=1, high=65535)
    container: str | None = key(None, "Apptainer image of jobs")
    container_command: str = key("apptainer exec", "runs a command in the image")
    sbatch: dict[str, Any] = key({}, "more options: +launch.sbatch.account=NAME")


@extended("")
@dataclass
class Config:
    """Configure a run, or with `scene=all` a run for each scene."""

    experiment: str = key(REQUIRED, "the +exp= file", role="measuring")
    seed: int = key(0, "of every random number", low=0, high=2**63 - 1)
    device: str = key("cpu", "or cuda, cuda:1")
    agr: bool = key("${model.agr}", "the neural refinement of 7DGS")
    optim: str = key("adam", "sparse_adam: only visible Gaussians", choices=("adam", "sparse_adam"))
    results: str = key("results", "folder of all results", role="launching")
    resume: bool = key(True, "false: start over", role="launching")
    log: str | None = key(None, "tracker: tensorboard, wandb or mlflow", role="launching")
    model: ModelConfig = group(ModelConfig)
    scene: SceneConfig = group(SceneConfig)
    data: DataConfig = group(DataConfig)
    init: InitConfig = group(InitConfig)
    train: TrainConfig = group(TrainConfig)
    raster: RasterConfig = group(RasterConfig)
    protocol: ProtocolConfig = group(ProtocolConfig, role="measuring")
    effects: EffectsConfig = group(EffectsConfig)
    launch: LaunchConfig = group(LaunchConfig, role="launching")


PATHS = ("results", "data.root", "init.ply", "protocol.lpips_alex", "protocol.lpips_vgg")  # keys that hold a path


def register_schema() -> None:
    """Let Hydra check conf/config.yaml and its groups against the dataclasses of this module."""
    from hydra.core.config_store import ConfigStore

    ConfigStore.instance().store(name="schema", node=Config)

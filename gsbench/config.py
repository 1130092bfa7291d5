"""Declare the schema of conf/: the type and the default of every key. A typo in a YAML fails and names the key.

This module needs no torch, so that `--help` and the message about a wrong key appear at once.
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
    """A data set: where its files are and how they are read. An experiment sets these."""

    dataset: str = MISSING  # its name in tables
    paper_dataset: str | None = None  # the data set of the paper whose rows are shown beside it
    root: str = MISSING  # the folder that holds a folder for each scene; pkg://module for data inside a package
    published: str = ""  # where to get the data, for the error message when it is missing
    scenes: list[str] = field(default_factory=list)  # the scenes of scene=all
    background: str = "black"  # or white: the colour behind the images and the renders
    initial_lambda: float = 0.5  # the lambda_t and lambda_d of 7DGS at the start (7DGS, implementation details)
    initial_points: int = 100_000  # drawn at random where the data set gives none ..
    initial_half_width: float | None = 1.3  # .. in the cube [-w, w]^3; None: in the frustum that all cameras share


@dataclass
class SceneConfig:
    """One scene of the data set."""

    name: str = MISSING  # a folder in data.root
    released_as: str | None = None  # the folder's name in the published release, where the paper's `name` differs
    downscale: int = 1  # integer factor by which images are made smaller, by an area filter
    eval_split: str = "test"  # or val, where the test split is wrong (D-NeRF lego)
    frames: list[int] | None = None  # the first and the last frame of a Technicolor scene; None: all that are there


@dataclass
class InitConfig:
    """What a training starts from instead of points: +init.ply=FILE."""

    ply: str | None = None  # trained 3D Gaussians, as 3DGS writes them
    ply_sha256: str | None = None  # of that file: it tells two runs apart; filled in where it is not given


@dataclass
class LearningRate:
    """A learning rate over the run, log-linear from start to end."""

    start: float = MISSING
    end: float | None = None  # None: constant
    per_extent: bool = False  # multiplied by the scene's extent
    per_run: bool = False  # multiplied by sqrt(recipe_iterations / iterations), since a shorter run has fewer steps


@dataclass
class ModelConfig:
    """A model: the keys that every model has, and the options of this model's constructor."""

    name: str = MISSING  # of the class in gsbench/models/ ..
    module: str | None = None  # .. or in this Python module: docs/adding_a_model.md
    published_with_agr: bool = False  # whether AGR is part of the method as its authors describe it
    agr: bool = "${.published_with_agr}"  # type: ignore[assignment]  # an interpolation, typed when resolved
    agr_octaves: int = 4  # K of AGR's time encoding; the paper's 10 memorise every frame: docs/tuning.md
    sh_degree: int = 3  # of the spherical harmonics, 0 to 3
    min_opacity: float = 0.005  # a Gaussian below it is pruned
    gate: str = "off"  # the default of effects.gate
    candidates: dict[str, Any] = field(default_factory=dict)  # of model=auto: other models, of which a run chooses one
    lr: dict[str, LearningRate] = field(default_factory=dict)  # by parameter group
    options: dict[str, Any] = field(default_factory=dict)  # keyword arguments of the model's class


@dataclass
class DensifyConfig:
    """Adaptive density control (3DGS, section 5.2). All steps but `every` are those of a run of `recipe_iterations`."""

    kind: str = "gradient"  # the rule by which Gaussians are added and removed
    start: int = 500  # after this step Gaussians are cloned, split and pruned ..
    stop: int = 15_000  # .. until this one
    every: int = 100  # steps of a run of any length: clones need them to move apart before the next decision ..
    rounds: int | None = None  # .. and more where a long run would have more than so many of them; None: 36
    reset_every: int = 3_000  # opacity reset
    grad_threshold: float = 2e-4  # mean gradient of a 2D mean, in units of half the image
    clone_below: float = 0.01  # clone if the largest scale is below this part of the extent, else split
    prune_above: float = 0.1  # prune if it is above this part, after the first opacity reset
    thin_to: float | None = None  # after `stop` keep this share, those of the largest blend weights; None: all
    max_gaussians: int | None = None  # more are not made: those of the largest gradients come first; None: 2,000,000


@dataclass
class PenaltyConfig:
    """A penalty that is added to the loss of every view (gsbench/train/penalties.py)."""

    weight: float = 0.0
    start: int = 0  # a step of a run of `recipe_iterations`, from which it acts ..
    stop: int | None = None  # .. until this one; None: until the end


@dataclass
class PenaltiesConfig:
    """The penalties there are."""

    opacity: PenaltyConfig = field(default_factory=PenaltyConfig)  # mean opacity
    size: PenaltyConfig = field(default_factory=PenaltyConfig)  # mean largest scale, in parts of the scene's extent


@dataclass
class TrainConfig:
    """The recipe. Steps are stated for a run of `recipe_iterations` and are scaled to the length of the run."""

    iterations: int = 30_000  # steps of this run
    recipe_iterations: int = 30_000  # steps of the run that all other steps are stated for
    batch_size: int = 4  # views in a step
    ssim_weight: float = 0.2  # loss = (1 - w) L1 + w (1 - SSIM)
    sh_every: int = 1_000  # steps after which the spherical harmonics gain a degree
    refine_from: int = 3_000  # the step from which AGR acts and learns
    lambda_from: int = 15_000  # the step from which lambda_t and lambda_d learn
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    coarse: list[list[int]] | None = None  # [[4, 3000]]: a quarter of the width until step 3,000
    penalties: PenaltiesConfig = field(default_factory=PenaltiesConfig)
    curve_points: int = 20  # measurements on the val split during the run
    checkpoint_minutes: float = 2.0  # a killed run loses at most this much


@dataclass
class RasterConfig:
    """How images are rendered."""

    backend: str = "auto"  # or reference, cpu, cuda: who computes slices, images and losses
    antialias: bool = False  # whether opacities are scaled by the area that the 2D filter adds (Mip-Splatting)


@dataclass
class ProtocolConfig:
    """How results are measured; written into every record."""

    name: str = MISSING  # gsbench or published
    quantise: bool = False  # round renders to 8 bits before they are measured
    best_on_test: bool = False  # also record the best test PSNR during training, as published code does: it leaks
    lpips_alex: str | None = None  # trunk weights; None: $TORCH_HOME/hub/checkpoints
    lpips_vgg: str | None = None  # the same of VGG16
    renders: int = 30  # how many renders are timed, at least
    pictures: int = 3  # test views in pictures.png, as render | ground truth | error


@dataclass
class EffectsConfig:
    """Effects on demand: each Gaussian keeps those that pay (docs/effects.md)."""

    gate: str = "${model.gate}"  # off, end: after the training, or both: once densification is over too
    budget_db: float = 0.05  # PSNR on val that the gate at the end may cost


@dataclass
class LaunchConfig:
    """Where and how the runs of a sweep are done: +launch=local, parallel or slurm. It changes no number of a run."""

    at_once: int = -1  # runs at a time; -1: parallel takes one for each CPU, slurm as many as the cluster gives
    partition: str | None = None  # of Slurm, as all below
    minutes: int = 240  # the time limit of a job; a run that needs longer is saved and requeued
    cpus: int = 4  # of a job
    gpus: int | None = None  # they are used with device=cuda
    memory: str = "8G"  # as sbatch has it
    setup: str = ":"  # a shell line before the run, such as `module load cuda`
    requeues: int = 20  # how often a job that reached its time limit goes on in another one
    signal_seconds: int = 120  # how long before its time limit a job is told to save
    sbatch: dict[str, Any] = field(default_factory=dict)  # any other option of sbatch: +launch.sbatch.account=NAME


@dataclass
class Config:
    """A run, or for scene=all a run for each scene of the data set."""

    experiment: str = MISSING  # the name of the +exp= file, a folder in results/
    seed: int = 0  # of every random draw
    device: str = "cpu"  # or cuda, cuda:1
    agr: bool = "${model.agr}"  # type: ignore[assignment]  # whether AGR is wrapped around the model
    optim: str = "adam"  # or sparse_adam: a Gaussian that no view of the batch sees does not move
    results: str = "results"  # the folder of all results
    resume: bool = True  # continue from a checkpoint and keep finished runs of the same config; false: start over
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
    """Let Hydra check conf/config.yaml and its groups against the classes above."""
    ConfigStore.instance().store(name="schema", node=Config)

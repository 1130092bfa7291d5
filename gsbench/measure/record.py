"""Define record.json, the record of one run, and write, read and validate it.

A record holds the run (model, scene, seed), the protocol, the results (metrics, cost, training curve) and the
provenance. If a number is missing, it is null, and `missing` gives the reason. The module does not import torch.
"""

import dataclasses
import json
import math
import os
import re
import unicodedata
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from gsbench.errors import InputError, did_you_mean
from gsbench.measure.atomic import write_atomically
from gsbench.measure.curve import Point
from gsbench.measure.exact_views import MOST_PSNR
from gsbench.measure.machine import Hardware, named
from gsbench.measure.speed import RenderTimes
from gsbench.reading import parse, parse_json, read_file

VERSION = 1
LONGEST_NAME = 200  # bytes; of a scene, a model or an experiment, which are names of folders
MAX_FILE = 1 << 23  # bytes; the largest record known has less than a million
MAX_POINTS = 10_000  # the most points of a training curve, which a page can still draw quickly
SHOWN = msgspec.Meta(max_length=100)  # of a list or an object that tables show whole
FILE_NAME = "record.json"
CHECKPOINT = "checkpoint.pt"  # the file of the training, in the same folder
PUBLISHED = "published"  # the folder of records that ship with the code; it is read only where it is named
Status = Literal["ok", "failed", "diverged"]
METRICS = (
    "psnr",  # dB, joint over H x W x 3, final iteration, mean over the views of the evaluated split
    "psnr_train",  # dB, on as many training views as are evaluated, evenly spaced: the gap to `psnr` is overfitting
    "psnr_channel_mean",  # dB, the mean of the three channels' PSNR
    "ssim",
    "lpips_alex",
    "lpips_vgg",
    "psnr_best_on_val",  # dB, at the iteration that was best on validation
    "psnr_best_on_test",  # dB, the best on test during training: it LEAKS, and is only for comparison with papers
    "psnr_moving",  # dB, over the pixels that move: gsbench.measure.regions
    "psnr_object",  # dB, over the pixels of objects
    "flicker",  # steps of 8 bits, of the error in static pixels from frame to frame: gsbench.measure.flicker
    "static_drift",  # the same from the first third of a film to the last
    "flicker_truth",  # of the ground truth itself
    "drift_3d",  # in the user's unit of length, the path of Gaussians seen in static pixels: gsbench.run.drift
    "drift_3d_px",  # the same in pixels
    "psnr_float32",  # dB, the most by which float32 changes `psnr` of a view, of three views (gsbench.stability)
    "psnr_background_only",  # dB of an image of the background alone, which is what a model that learned nothing gets
)

MEASURED = ("train_s", "render_ms", "fps", "num_gaussians", "bytes", "peak_memory")  # costs of what gsbench trains


@dataclass(frozen=True)
class Effects:
    """Whether the Gaussians of a model depend on time, on the view direction and on AGR (the neural refinement)."""

    time: bool
    direction: bool
    refinement: bool  # AGR


@dataclass(frozen=True)
class ViewScore:
    """The image metrics of one rendered view; a metric is None if it is missing or not a number.

    PSNR is capped: gsbench.measure.exact_views.
    """

    name: str
    psnr: float | None = None
    psnr_channel_mean: float | None = None
    ssim: float | None = None
    lpips_alex: float | None = None
    lpips_vgg: float | None = None
    psnr_moving: float | None = None  # over the pixels of `Record.regions`, if the view has such pixels
    psnr_object: float | None = None

    @property
    def exact(self) -> list[str]:
        """List the view if its PSNR is at the cap, otherwise those of its regions for which this is true."""
        if self.psnr == MOST_PSNR:
            return [self.name]
        regions = {"moving": self.psnr_moving, "object": self.psnr_object}
        return [f"{self.name} ({region})" for region, psnr in regions.items() if psnr == MOST_PSNR]


@dataclass(frozen=True)
class Region:
    """The pixels over which `psnr_moving`, `psnr_object` or `flicker` was measured."""

    source: str  # what they were found in: "images of one camera", "masks" or "alpha"
    views: int  # number of views with such pixels
    share: float  # mean share of the pixels of these views
    digest: str  # SHA-256 of the masks


@dataclass(frozen=True)
class Cost:
    """The cost of a run: training seconds, memory, frame times and the size of the model.

    Of images that were rendered elsewhere only what the user states is known; other fields that may be None are None.
    """

    # wall-clock seconds of all training steps: gsbench.train.loop.Trainer.run says what does not count
    train_s: float | None
    stage_s: dict[str, float]  # the same seconds by stage of training; "other": between the stages
    render_ms: RenderTimes | None
    fps: float | None  # 1000 / render_ms.p50: gsbench.measure.speed.time_in_turns
    num_gaussians: int | None
    bytes: int | None  # size of the model's parameters
    peak_memory: int | None  # bytes: gsbench.measure.speed.peak_memory
    train_cpu_s: float | None = None  # CPU-seconds of all threads during `train_s`; None: not measured
    load: float | None = None  # mean load average of the machine during `train_s`, including this run


@dataclass(frozen=True)
class Renders:
    """The images of another program, which `gsbench.score` measured, and how they were matched to the views."""

    kind: str  # of the files, such as "8-bit PNG"; of a video "video, which is lossy"
    matched: Literal["names", "order"]
    resized_from: str | None  # their size, such as "800x800", if they were reduced to that of the views
    digest: str  # SHA-256 of the files


@dataclass(frozen=True)
class TimeScreen:
    """The result of the statistical test that decides, before training, whether a scene changes with time."""

    decision: str  # on, off or undecided
    reason: str
    p: float | None = None  # p-value: share of permutations of time with at least this energy; None: not tested
    z: float | None = None  # z-score of the energy in low frequencies of time, among those of permutations
    # share of the variance that the camera path does not explain; None: fixed camera, or not tested
    free: float | None = None
    seconds: float = 0.0  # duration of the test


@dataclass(frozen=True)
class Gate:
    """The savings from removing time, direction or AGR (a network) from Gaussians, and the PSNR that this loses."""

    share: float  # share of the squared error that the removal is predicted to add at most
    predicted_db: float
    measured_db: float  # PSNR lost on the views on which the removal was checked
    rows: dict[str, int]  # number of Gaussians by effect set (gsbench.models.effect_sets.NAMES), and of removed ones
    orders: dict[str, int]  # number of Gaussians by the order of their colours
    bytes_before: int
    bytes: int
    step: int | None = None  # the training step before which the removal was done; None: after training
    checked_on: str = "val"  # or "held-out training views"
    seconds: float = 0.0
    eval_loss_db: float | None = None  # PSNR lost on the evaluated split, if measured
    frame_ms_before: float | None = None  # median frame times before and after, measured alternately
    frame_ms: float | None = None
    asleep: float | None = None  # share of AGR's work that is skipped for Gaussians that no training view shows


@dataclass(frozen=True)
class Direction:
    """The change in PSNR and frame time if all Gaussians of a trained model ignore the view direction."""

    kept: float  # share of the Gaussians that depend on the view direction
    loss_db: float  # PSNR lost on the evaluated split if they all ignored the view direction
    frame_ms: float  # median frame times with and without direction, measured alternately
    frame_ms_without: float


@dataclass(frozen=True)
class Candidate:
    """One training of a comparison: its PSNR on val, the seconds until this was measured, and the time of a frame."""

    name: str  # the label of the model, such as "7dgs_noagr", or the length, such as "iterations=1000"
    psnr_val: float | None  # dB; None: not a number, or the training did not reach the comparison
    seconds: float
    reason: str | None = None  # why it cannot be chosen: it diverged, no Gaussian was left, or it exceeds the budget
    frame_ms: float | None = None  # the median at the views of val; None: not measured


@dataclass(frozen=True)
class ModelComparison:
    """The comparison on val by which model=auto chose a model, if the settings have `effects.compare=true`."""

    iteration: int  # the iteration after which PSNR on val was measured
    chosen: str  # the name of the candidate with the highest PSNR, which was trained to the end
    candidates: Annotated[list[Candidate], SHOWN]


@dataclass(frozen=True)
class LengthChoice:
    """The choice on val of a training among trainings of several lengths (`train.lengths`)."""

    kept: int  # the iterations of the training whose Gaussians are kept
    # the shortest first; a longer one that is missing was not trained
    tried: Annotated[list[Candidate], SHOWN]


@dataclass(frozen=True)
class OnDemand:
    """The decisions of a run to remove time, direction or AGR (a network) from Gaussians, with reasons."""

    screen: TimeScreen | None = None
    gates: list[Gate] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)  # decisions that were not possible, and why
    direction: Direction | None = None  # None: the model has no view direction
    comparison: ModelComparison | None = None  # None: no models were compared


@dataclass(frozen=True)
class Stop:
    """The end of a training with `train.patience`, which keeps the iteration with the best PSNR on val."""

    iteration: int  # the last finished one
    kept: int  # the one whose Gaussians were measured


@dataclass(frozen=True)
class Provenance:
    """The conditions under which a run was measured: commit, versions, machine, settings and date."""

    git_commit: str | None  # with "-dirty" if code was changed or added; None outside of a git checkout
    versions: dict[str, str]  # of Python and the packages that results depend on
    device: str  # the name of the processor or GPU
    threads: int  # threads of torch and of the kernels
    config: dict[str, Any]  # all settings of the run with references resolved, plain JSON
    config_hash: str
    data_hash: str  # Scene.fingerprint
    time: str  # UTC, ISO 8601
    hardware: Hardware | None = None  # None: not known
    data_notes: list[str] = field(default_factory=list)  # Scene.notes

    @property
    def machine(self) -> str:
        """Return the machine and the number of threads as text; times are comparable if these texts are equal."""
        return named(self.device, self.threads, self.hardware)


@dataclass(frozen=True)
class Record:
    """The record of one run: what was run, its status, results, cost and provenance.

    The keys of `metrics` are among METRICS; `missing` gives the reason for each metric that is None.
    """

    status: Status
    reason: str | None  # why the status is not "ok"
    experiment: str
    model: str
    scene: str
    dataset: str
    seed: Annotated[int, msgspec.Meta(ge=0)]
    effects: Effects | None  # None: not known of images that were rendered elsewhere
    # plain JSON: name, background, downscale, eval_split, quantise, paper_dataset, ...
    protocol: Annotated[dict[str, Any], SHOWN]
    provenance: Provenance
    metrics: dict[str, float | None] | None = None  # None only where the run is not ok
    missing: dict[str, str] = field(default_factory=dict)
    per_view: list[ViewScore] = field(default_factory=list)
    cost: Cost | None = None  # None only where the run is not ok
    curve: Annotated[list[Point], msgspec.Meta(max_length=MAX_POINTS)] = field(default_factory=list)
    version: int = VERSION
    variant: str = ""  # settings of its training that differ from the experiment's, such as "iterations=10"
    overrides: list[str] = field(default_factory=list)  # `python -m gsbench` with these arguments repeats the run
    regions: dict[str, Region] = field(
        default_factory=dict
    )  # by "moving", "object" and "static", if there are such pixels
    on_demand: OnDemand | None = None  # what the time screen and the gate did; None: neither ran
    stop: Stop | None = None  # None: the last iteration was measured, without `train.patience`
    averaged: int = 0  # number of last iterations over which parameters were averaged; 0: they were not
    length_choice: LengthChoice | None = None  # None: one training, without `train.lengths`
    exact: list[str] = field(default_factory=list)  # views: gsbench.measure.exact_views
    # what training hooks (gsbench.train.hooks.Hook.results) and gsbench.score add
    parts: dict[str, Any] = field(default_factory=dict)
    rendered_elsewhere: Renders | None = None  # None: gsbench trained and rendered the model

    @property
    def path(self) -> Path:
        """Return the folder of the run relative to the folder of all results; `run_path` names its errors."""
        return run_path(Path(), self.experiment, self.scene, self.model, self.seed, variant=self.variant)


def write(record: Record, path: Path) -> None:
    """Write `record` to `path` atomically as strict JSON.

    Metrics that are not finite become null, and `missing` gets the reason.

    Raises:
        InputError: the record is not valid; the message names the field.
    """
    try:
        plain = json.loads(json.dumps(dataclasses.asdict(_without_non_finite(record))))  # tuples become lists
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: expected a record of plain JSON values: {error}") from None
    parsed(plain, path)  # raises if it could not be read again
    write_atomically(path, (json.dumps(plain, indent=1, allow_nan=False) + "\n").encode())


def read(path: Path) -> Record:
    """Read and validate the record at `path`; an InputError names the file and the field that are not valid."""
    return parsed(parse_json(read_file(path, str(path), MAX_FILE), str(path)), path)


def parsed(plain: Any, path: Path | str) -> Record:
    """Convert plain JSON to a record; an InputError names `path` and the field that are not valid."""
    version = plain.get("version") if isinstance(plain, dict) else VERSION
    if type(version) is not int or version != VERSION:  # checked first, because another version has other keys
        raise InputError(f"{path}: version: expected {VERSION}, got {ascii(version)[:80]}; run again with this gsbench")
    record = parse(Record, plain, str(path))
    check(record, str(path))
    return record


def find(root: Path, name: str = FILE_NAME) -> list[Path]:
    """Return the sorted paths of all files of a name under `root`, without subfolders called "published".

    A broken link or a folder of this name counts too, so that whoever reads it reports it.
    """
    paths = []
    for folder, folders, names in os.walk(root):
        if name in names or name in folders:
            paths.append(Path(folder, name))
        folders[:] = [inner for inner in folders if inner != PUBLISHED]
    return sorted(paths)


def run_path(root: Path, experiment: str, scene: str, model: str, seed: int, *, variant: str = "") -> Path:
    """Return the folder of a run: `root/<experiment>/<scene>/<model>[,<variant>]/seed<k>`.

    Raises:
        InputError: a name has characters that a folder name may not have, or the seed is out of range.
    """
    _check_names(experiment, scene, model, variant, "")
    if not 0 <= seed < 2**63:
        raise InputError(f"seed: expected 0 <= seed < 2^63, got {seed}")
    return root / experiment / scene / model_folder(model, variant) / f"seed{seed}"


def model_folder(model: str, variant: str) -> str:
    """Return the folder name of a model and its variant (the settings that differ from the experiment's, or "")."""
    return f"{model},{variant}" if variant else model


def _check_names(experiment: str, scene: str, model: str, variant: str, where: str) -> None:
    """Raise InputError if a name is not a valid folder name, for instance because it leads out of its parent."""
    for what, name in (("experiment", experiment), ("scene", scene), ("model", model)):
        composed = unicodedata.normalize("NFC", name)  # \w has letters of every script, but not their accents alone
        if not re.fullmatch(r"[^\W_][\w.+-]{0,99}", composed) or len(name.encode()) > LONGEST_NAME:
            raise InputError(f"{where}{what}: expected a name of letters, digits and _ . + -, got {name!r:.80}")
    if not re.fullmatch(r"([A-Za-z0-9][A-Za-z0-9_.+,=-]{0,99})?", variant):
        raise InputError(f"{where}variant: expected words such as iterations=10, got {variant!r:.80}")


def check(record: Record, file: str) -> None:
    """Raise InputError if a record breaks a rule that types cannot express, such as that a good run has metrics."""
    _check_names(record.experiment, record.scene, record.model, record.variant, f"{file}: ")
    ok = record.status == "ok"
    if ok == (record.reason is not None):
        raise InputError(f"{file}: reason: expected {'null' if ok else 'why the run is ' + record.status}")
    for what, value in (("metrics", record.metrics), ("cost", record.cost)):
        if ok and value is None:
            raise InputError(f"{file}: {what}: expected values in a run that is ok, got null")
    if record.rendered_elsewhere is None:
        costs = {f"cost.{name}": getattr(record.cost, name) for name in MEASURED} if record.cost else {}
        for what, value in {"effects": record.effects, **costs}.items():
            if value is None:
                raise InputError(f"{file}: {what}: expected a value in a run of gsbench's, got null")
    metrics = record.metrics or {}
    for name in metrics:
        if name not in METRICS:
            raise InputError(f"{file}: metrics: unknown metric {name!r:.80}. {did_you_mean(name, METRICS)}")
        if metrics[name] is None and name not in record.missing:
            raise InputError(f"{file}: missing: expected the reason why metrics.{name} is null")
    for name in record.missing:
        if name not in METRICS or metrics.get(name) is not None:
            raise InputError(f"{file}: missing: {name!r:.80} is not a metric that is null")
    iterations = [point.iteration for point in record.curve]
    if iterations != sorted(set(iterations)):
        raise InputError(f"{file}: curve: expected rising iterations")


def _without_non_finite(record: Record) -> Record:
    """Replace metrics, view scores and curve points that are not finite by None, and add the reasons to `missing`."""
    metrics, missing = record.metrics, dict(record.missing)
    if metrics is not None:
        bad = {name: value for name, value in metrics.items() if value is not None and not math.isfinite(value)}
        why = {True: "not a number", False: "infinite: the images are identical"}
        missing |= {name: why[math.isnan(value)] for name, value in bad.items()}
        metrics = metrics | dict.fromkeys(bad)
    views = [ViewScore(**{k: _finite(v) for k, v in vars(view).items()}) for view in record.per_view]
    curve = [Point(p.iteration, p.seconds, _finite(p.psnr_val)) for p in record.curve]
    return dataclasses.replace(record, metrics=metrics, missing=missing, per_view=views, curve=curve)


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value

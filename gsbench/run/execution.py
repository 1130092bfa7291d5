"""Execute one run: prepare, choose the model, train, measure, and write a record even if an error ends it.

A finished run is not trained again: its record is kept, or it is measured again from its checkpoint.
"""

import gc
import sys
import sysconfig
import traceback
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from gsbench import models
from gsbench.config import HERE
from gsbench.config_roles import listed, measuring_differences, training_differences, training_hash
from gsbench.errors import InputError, one_line, printable
from gsbench.gates import messages
from gsbench.gates.hook import Gating
from gsbench.measure import perceptual
from gsbench.measure import record as records
from gsbench.measure.atomic import remove_leftovers
from gsbench.measure.curve import FALL, Curve
from gsbench.measure.exact_views import sentence
from gsbench.measure.images import Pixels, write_png
from gsbench.measure.provenance import provenance
from gsbench.measure.record import Effects, Record, Status
from gsbench.measure.speed import reset_peak_memory
from gsbench.models import GaussianModel
from gsbench.process.memory import is_out_of_memory
from gsbench.report import plausible
from gsbench.run import fitting, measuring, progress
from gsbench.run.identity import RunSpec
from gsbench.run.log import RunLog, check_tracker
from gsbench.run.progress import Progress
from gsbench.run.selection import ChosenModel, best_on_val, check_candidates, choose_model, plain, reporter
from gsbench.run.settings import check_settings, is_auto, lpips_weights, with_candidate
from gsbench.run.setup import (
    build,
    check_folder,
    check_machine,
    check_scene,
    check_start,
    evaluated_views,
    load_scene,
    trained_start,
)
from gsbench.run.stop import Stopped
from gsbench.scenes import Scene
from gsbench.scenes.gaussian_ply import TrainedGaussians
from gsbench.scenes.placement import gaussians_to_standard
from gsbench.train import checkpoint
from gsbench.train.divergence import DivergedError, explain
from gsbench.train.hooks.choices import choices_in, lengths_of
from gsbench.train.loop import Trainer

TRACEBACK = "traceback.txt"
STALE = "record.stale.json"  # that of a finished run, kept beside the record of a later one that did not finish
SPARE = 1 << 25  # bytes reserved, so that a run which ends without memory can still write its record


class UnrecordedError(InputError):
    """A run ended, and its record cannot be written."""


class Execution:
    """A training and its measurement, which can be described in a record even after an error."""

    def __init__(self, spec: RunSpec) -> None:
        """Store the run; no file is read and no setting is checked yet."""
        self.spec = spec
        before_scene = with_candidate(spec.config, "moving") if is_auto(spec.config) else spec.config
        self.chosen = ChosenModel(before_scene)  # for model=auto, `prepare` and `fit` may choose another
        self.model: GaussianModel | None = None
        self.scene: Scene | None = None
        self.start: TrainedGaussians | None = None  # trained Gaussians to start from; None to start from points
        self.log: RunLog | None = None  # from the first step on
        self._images: dict[str, Pixels] = {}

    def prepare(self) -> tuple[GaussianModel, Scene]:
        """Check the settings, build the model and load the scene, so that errors are found before the first step.

        Raises:
            InputError: the settings, the device or the data are invalid.
        """
        config = self.chosen.config
        check_settings(self.spec.config)
        check_machine(config)
        self.model = build(config)
        start = trained_start(config)
        self.scene = scene = load_scene(config)
        if is_auto(self.spec.config) and not scene.has_time:
            config = with_candidate(self.spec.config, "static")
            self.chosen, self.model = ChosenModel(config), build(config)
        elif config.effects.compare:
            check_candidates(self.spec.config, scene)
        check_scene(self.model, scene, config)
        if start is not None:
            self.start = gaussians_to_standard(start, scene.placement)
            check_start(self.start, scene)
        evaluated_views(scene, config.scene.eval_split)  # raises an error if there are none
        records.check(self.describe("failed", "not run"), "planned record")  # that names and settings can be written
        return self.model, scene

    def fit(self, model: GaussianModel, scene: Scene) -> Trainer:
        """Train to the last step; for model=auto a test of the scene, or `effects.compare` on val, chooses the model.

        It raises the errors of `gsbench.run.fitting.resume` and `fit`, and of `gsbench.run.selection.best_on_val`.
        """
        spec = self.spec
        if is_auto(spec.config):
            self.chosen = choose_model(spec, scene)
            self.model = model = build(self.chosen.config)
        screen, device = self.chosen.screen, spec.config.device
        if self.chosen.compares or lengths_of(spec.config) is not None:  # these add the costs of the screen themselves
            reset_peak_memory(device)
            trainer = best_on_val(spec, scene, self.start, self.chosen)
            self.chosen, self.model = replace(self.chosen, config=trainer.config), trainer.model
        else:
            trainer = self.trainer(model, scene)
            reset_peak_memory(device)
            if not fitting.resume(trainer, spec, fitting.saved_state(spec, scene)) and screen is not None:
                trainer.stages.add("screen", screen.seconds)
                trainer.effort.add(self.chosen.effort)
        trainer.hook(Gating).screen = screen
        self.log = RunLog(spec, trainer)
        fitting.fit(trainer, spec, plain(spec, trainer.config), lambda: reporter(spec, trainer), self.log.follow)
        return trainer

    def trainer(self, model: GaussianModel, scene: Scene) -> Trainer:
        """Initialise the Gaussians from the scene's points or from trained Gaussians; return the trainer at step 0."""
        return fitting.trainer_of(model, scene, self.chosen.config, self.start)

    def measure(self, trainer: Trainer) -> Record:
        """Measure image quality, speed and size of the trained model, and return the record."""
        results = {name: value for hook in trainer.hooks for name, value in hook.results().items()}
        measured, cost, frames = measuring.measure(trainer, with_effect_sets="on_demand" in results)
        self._images = measured.images
        record = self.describe("ok", None)
        fields = {name: value for name, value in results.items() if hasattr(record, name)}  # `parts` has the others
        of_other_hooks = {name: value for name, value in results.items() if name not in fields}
        exact_views = trainer.exact.union(*(view.exact for view in measured.per_view))  # the render equals the image
        return replace(
            record,
            protocol=record.protocol | frames,
            metrics=measured.metrics,
            missing=measured.missing,
            per_view=measured.per_view,
            regions=measured.regions,
            cost=cost,
            curve=trainer.curve.points,
            **fields,
            parts=of_other_hooks | {"steps": trainer.gradients.replay.counts},
            exact=sorted(exact_views),
        )

    def draw(self) -> None:
        """Write the measured renders, such as pictures.png, and the effects that Gaussians keep as effect_sets.png."""
        try:
            for name, image in self._images.items():
                write_png(image, self.spec.folder / name)
        except Exception as error:  # the record is written, so an error in the pictures must not end the sweep
            print(f"{self.spec.name}: no pictures: {one_line(error)}", file=sys.stderr)

    def describe(self, status: Status, reason: str | None) -> Record:
        """Return a record without measurements, to check it before step 0, and for a run that failed for a `reason`."""
        config, scene, spec = self.chosen.config, self.scene, self.spec
        observes = models.find(config.model.name, config.model.module).observes
        return Record(
            status=status,
            reason=reason,
            experiment=config.experiment,
            model=spec.label,
            scene=config.scene.name,
            dataset=config.data.dataset,
            seed=config.seed,
            effects=Effects("time" in observes, "direction" in observes, config.agr),
            protocol={
                **measuring.protocol_of(config, scene),
                "backend": self.model.backend.name if self.model else config.raster.backend,
            },
            # Without a model, the device may be one that is not here.
            provenance=provenance(spec.plain, scene, config.device if self.model is not None else "cpu"),
            variant=spec.variant,
            overrides=spec.overrides,
        )


def execute(spec: RunSpec) -> Record | None:
    """Train and measure the model of a run on its scene, or keep the record of an earlier run.

    The record is also on disk, even if the run failed. It is None if another process does this run.

    Raises:
        InputError: the run's folder cannot be written, or `log` is not known or not installed.
        UnrecordedError: the record cannot be written.
        Stopped: a signal asked the process to end; the checkpoint is saved.
    """
    check_folder(spec.folder)
    check_tracker(spec.config.log)
    process, execution, record = Progress(spec.overrides), Execution(spec), None
    try:
        if not _is_claimed(spec, process):
            return None
        (spec.folder / progress.STOPPED).unlink(missing_ok=True)
        remove_leftovers(spec.folder)
        record = _record_of(execution)
    except Stopped:
        progress.release_claim(spec.folder, process, is_stopped=True)
        raise
    finally:
        progress.release_claim(spec.folder, process)  # does nothing if it is released
        if execution.log is not None:
            execution.log.end(record)
    return record


def _is_claimed(spec: RunSpec, process: Progress) -> bool:
    """Claim a run for this process; if another process does the run, print a message and return False.

    Raises:
        InputError: the claim cannot be written.
    """
    try:
        other = progress.take_claim(spec.folder, process)
    except OSError as error:
        raise InputError(f"{spec.folder}: the run cannot be claimed: {one_line(error)}") from None
    if other is not None:
        whose = f"process {other.pid} on {printable(other.host)}"
        print(f"{spec.name}: left to {whose}, which is at step {other.step} of it", file=sys.stderr)
    return other is None


def _record_of(execution: Execution) -> Record:
    """Train and measure a run that this process has claimed, or keep the record of an earlier run."""
    spec, spare = execution.spec, [bytearray(SPARE)]
    try:
        model, scene = execution.prepare()
        earlier = finished(spec, scene)
        record = earlier or execution.measure(execution.fit(model, scene))
    except Exception as error:
        spare.clear()  # memory for the record
        earlier, record = None, _ended_badly(execution, error)
    if earlier is not None:
        print(
            f"{spec.name}: finished before, kept: {summary(earlier)}; measured {_where(spec, earlier)}; "
            f"{spec.folder / records.FILE_NAME}"
        )
        return earlier
    try:
        write(record, spec.folder)
    except OSError as error:  # the sweep continues with its other runs; the checkpoint of this run is unchanged
        raise UnrecordedError(f"{summary(record)}; its record cannot be written: {error.strerror}") from None
    for line in messages.lines(record.on_demand) if record.on_demand else []:
        print(f"{spec.name}: {line}")
    ended = summary(record) if record.status == "ok" else record.status  # the caller prints the reason
    print(f"{spec.name}: {ended}; {spec.folder / records.FILE_NAME}")
    execution.draw()
    return record


def _ended_badly(execution: Execution, error: Exception) -> Record:
    """Return the record of a run that an error has ended.

    Raises:
        InputError: the model is unknown, so that the run has no place in a table.
    """
    is_diverged = isinstance(error, DivergedError)
    if is_out_of_memory(error):
        error.__traceback__ = None  # the frames of the traceback keep the large objects alive
        gc.collect()
    reason = one_line(error) if is_diverged else reason_of(error, execution.spec.folder)
    if is_diverged and execution.model is not None and len(execution.model):
        try:
            reason = f"{reason}; {explain(execution.model)}"
        except Exception as unexplained:  # an error in the explanation must not hide that the run diverged
            reason = f"{reason}; it cannot be explained: {one_line(unexplained)}"
    return execution.describe("diverged" if is_diverged else "failed", reason)


def reason_of(error: Exception, folder: Path) -> str:
    """Return in one line why a run failed; the stack trace of an unexpected error is written to `folder`."""
    text = one_line(error)
    if is_out_of_memory(error):
        return f"out of memory: {text}"
    if isinstance(error, OSError):
        return f"{error.filename or folder}: {error.strerror or text}"
    if isinstance(error, InputError):
        return text
    path = folder / TRACEBACK
    path.write_text("".join(traceback.format_exception(error)))
    raised = f"{type(error).__name__}: {text}"
    libraries = tuple(map(sysconfig.get_path, ("stdlib", "purelib", "platlib")))
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if Path(frame.filename).is_relative_to(HERE):
            break
        if not frame.filename.startswith(libraries):  # such as a model of the user's
            return f"an error in {Path(frame.filename).name}, line {frame.lineno}: {raised}; see {path}"
    return f"an error that gsbench did not foresee, {raised}; please report it, with {path}"


def write(record: Record, folder: Path) -> None:
    """Write the record of a run; if the run failed, keep the record of an earlier success as record.stale.json."""
    path, stale = folder / records.FILE_NAME, folder / STALE
    if record.status == "ok":
        records.write(record, path)
        stale.unlink(missing_ok=True)
        return
    with suppress(InputError):  # no record, or a damaged one
        if records.read(path).status == "ok":
            path.replace(stale)
    if stale.exists():
        record = replace(record, reason=f"{record.reason} (what an earlier run measured is kept in {STALE})")
    records.write(record, path)


def summary(record: Record) -> str:
    """Return a record in one line: PSNR, size and speed, exact views, a fall of PSNR on val; or why the run failed."""
    if record.metrics is None or record.cost is None:
        return f"{record.status}: {record.reason}"
    psnr, choice, cost = record.metrics["psnr"], record.length_choice, record.cost
    facts = [f"PSNR {'-' if psnr is None else format(psnr, '.2f')} dB"]
    facts += [] if cost.num_gaussians is None else [f"{cost.num_gaussians} Gaussians"]
    facts += [f"{choice.kept} iterations kept"] if choice else []
    facts += [] if cost.train_s is None else [f"trained in {cost.train_s:.0f} s"]
    facts += [] if cost.fps is None else [f"{cost.fps:.0f} FPS"]
    exact_views = f". {printable(sentence(record.exact))}" if record.exact else ""
    return f"{', '.join(facts)}{exact_views}{too_long(record)}"


def too_long(record: Record) -> str:
    """Return a sentence if PSNR on val was more than FALL dB higher before the end of the training, otherwise ""."""
    curve = Curve(record.curve)
    if record.stop is not None or record.length_choice is not None or curve.best is None or curve.fall <= FALL:
        return ""
    return (
        f". PSNR on val was {curve.fall:.2f} dB higher at iteration {curve.best.iteration}: a shorter training may "
        f"be better (docs/runs.md#how-a-run-ends)"
    )


def finished(spec: RunSpec, scene: Scene) -> Record | None:
    """Return the record of an earlier run if it is ok and has the same settings and data; otherwise None.

    If a record does not match, the reason is printed. If LPIPS weights were added to this machine, the run is measured
    again from its checkpoint; without a checkpoint, the record is kept without LPIPS.
    """
    if not spec.config.resume:
        return None
    for path in (spec.folder / records.FILE_NAME, spec.folder / STALE):
        if not path.exists():
            continue
        try:
            record = plausible.read(path)
        except InputError as error:
            _say(spec, str(error))
            continue
        if record.status != "ok":
            continue
        reason = _outdated(spec, scene, record) or _lacks_lpips(spec, scene, record)
        if reason:
            _say(spec, f"{path}: {reason}")
            continue
        path.replace(spec.folder / records.FILE_NAME)
        return record
    return None


def _where(spec: RunSpec, record: Record) -> str:
    """Return the date and the machine of a record as text."""
    machine = record.provenance.machine
    is_here = machine == provenance(spec.plain, None, spec.config.device).machine
    return f"{record.provenance.time.partition('T')[0]:.20} on {'this machine' if is_here else machine}"


def _outdated(spec: RunSpec, scene: Scene, record: Record) -> str:
    """Return why the record of an earlier run does not match the settings and data of this run; "" if it matches."""
    earlier = record.provenance
    training = training_differences(earlier.config, spec.plain)
    if training:
        return f"the training is another ({listed(training)}): running again"
    if earlier.data_hash != scene.fingerprint:
        return "the scene's data has changed: running again"
    measuring = measuring_differences(earlier.config, spec.plain)
    if measuring:
        again = "measured again" if _is_trained(spec, scene) else "its checkpoint is gone: running again"
        return f"what is measured is another ({listed(measuring)}): {again}"
    return ""


def _lacks_lpips(spec: RunSpec, scene: Scene, record: Record) -> str:
    """Return why an earlier run must be measured again for LPIPS (its weights were added); "" if its record is kept."""
    camera, weights = evaluated_views(scene, spec.config.scene.eval_split)[0].camera, lpips_weights(spec.config)
    new = [
        name
        for name, backbone in perceptual.BACKBONES.items()
        if (record.metrics or {}).get(f"lpips_{name}") is None
        and perceptual.is_here(name, weights.get(name))
        and min(camera.width, camera.height) >= backbone.least_side
    ]
    if not new:
        return ""
    what = f"it has no LPIPS ({', '.join(new)}), whose weights are here now"
    if _is_trained(spec, scene):
        return f"{what}: measured again"
    _say(spec, f"{what}, but its checkpoint is gone: kept without")
    return ""


def _is_trained(spec: RunSpec, scene: Scene) -> bool:
    """Return whether this run has a checkpoint of its finished training."""
    path: Path = spec.folder / checkpoint.FILE_NAME
    try:
        state = checkpoint.load(path, training_hash(spec.plain), scene.fingerprint, "cpu")
    except InputError:
        return False
    if state is None:
        return False
    choice = choices_in(state).length
    return state.get("step") == (spec.config.train.iterations if choice is None else choice.kept)


def _say(spec: RunSpec, text: str) -> None:
    print(f"{spec.name}: {text}", file=sys.stderr)

"""Find the record of an earlier, finished run, and decide whether to keep it, to measure again or to train again."""

import sys
from pathlib import Path

import torch

from gsbench import kernels
from gsbench.config_roles import listed, measuring_differences, training_differences, training_hash
from gsbench.errors import InputError
from gsbench.measure import perceptual
from gsbench.measure import record as records
from gsbench.measure.machine import hardware, named
from gsbench.measure.record import Record
from gsbench.run.checks import evaluated_views, lpips_weights
from gsbench.run.identity import Run
from gsbench.scenes import Scene
from gsbench.train import checkpoint
from gsbench.train.hooks.choices import choices_in

STALE = "record.stale.json"  # that of a finished run, kept beside the record of a later attempt that did not finish


def finished(this: Run, scene: Scene) -> Record | None:
    """Return the record of an earlier run if it is ok and has the same settings and data; otherwise None.

    If a record does not match, the reason is printed. If LPIPS weights were added to this machine, the run is measured
    again from its checkpoint; without a checkpoint, the record is kept without LPIPS.
    """
    if not this.config.resume:
        return None
    for path in (this.folder / records.FILE_NAME, this.folder / STALE):
        if not path.exists():
            continue
        try:
            record = records.read(path)
        except InputError as error:
            _say(this, str(error))
            continue
        if record.status != "ok":
            continue
        reason = _outdated(this, scene, record) or _lacks_lpips(this, scene, record)
        if reason:
            _say(this, f"{path}: {reason}")
            continue
        path.replace(this.folder / records.FILE_NAME)
        return record
    return None


def where(this: Run, record: Record) -> str:
    """Return the date and the machine of a record as text."""
    here, device = hardware(kernels.instruction_set()), this.config.device
    name = torch.cuda.get_device_name(device) if device.startswith("cuda") else here.processor
    machine = record.provenance.machine
    is_here = machine == named(name, torch.get_num_threads(), here)
    return f"{record.provenance.time.partition('T')[0]:.20} on {'this machine' if is_here else machine}"


def _outdated(this: Run, scene: Scene, record: Record) -> str:
    """Return why the record of an earlier run does not match the settings and data of this run; "" if it matches."""
    earlier = record.provenance
    training = training_differences(earlier.config, this.plain)
    if training:
        return f"the training is another ({listed(training)}): running again"
    if earlier.data_hash != scene.fingerprint:
        return "the scene's data has changed: running again"
    measuring = measuring_differences(earlier.config, this.plain)
    if measuring:
        again = "measured again" if _is_trained(this, scene) else "its checkpoint is gone: running again"
        return f"what is measured is another ({listed(measuring)}): {again}"
    return ""


def _lacks_lpips(this: Run, scene: Scene, record: Record) -> str:
    """Return why an earlier run must be measured again for LPIPS (its weights were added); "" if its record is kept."""
    camera, weights = evaluated_views(scene, this.config.scene.eval_split)[0].camera, lpips_weights(this.config)
    new = [name for name, known in perceptual.BACKBONES.items()
           if (record.metrics or {}).get(f"lpips_{name}") is None and perceptual.is_here(name, weights.get(name))
           and min(camera.width, camera.height) >= known.least_side]  # fmt: skip
    if not new:
        return ""
    what = f"it has no LPIPS ({', '.join(new)}), whose weights are here now"
    if _is_trained(this, scene):
        return f"{what}: measured again"
    _say(this, f"{what}, but its checkpoint is gone: kept without")
    return ""


def _is_trained(this: Run, scene: Scene) -> bool:
    """Return whether this run has a checkpoint of its finished training."""
    path: Path = this.folder / checkpoint.FILE_NAME
    try:
        state = checkpoint.load(path, training_hash(this.plain), scene.fingerprint, "cpu")
    except InputError:
        return False
    if state is None:
        return False
    choice = choices_in(state).length
    return state.get("step") == (this.config.train.iterations if choice is None else choice.kept)


def _say(this: Run, text: str) -> None:
    print(f"{this.name}: {text}", file=sys.stderr)

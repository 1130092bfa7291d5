"""Simplify the Gaussians of a finished run into a new run."""

import copy
from pathlib import Path

from gsbench.config import EffectsConfig
from gsbench.config_roles import Plain, training_hash
from gsbench.errors import InputError
from gsbench.gates.hook import Gating
from gsbench.measure import record as records
from gsbench.measure.record import Record
from gsbench.run.execution import Execution, write
from gsbench.run.identity import RunSpec
from gsbench.run.load import trusted_root, typed_config
from gsbench.run.setup import check_folder
from gsbench.train import checkpoint
from gsbench.train.checkpoint import Checkpoint


def gate_finished(folder: Path, budget_db: float, data_root: str | None = None) -> tuple[Record, Path]:
    """Remove AGR, or also time and direction, from a finished run's Gaussians that do not need them.

    The setting `effects.gate=end` does the same at the end of a training; here no training is repeated. At most
    `budget_db` dB of PSNR on val are lost. Return the record and the folder of the new run; `folder` is not changed.

    Raises:
        InputError: the run is not finished, effects were already removed at its end, or its data do not exist or have
            changed.
    """
    path = folder / checkpoint.FILE_NAME
    if not path.exists():
        raise InputError(f"{folder}: expected the folder of a run with a {checkpoint.FILE_NAME}, found none")
    former = checkpoint.read(path)

    # The settings and the name of the new run: those of the old one, and the gate.
    plain: Plain = copy.deepcopy(former.config)
    gate = typed_config(plain, path).effects.gate
    if gate != "off":
        raise InputError(f"{folder}: expected a run that was not gated at its end, got effects.gate={gate}")
    plain["effects"] = {"gate": "end", "budget_db": budget_db}  # the other settings are of the training, which is over
    config = typed_config(plain, path)
    config.data.root = plain["data"]["root"] = data_root or trusted_root(config.data.root, folder)
    old = records.read(folder / records.FILE_NAME)
    changes = ["gate=end"] + ([] if budget_db == EffectsConfig().budget_db else [f"budget_db={budget_db}"])
    variant = ",".join(([old.variant] if old.variant else []) + changes)
    new = folder.parent.parent / records.model_folder(old.model, variant) / folder.name  # SCENE/MODEL,VARIANT/SEED
    overrides = sorted([*old.overrides, "effects.gate=end", f"effects.budget_db={budget_db}"])
    check_folder(new)

    execution = Execution(RunSpec(config, plain, new, old.model, variant, overrides))
    try:
        model, scene = execution.prepare()
    except InputError as error:
        raise InputError(f"{error}; if the data set is elsewhere now, name its folder by --data-root") from None
    if scene.fingerprint != former.data:
        raise InputError(f"{folder}: expected the data that it was trained on, {scene.name} has changed since")
    trainer = execution.trainer(model, scene)
    trainer.load_state_dict(former.state)
    if trainer.step < config.train.iterations:
        raise InputError(
            f"{folder}: expected a finished run, this one is at step {trainer.step} of "
            f"{config.train.iterations}: run it again, it continues from there"
        )
    trainer.hook(Gating).finish()
    content = Checkpoint(training_hash(plain), former.data, trainer.state_dict(), plain, former.scene)
    checkpoint.save(new / checkpoint.FILE_NAME, content)
    record = execution.measure(trainer)
    write(record, new)
    execution.draw()
    return record, new

"""A run that finished before: kept, measured again or trained again, and the reason is said."""

import dataclasses
import shutil
from pathlib import Path

import pytest
import torch
from tiny_run import overrides, run_here

from gsbench.errors import InputError
from gsbench.measure import perceptual, provenance
from gsbench.measure import record as files
from gsbench.measure.record import Record
from gsbench.train import checkpoint
from gsbench.train.loop import Trainer

WORDS = ("model=3dgs", "train.iterations=4")


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory, square: Path) -> tuple[Record, Path, Path]:
    """A finished run of 4 steps, its results and its folder."""
    results = tmp_path_factory.mktemp("results")
    record, folder = run_here(*overrides(square, results, *WORDS))
    assert record.status == "ok"
    return record, results, folder


class Trained(Exception):  # noqa: N818
    """A step of training, where none should be."""


@pytest.fixture
def again(tmp_path: Path, square: Path, done, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]):
    """Do the finished run again with other words, and return the new record and what was said."""
    first, before, folder = done
    results = tmp_path / "results"
    shutil.copytree(before, results)

    def no_step(*_: object) -> None:
        raise Trained

    def repeat(*more: str, change: object = None, trains: bool = False) -> tuple[Record, str]:
        if not trains:
            monkeypatch.setattr(Trainer, "train_step", no_step)
        if callable(change):
            change(repeat.folder)
        capfd.readouterr()
        record, _ = run_here(*overrides(square, results, *WORDS, *more))
        return record, "".join(capfd.readouterr())

    repeat.first, repeat.folder = first, results / folder.relative_to(before)
    return repeat


def weights(monkeypatch: pytest.MonkeyPatch, *, here: bool) -> None:
    """Pretend that the weights of LPIPS' VGG, which takes images as small as these, are or are not on this machine."""

    def load(backbone: str, *_: object):
        if backbone != "vgg" or not here:
            raise perceptual.BackboneMissing("no trunk weights")
        return lambda *_: torch.tensor([0.25])

    monkeypatch.setattr(perceptual, "load", load)
    monkeypatch.setattr(perceptual, "is_here", lambda backbone, _: here and backbone == "vgg")


def no_checkpoint(folder: Path) -> None:
    (folder / checkpoint.FILE_NAME).unlink()


def test_what_is_kept_says_where_it_was_measured(again) -> None:
    """Catches a stranger who takes a kept record's seconds for his own machine's."""

    def elsewhere(folder: Path) -> None:
        provenance = dataclasses.replace(
            again.first.provenance, device="another CPU", hardware=None, time="2026-01-02T"
        )
        files.write(dataclasses.replace(again.first, provenance=provenance), folder / files.FILE_NAME)

    assert "finished before, kept: PSNR " in again()[1]
    assert "on this machine; " in again()[1]
    threads = again.first.provenance.machine.rpartition(", ")[2]
    assert f"measured 2026-01-02 on another CPU, {threads}; " in again(change=elsewhere)[1]


def test_a_place_is_no_setting(again, square: Path, tmp_path: Path) -> None:
    """Catches a training repeated, for want of its checkpoint, because the data were moved or are saved less often."""
    (tmp_path / "moved").symlink_to(square)
    record, output = again(f"data.root={tmp_path / 'moved'}", "train.checkpoint_minutes=9", change=no_checkpoint)
    assert record == again.first
    assert "finished before, kept" in output


def test_a_release_trains_nothing_again(again, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a version in the name of a run, in its hash or in its checkpoint, which would cost every training."""
    monkeypatch.setattr(provenance, "__version__", "9.9.9")
    record, output = again()
    assert record == again.first
    assert "finished before, kept" in output
    record, _ = again("protocol.quantise=true")  # measured from the checkpoint: `again` refuses a step
    assert record.status == "ok"
    assert record.provenance.versions["gsbench"] == "9.9.9"


def changed(record: Record, folder: Path, *, with_checkpoint: bool = False, **provenance: object) -> None:
    """Let the record of a finished run have another provenance, as one that was made before has."""
    other = dataclasses.replace(record.provenance, **provenance)
    files.write(dataclasses.replace(record, provenance=other), folder / files.FILE_NAME)
    if not with_checkpoint:
        no_checkpoint(folder)


def of_older_config(record: Record, folder: Path) -> None:
    config = record.provenance.config
    changed(record, folder, config={**config, "train": config["train"] | {"iterations": 1000}})


QUANTISED = "protocol.quantise True instead of False"


@pytest.mark.parametrize(
    ("words", "change", "reason", "trains"),
    [
        (["protocol.quantise=true"], lambda *_: None, f"what is measured is another ({QUANTISED}): measured again",
         False),
        (["protocol.quantise=true"], lambda _, folder: no_checkpoint(folder),
         f"({QUANTISED}): its checkpoint is gone: running again", True),
        ([], of_older_config, "the training is another (train.iterations 4 instead of 1000): running again", True),
        ([], lambda record, folder: changed(record, folder, with_checkpoint=True, data_hash="0" * 64),
         "the scene's data has changed: running again", False),
    ],
    ids=["measured", "no checkpoint", "training", "data"],
)  # fmt: skip
def test_what_differs_is_named(again, words: list[str], change, reason: str, trains: bool) -> None:
    """Catches a run that is done again for no reason that is said, and a training of hours announced as a measurement;
    `again` refuses a step of training unless the run trains."""
    record, output = again(*words, change=lambda folder: change(again.first, folder), trains=trains)
    assert reason in output
    assert record.protocol["quantise"] is bool(words)


def test_weights_that_come_are_measured_from_the_checkpoint(again, monkeypatch) -> None:
    """Catches a training that LPIPS weights cost, and a column that stays empty although they are there."""
    assert again.first.metrics["lpips_vgg"] is None
    weights(monkeypatch, here=True)
    record, output = again()
    assert "it has no LPIPS (vgg), whose weights are here now: measured again" in output
    assert record.metrics["lpips_vgg"] == 0.25
    assert record.metrics["psnr"] == again.first.metrics["psnr"]


def test_weights_that_come_after_the_checkpoint_went_cost_nothing(again, monkeypatch) -> None:
    """Catches a training repeated for an LPIPS column: a record without its checkpoint is kept as it is."""
    weights(monkeypatch, here=True)
    record, output = again("protocol.lpips_vgg=weights.pth", change=no_checkpoint)
    assert "whose weights are here now, but its checkpoint is gone: kept without" in output
    assert record == again.first


def test_weights_that_go_take_nothing_with_them(again, monkeypatch) -> None:
    """Catches LPIPS that is lost, or a training repeated, because the weights are no longer here or not named."""
    weights(monkeypatch, here=True)
    measured, _ = again("protocol.lpips_vgg=weights.pth")
    weights(monkeypatch, here=False)
    record, output = again(change=no_checkpoint)
    assert record == measured
    assert record.metrics["lpips_vgg"] == 0.25
    assert "finished before, kept" in output


def test_weights_that_are_named_and_missing_lose_no_record(again, tmp_path: Path) -> None:
    """Catches a finished record lost to a path that is wrong: it is refused, and comes back with the right one."""
    refused, _ = again(f"protocol.lpips_vgg={tmp_path / 'gone.pth'}")
    assert refused.status == "failed"
    assert "kept in record.stale.json" in str(files.read(again.folder / files.FILE_NAME).reason)
    assert again()[0] == again.first
    with pytest.raises(InputError):
        perceptual.load("vgg", tmp_path / "gone.pth")

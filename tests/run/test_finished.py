"""A run that finished before: kept, measured again or trained again, and the reason is said."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from report.records import lost, make
from tiny_run import overrides, run_here

from gsbench.errors import InputError
from gsbench.measure import perceptual, provenance
from gsbench.measure import record as files
from gsbench.measure.record import Record
from gsbench.run import execution
from gsbench.train import checkpoint
from gsbench.train.loop import Trainer

WORDS = ("model=3dgs", "train.iterations=4")
KEPT = "finished before, kept: PSNR "


@dataclass
class Finished:
    """A run of 4 steps that is finished: its results, its record and its folder, which each test may change."""

    data: Path
    results: Path
    first: Record
    folder: Path

    def again(self, *words: str) -> Record:
        """Do it again with other words; return the new record."""
        return run_here(*overrides(self.data, self.results, *WORDS, *words))[0]

    def lose_checkpoint(self) -> None:
        (self.folder / checkpoint.FILE_NAME).unlink()

    def change(self, **changed: Any) -> None:
        """Let its record have another provenance, as one that was made elsewhere or before has."""
        other = replace(self.first, provenance=replace(self.first.provenance, **changed))
        files.write(other, self.folder / files.FILE_NAME)

    def edit(self) -> None:
        """Raise PSNR in its record by hand."""
        edited = replace(self.first, metrics=(self.first.metrics or {}) | {"psnr": 60.0})
        files.write(edited, self.folder / files.FILE_NAME)

    def of_older_config(self) -> None:
        """Let its record be that of a longer training, and lose its checkpoint."""
        config = self.first.provenance.config
        self.change(config=config | {"train": config["train"] | {"iterations": 1000}})
        self.lose_checkpoint()


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory, square: Path) -> Finished:
    results = tmp_path_factory.mktemp("results")
    return Finished(square, results, *run_here(*overrides(square, results, *WORDS)))


@pytest.fixture
def run(original: Finished, tmp_path: Path) -> Finished:
    results = shutil.copytree(original.results, tmp_path / "results")
    return replace(original, results=results, folder=results / original.folder.relative_to(original.results))


@pytest.fixture
def trains(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """Refuse a step of training, unless a test says that there is one."""
    if not getattr(request, "param", False):
        monkeypatch.setattr(Trainer, "train_step", lambda _: pytest.fail("trained again"))


@pytest.fixture
def weights(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """The networks of LPIPS whose weights are on this machine, as far as the run knows; at first none."""
    here = set[str]()

    def load(backbone: str, *_: object) -> Callable[..., torch.Tensor]:
        if backbone not in here:
            raise perceptual.BackboneMissing("no trunk weights")
        return lambda *_: torch.tensor([0.25])

    monkeypatch.setattr(perceptual, "load", load)
    monkeypatch.setattr(perceptual, "is_here", lambda backbone, _: backbone in here)
    return here


QUANTISED = "what is measured is another (protocol.quantise True instead of False): "


@pytest.mark.parametrize(
    ("words", "change", "reason", "trains"),
    [
        ((), lambda _: None, f"{KEPT}.* on this machine; ", False),
        (
            (),
            lambda run: run.change(device="another CPU", hardware=None, time="2026-01-02T"),
            "measured 2026-01-02 on another CPU, {threads}; ",
            False,
        ),
        (("train.checkpoint_minutes=9", "data.root={moved}"), Finished.lose_checkpoint, KEPT, False),
        (("protocol.quantise=true",), lambda _: None, rf"{QUANTISED}measured again", False),
        (
            ("protocol.quantise=true",),
            Finished.lose_checkpoint,
            f"{QUANTISED}its checkpoint is gone: running again",
            True,
        ),
        (
            (),
            Finished.of_older_config,
            r"the training is another (train.iterations 4 instead of 1000): running again",
            True,
        ),
        ((), lambda run: run.change(data_hash="0" * 64), "the scene's data has changed: running again", False),
        ((), Finished.edit, "metrics.psnr: expected .*, the mean of its views, got 60: was it edited", False),
    ],
    ids=["kept", "elsewhere", "moved", "measured", "no checkpoint", "training", "data", "edited"],
    indirect=["trains"],
)
@pytest.mark.usefixtures("trains")
def test_what_differs_is_named_and_nothing_else_is_done(words, change, reason, run, tmp_path, capfd):
    """Catches a training of hours that is announced as a measurement, repeated because data were moved, or done for no
    reason that is said, and a stranger who takes a kept record's seconds for his own machine's."""
    (tmp_path / "moved").symlink_to(run.data)
    change(run)
    record = run.again(*(word.format(moved=tmp_path / "moved") for word in words))
    threads = run.first.provenance.machine.rpartition(", ")[2]
    output, parts = "".join(capfd.readouterr()), reason.format(threads=threads).split(".*")
    assert all(part in output for part in parts), output
    assert (record.metrics == run.first.metrics) == (record.protocol["quantise"] is False)
    assert record.protocol["quantise"] is ("protocol.quantise=true" in words)
    assert not reason.startswith(KEPT) or record == run.first
    if words == ("protocol.quantise=true",) and change is not Finished.lose_checkpoint:  # what was trained stays
        assert (record.cost.train_s, record.curve) == (run.first.cost.train_s, run.first.curve)


@pytest.mark.usefixtures("trains")
def test_a_release_trains_nothing_again(run, monkeypatch):
    """Catches a version in the name of a run, in its hash or in its checkpoint, which would cost every training."""
    monkeypatch.setattr(provenance, "__version__", "9.9.9")
    assert run.again() == run.first
    record = run.again("protocol.quantise=true")
    assert record.status == "ok"
    assert record.provenance.versions["gsbench"] == "9.9.9"


@pytest.mark.usefixtures("trains")
def test_weights_that_come_and_go_cost_no_training(run, weights, tmp_path, capfd):
    """Catches a training that LPIPS weights cost, a column that stays empty although they are there, one that is lost
    as they go, and a finished record lost to a path that is wrong."""
    assert run.first.metrics["lpips_vgg"] is None
    weights.add("vgg")
    measured = run.again("protocol.lpips_vgg=weights.pth")
    assert "it has no LPIPS (vgg), whose weights are here now: measured again" in capfd.readouterr().err
    assert measured.metrics == run.first.metrics | {"lpips_vgg": 0.25}
    weights.clear()
    refused = run.again(f"protocol.lpips_vgg={tmp_path / 'gone.pth'}")
    assert refused.status == "failed"
    assert "kept in record.stale.json" in str(files.read(run.folder / files.FILE_NAME).reason)
    run.lose_checkpoint()
    assert run.again() == files.read(run.folder / files.FILE_NAME) == measured

    run.change()  # without LPIPS again, and without a checkpoint to measure it
    weights.add("vgg")
    assert run.again("protocol.lpips_vgg=weights.pth") == run.first
    assert "whose weights are here now, but its checkpoint is gone: kept without" in capfd.readouterr().err


def test_weights_that_are_named_must_exist(tmp_path):
    """Catches a file that is named and missing, in whose place another is loaded."""
    with pytest.raises(InputError):
        perceptual.load("vgg", tmp_path / "gone.pth")


def test_a_run_that_ends_well_at_last_leaves_its_record_alone(tmp_path):
    """Catches the record of an earlier success that stays beside a later one."""
    folder = tmp_path / "run"
    for each, count in ((make(), 1), (lost(make()), 2), (lost(make()), 2), (make(), 1)):
        execution.write(each, folder)
        assert len([*folder.iterdir()]) == count

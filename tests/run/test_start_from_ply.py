"""A run that starts from a PLY of trained Gaussians: it starts there, and its record says from which file."""

import hashlib
from pathlib import Path

import pytest
import torch
from tiny_run import overrides, run_here, write_moving_square

from gsbench.errors import InputError
from gsbench.run.load import load_run
from gsbench.scenes.gaussian_ply import TrainedGaussians, ply_of


def write_trained(path: Path, count: int = 8, away: int = 0) -> TrainedGaussians:
    """Write Gaussians around the origin, the last `away` of them 500 units above it; return them."""
    g = torch.Generator().manual_seed(0)
    draws = [torch.randn(shape, generator=g) for shape in ((count, 3), (count, 3), (count, 4), (count,), (count, 3))]
    draws[0][count - away :, 1] += 500 / 0.3
    trained = TrainedGaussians(0.3 * draws[0], 0.1 * draws[1] - 1, *draws[2:], torch.zeros(count, 15, 3))
    path.write_bytes(ply_of(trained))
    return trained


@pytest.mark.parametrize("model", ["3dgs", "7dgs"])
def test_a_run_starts_from_the_file(model: str, tmp_path: Path) -> None:
    """Catches a file that is read and not used, a record that does not say which, and a run that is done again."""
    trained = write_trained(tmp_path / "a.ply")
    data = write_moving_square(tmp_path / "data")
    slow = "model.lr.means.start=1e-6"  # one step moves means by the rate, 1e-6 x extent x sqrt(30,000)
    words = [*overrides(data, tmp_path / "r", f"model={model}", "train.iterations=1", slow),
             f"+init.ply={tmp_path}/a.ply"]  # fmt: skip
    record, folder = run_here(*words)
    assert record.status == "ok", record.reason
    sha256 = hashlib.sha256((tmp_path / "a.ply").read_bytes()).hexdigest()
    assert record.provenance.config["init"]["ply_sha256"] == sha256
    assert sha256[:8] in folder.parent.name
    means = load_run(folder).model.splats["means"]
    assert len(means) == len(trained)
    assert 0 < (means - trained.means).abs().max() < 1e-3
    assert run_here(*words)[0].provenance.time == record.provenance.time  # finished before, kept


def test_three_gaussians_and_another_file_than_asked_for_are_refused(tmp_path: Path) -> None:
    """Catches a refusal without a record, which would leave no row in the table."""
    data = write_moving_square(tmp_path / "data")
    words = [*overrides(data, tmp_path / "r", "model=3dgs", "train.iterations=1"), f"+init.ply={tmp_path}/a.ply"]
    for count, more, said in ((3, [], "at least 4 Gaussians"), (8, ["+init.ply_sha256=" + 64 * "0"], "SHA-256")):
        write_trained(tmp_path / "a.ply", count)
        record, _ = run_here(*words, *more)
        assert record.status == "failed"
        assert said in (record.reason or "")


def test_a_hash_without_a_file_and_an_endless_file_are_refused(tmp_path: Path) -> None:
    """Catches a hash that nothing is compared with, and a file that is read for ever before the run has a name."""
    data = write_moving_square(tmp_path / "data")
    words = overrides(data, tmp_path / "r", "model=3dgs", "train.iterations=1")
    record, _ = run_here(*words, "+init.ply_sha256=0")
    assert "init.ply_sha256" in (record.reason or "")
    with pytest.raises(InputError, match=r"init\.ply='/dev/zero': expected a file, found a device"):
        run_here(*words, "+init.ply=/dev/zero")


def test_gaussians_that_no_camera_sees_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a training of black images from a file of another scene, and one of a few Gaussians without a line."""
    data = write_moving_square(tmp_path / "data")
    words = [*overrides(data, tmp_path / "r", "model=3dgs", "train.iterations=1"), f"+init.ply={tmp_path}/a.ply"]
    write_trained(tmp_path / "a.ply", 8, away=8)
    record, _ = run_here(*words)
    assert record.status == "failed"
    assert "no training camera sees one of the 8" in (record.reason or "")
    for away, line in ((6, True), (3, False)):
        write_trained(tmp_path / "a.ply", 8, away)
        assert run_here(*words)[0].status == "ok"
        assert ("the training cameras see 25% of the Gaussians" in capsys.readouterr().err) == line

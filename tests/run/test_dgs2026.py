"""The protocol of dGS' authors, in a run: its record says the filter of its images and the best on test."""

from pathlib import Path

from tiny_run import overrides, run_here, write_moving_square


def test_the_record_says_the_protocol(tmp_path: Path) -> None:
    """Catches images of another filter under a record that is silent about it, and a best on test that is left out."""
    data = write_moving_square(tmp_path / "data")
    words = [*overrides(data, tmp_path / "r", "model=dgs", "train.iterations=2"), "protocol.pictures=0"]
    record, folder = run_here(*words, "protocol=dgs2026")
    assert record.status == "ok", record.reason
    assert record.protocol["resize"] == "pillow"
    assert (record.protocol["name"], record.protocol["quantise"]) == ("dgs2026", True)
    assert record.metrics is not None
    assert record.metrics["psnr_best_on_test"] is not None
    assert "protocol=dgs2026" in folder.parent.name
    plain, other = run_here(*words)
    assert "resize" not in plain.protocol
    assert other != folder
    assert "scene.resize" in (run_here(*words, "scene.resize=pilow")[0].reason or "")

"""Tell whether a run follows the protocol of the 7DGS paper, so that only comparable numbers are compared."""

from typing import Any

from gsbench.measure.record import Record
from gsbench.report.frame import iterations
from gsbench.report.paper import PROTOCOLS, Protocol


def departure(record: Record) -> str:
    """Return the names of the settings in which a run differs from the 7DGS paper's protocol; "" if there are none."""
    protocol = PROTOCOLS.get(record.dataset)
    if protocol is None or record.protocol.get("paper_dataset") != record.dataset:
        return "data"
    if record.scene not in protocol.scenes:
        return "scene"
    config = record.provenance.config
    expected: dict[str, tuple[Any, Any]] = _of_images(record, protocol) | {
        "iterations": (iterations(record), protocol.iterations),
        "batch size": (_part(config, "train").get("batch_size"), protocol.batch_size),
        "frames": (_count(_part(config, "scene").get("frames")), protocol.frames),
    }
    if record.status != "ok" and record.protocol.get("resolution") == "not loaded":
        del expected["size"]  # a run that failed before it saw an image
    return ", ".join(name for name, (value, of_paper) in expected.items() if value != of_paper)


def has_images_of_paper(record: Record) -> bool:
    """Tell whether a run is measured on the images of the 7DGS paper, of the paper's size, split and background.

    Only then can its PSNR be compared with the paper's. The training may be another one.
    """
    protocol = PROTOCOLS.get(record.dataset)
    if protocol is None or record.protocol.get("paper_dataset") != record.dataset:
        return False
    return all(value == of_paper for value, of_paper in _of_images(record, protocol).values())


def _of_images(record: Record, protocol: Protocol) -> dict[str, tuple[Any, Any]]:
    """Return the settings of the images on which a run is measured, by name, each beside that of the paper."""
    return {
        "size": (record.protocol.get("resolution"), protocol.sizes.get(record.scene, protocol.sizes["*"])),
        "filter": (record.protocol.get("resize"), None),
        "split": (record.protocol.get("eval_split"), protocol.splits.get(record.scene, protocol.splits["*"])),
        "background": (record.protocol.get("background"), "black"),
        "quantisation": (record.protocol.get("quantise"), False),
    }


def _part(config: dict[str, Any], name: str) -> dict[str, Any]:
    """Return a section of a run's config, such as "train"; it is empty if the record lacks the section."""
    part = config.get(name)
    return part if isinstance(part, dict) else {}


def _count(frames: Any) -> int | None:
    """Return the number of frames in a range [first, last]; None if `frames` is not such a range."""
    if isinstance(frames, list) and len(frames) == 2 and all(isinstance(n, int) for n in frames):
        return int(frames[1] - frames[0] + 1)
    return None

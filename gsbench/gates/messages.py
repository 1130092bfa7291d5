"""Write messages about the test for change with time, and about the simplification of Gaussians.

A simplified Gaussian is independent of time, direction or AGR (the neural refinement), or has a lower SH degree.
This module does not import torch.
"""

import re

from gsbench.measure.exact_views import rank
from gsbench.measure.record import Candidate, Direction, Gate, LengthChoice, ModelComparison, OnDemand, TimeScreen

EFFECT_SETS = {  # the names of gsbench.models.effect_sets, in the same order, and their names in the legend
    "refined": "refined by AGR",
    "conditioned": "conditioned",
    "time": "time frozen",
    "direction": "direction frozen",
    "static": "static",
}
_KEEP = {
    "refined": "have AGR",
    "conditioned": "are conditioned without AGR",
    "time": "have time frozen",
    "direction": "have direction frozen",
    "static": "are static",
}


_OLDER = (  # words of older records, and what is written now
    (r"what a static fit leaves over changes with time", "a static model's error changes over time"),
    (r"what a static fit leaves over does not( clearly)? change with time",
     r"a static model's error does not\1 change over time"),
    (r"differ, in ([^,]+) of their blocks, and with time", r"change over time, in \1 of their blocks"),
    (r"differ, in ([^,]+) of their blocks, but not by slow waves of time",
     r"differ in \1 of their blocks, but not clearly over time"),
    (r", z = [-\d.]+(, \d+% of time's slow waves are free of the camera)?\)", ")"),
    (r"(camera|camera's) place", r"\1 position"),
)  # fmt: skip


def of_screen(screen: TimeScreen) -> str:
    """Return a message with the answer of the test whether the scene changes with time, and why it is the answer."""
    kept = ", so time is kept" if screen.decision == "undecided" else ""
    return f"time is {screen.decision}{kept}: {reason(screen)}"


def reason(screen: TimeScreen) -> str:
    """Return why a test decided that a scene changes with time, or that it does not, in present words."""
    text = screen.reason
    for words, now in _OLDER:
        text = re.sub(words, now, text)
    return text


def of_comparison(found: ModelComparison) -> str:
    """Return a message: the PSNR on val of each candidate of model=auto, and which of them was chosen."""
    said = _of_candidates(found.candidates)
    return (f"PSNR on val after {found.iteration} iterations: {said}; {found.chosen} is trained to the end"
            f"{_tie(found.candidates)}")  # fmt: skip


def of_lengths(found: LengthChoice) -> str:
    """Return a message: the PSNR on val of each length that was trained, and which of them is kept."""
    said = _of_candidates(found.tried)
    return f"PSNR on val: {said}; the training of {found.kept} iterations is kept{_tie(found.tried)}"


def _tie(candidates: list[Candidate]) -> str:
    """Return an addition to a message if PSNR on val does not decide between the best candidates; otherwise ""."""
    ranks = {one.name: rank(one.psnr_val) for one in candidates if one.reason is None}
    best = [name for name, value in ranks.items() if value == max(ranks.values())]
    return f": PSNR cannot decide between {', '.join(best)}, so the last of them is taken" if len(best) > 1 else ""


def _of_candidates(found: list[Candidate]) -> str:
    return ", ".join(f"{one.name} {'-' if one.psnr_val is None else format(one.psnr_val, '.2f')} dB"
                     if one.reason is None else f"{one.name} failed" for one in found)  # fmt: skip


def of_gate(gate: Gate) -> str:
    """Return a message on a simplified model: what its Gaussians still depend on, its PSNR, frame time and bytes."""
    left = sum(number for name, number in gate.rows.items() if name != "removed")
    when = "after training" if gate.step is None else f"after step {gate.step}"
    kept = ", ".join(f"{gate.rows[name]} {words}" for name, words in _KEEP.items() if gate.rows.get(name))
    text = f"gate {when}: {left} of {left + gate.rows.get('removed', 0)} Gaussians are left"
    text += f" ({kept})" if kept else ""
    text += f"; PSNR on {gate.checked_on} {-gate.measured_db:+.3f} dB"
    if gate.eval_loss_db is not None:
        text += f", on the evaluated views {-gate.eval_loss_db:+.3f} dB"
    if gate.frame_ms_before and gate.frame_ms:
        text += f", a frame {gate.frame_ms_before:.2f} -> {gate.frame_ms:.2f} ms"
    text += f", {gate.bytes_before / 1e6:.2f} -> {gate.bytes / 1e6:.2f} MB"
    if gate.asleep:
        text += (
            f"; AGR moves {1 - gate.asleep:.0%} of its Gaussians in a frame, as the others are invisible at its time"
        )
    return text


def of_direction(found: Direction) -> str:
    """Return a message: how many Gaussians depend on direction, and what would change if none did."""
    return (f"direction: {found.kept:.0%} of the Gaussians depend on it; if none did, PSNR would change by "
            f"{-found.loss_db:+.2f} dB and a frame from {found.frame_ms:.2f} to "
            f"{found.frame_ms_without:.2f} ms")  # fmt: skip


def lines(found: OnDemand) -> list[str]:
    """Return the messages about Gaussians that a run made independent of time, direction or AGR (a network)."""
    said = [of_gate(gate) for gate in found.gates]
    return said + ([of_direction(found.direction)] if found.direction else []) + found.notes

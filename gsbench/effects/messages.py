"""Write messages about the test for change with time, and about the simplification of Gaussians.

A simplified Gaussian is independent of time, direction or AGR (the neural refinement), or has a lower SH degree.
This module does not import torch.
"""

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


def of_decision(screen: TimeScreen) -> str:
    """Return a message that says whether the test found that the scene changes with time."""
    return f"time is {screen.decision}{', so it is simulated' if screen.decision == 'undecided' else ''}"


def of_screen(screen: TimeScreen) -> str:
    """Return a message with the answer of the test whether the scene changes with time, and why it is the answer."""
    return f"{of_decision(screen)}: {screen.reason}"


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
    when = "at the end" if gate.step is None else f"after step {gate.step}"
    kept = ", ".join(f"{gate.rows[name]} {words}" for name, words in _KEEP.items() if gate.rows.get(name))
    text = (f"gated {when}: of {left + gate.rows.get('removed', 0)} Gaussians {left} are left, of which {kept}; "
            f"PSNR on {gate.checked_on} {-gate.measured_db:+.3f} dB")  # fmt: skip
    if gate.eval_loss_db is not None:
        text += f", evaluated {-gate.eval_loss_db:+.3f} dB"
    if gate.frame_ms_before and gate.frame_ms:
        text += f", a frame {gate.frame_ms_before:.2f} -> {gate.frame_ms:.2f} ms"
    text += f", {gate.bytes_before / 1e6:.2f} -> {gate.bytes / 1e6:.2f} MB"
    if gate.asleep:
        text += f"; at any one time AGR moves {1 - gate.asleep:.0%} of its Gaussians, as the others cannot be seen then"
    return text


def of_direction(found: Direction) -> str:
    """Return a message: how many Gaussians depend on direction, and what would change if none did."""
    return (f"direction: {found.kept:.0%} of the Gaussians keep it; freezing it in all would change PSNR by "
            f"{-found.loss_db:+.2f} dB and a frame from {found.frame_ms:.2f} to "
            f"{found.frame_ms_without:.2f} ms")  # fmt: skip


def lines(found: OnDemand) -> list[str]:
    """Return the messages about Gaussians that a run made independent of time, direction or AGR (a network)."""
    said = [of_gate(gate) for gate in found.gates]
    return said + ([of_direction(found.direction)] if found.direction else []) + found.notes

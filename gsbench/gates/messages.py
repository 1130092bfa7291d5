"""Write messages about removed effects, and about candidates that were compared on val; without torch."""

from gsbench.measure.exact_views import rank
from gsbench.measure.record import Candidate, Direction, Gate, LengthChoice, ModelComparison, OnDemand, TimeScreen

EFFECT_SETS = {  # the names of gsbench.models.effect_sets, in the same order, and their names in the legend
    "refined": "refined by AGR",
    "conditioned": "conditioned",
    "static": "static",
}


def of_screen(screen: TimeScreen) -> str:
    """Return the answer of the test whether the scene changes with time, and why it is the answer."""
    kept = ", so time is kept" if screen.decision == "undecided" else ""
    return f"time is {screen.decision}{kept}: {screen.reason}"


def of_comparison(comparison: ModelComparison) -> str:
    """Return the PSNR on val of each candidate of model=auto, and which of them was chosen."""
    return (
        f"PSNR on val after {comparison.iteration} iterations: {_of_candidates(comparison.candidates)}; "
        f"{comparison.chosen} is trained to the end{_tie(comparison.candidates)}"
    )


def of_lengths(choice: LengthChoice) -> str:
    """Return the PSNR on val of each length that was trained, and which of them is kept."""
    return (
        f"PSNR on val: {_of_candidates(choice.tried)}; the training of {choice.kept} iterations is kept"
        f"{_tie(choice.tried)}"
    )


def _of_candidates(candidates: list[Candidate]) -> str:
    return ", ".join(
        f"{x.name} {'-' if x.psnr_val is None else format(x.psnr_val, '.2f')} dB"
        if x.reason is None
        else f"{x.name} failed"
        for x in candidates
    )


def _tie(candidates: list[Candidate]) -> str:
    """Return an addition to a message if PSNR on val does not decide between the best candidates; otherwise ""."""
    ranks = {x.name: rank(x.psnr_val) for x in candidates if x.reason is None}
    best = [name for name, value in ranks.items() if value == max(ranks.values())]
    return f": PSNR cannot decide between {', '.join(best)}, so the last of them is taken" if len(best) > 1 else ""


def lines(on_demand: OnDemand) -> list[str]:
    """Return the messages about the effects that a run removed from its Gaussians."""
    direction = [_of_direction(on_demand.direction)] if on_demand.direction else []
    return [_of_gate(gate) for gate in on_demand.gates] + direction + on_demand.notes


def _of_gate(gate: Gate) -> str:
    """Return one line on a gate: how many Gaussians are left, and what it changed in PSNR, speed and size."""
    left = sum(count for name, count in gate.rows.items() if name != "removed")
    when = "after training" if gate.step is None else f"after step {gate.step}"
    by_effects = ", ".join(f"{gate.rows[name]} {words}" for name, words in EFFECT_SETS.items() if gate.rows.get(name))
    text = f"gate {when}: {left} of {left + gate.rows.get('removed', 0)} Gaussians are left"
    text += f" ({by_effects})" if by_effects else ""
    text += f"; PSNR on {gate.checked_on} {-gate.measured_db:+.3f} dB"
    if gate.eval_loss_db is not None:
        text += f", on the evaluated views {-gate.eval_loss_db:+.3f} dB"
    if gate.frame_ms_before and gate.frame_ms:
        text += f", a frame {gate.frame_ms_before:.2f} -> {gate.frame_ms:.2f} ms"
    text += f", {gate.bytes_before / 1e6:.2f} -> {gate.bytes / 1e6:.2f} MB"
    if gate.asleep:
        text += f"; in a frame, {gate.asleep:.0%} of AGR's Gaussians are invisible at its time and left out"
    return text


def _of_direction(direction: Direction) -> str:
    return (
        f"direction: {direction.kept:.0%} of the Gaussians depend on it; if none did, PSNR would change by "
        f"{-direction.loss_db:+.2f} dB and a frame from {direction.frame_ms:.2f} to "
        f"{direction.frame_ms_without:.2f} ms"
    )

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
    """Return which candidate of model=auto was chosen, and a table of all."""
    return (
        f"{comparison.chosen} is trained to the end, chosen after {comparison.iteration} iterations"
        f"{_tie(comparison.candidates)}\n{_table(comparison.candidates)}"
    )


def of_lengths(choice: LengthChoice) -> str:
    """Return which length is kept, and a table of all that were trained."""
    return f"the training of {choice.kept} iterations is kept{_tie(choice.tried)}\n{_table(choice.tried)}"


def _table(candidates: list[Candidate]) -> str:
    """Return the PSNR, the costs and, if it cannot be chosen, the reason of each candidate, as lines of text."""
    width = max(len(x.name) for x in candidates)
    lines = [f"{'':{width}}  PSNR on val, dB  training, s  ms a frame"]
    for x in candidates:
        psnr, frame = ("-" if value is None else f"{value:.2f}" for value in (x.psnr_val, x.frame_ms))
        lines.append(f"{x.name:{width}}  {psnr:>15}  {x.seconds:>11.1f}  {frame:>10}  {x.reason or ''}".rstrip())
    return "\n".join(lines)


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
    text += f"; PSNR on {gate.checked_on} {_signed(-gate.measured_db, 3)} dB"  # a loss as a negative change
    if gate.eval_loss_db is not None:
        text += f", on the evaluated views {_signed(-gate.eval_loss_db, 3)} dB"
    if gate.frame_ms_before and gate.frame_ms:
        text += f", a frame {gate.frame_ms_before:.2f} -> {gate.frame_ms:.2f} ms"
    text += f", {gate.bytes_before / 1e6:.2f} -> {gate.bytes / 1e6:.2f} MB"
    if gate.asleep:
        text += f"; in a frame, {gate.asleep:.0%} of AGR's Gaussians are invisible at its time and left out"
    return text


def _of_direction(direction: Direction) -> str:
    return (
        f"direction: {direction.kept:.0%} of the Gaussians depend on it; if none did, PSNR would change by "
        f"{_signed(-direction.loss_db, 2)} dB and a frame from {direction.frame_ms:.2f} to "
        f"{direction.frame_ms_without:.2f} ms"
    )


def _signed(value: float, digits: int) -> str:
    """Write a number with its sign; what rounds to zero has none."""
    text = f"{value:+.{digits}f}"
    return text if float(text) else text[1:]

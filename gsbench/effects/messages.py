"""Write the sentences about the chosen effects of a scene and its Gaussians; this module needs no torch."""

from gsbench.measure.record import Direction, Gate, OnDemand, TimeScreen

EFFECT_SETS = {  # of Gaussians: the names of gsbench.models.effect_sets, in its order, and what they are called
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
    """Say whether the model depends on time."""
    return f"time is {screen.decision}{', so it is simulated' if screen.decision == 'undecided' else ''}"


def of_screen(screen: TimeScreen) -> str:
    """Say whether the model depends on time, and why."""
    return f"{of_decision(screen)}: {screen.reason}"


def of_gate(gate: Gate) -> str:
    """Say how many Gaussians and effects are left after a removal of effects, and how many dB this cost."""
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
    """Say how many Gaussians depend on direction, and what freezing it in all of them would change."""
    return (f"direction: {found.kept:.0%} of the Gaussians keep it; freezing it in all would change PSNR by "
            f"{-found.loss_db:+.2f} dB and a frame from {found.frame_ms:.2f} to "
            f"{found.frame_ms_without:.2f} ms")  # fmt: skip


def lines(found: OnDemand) -> list[str]:
    """Return a sentence on each line about the effects that were removed; `of_screen` has the test for time."""
    said = [of_gate(gate) for gate in found.gates]
    return said + ([of_direction(found.direction)] if found.direction else []) + found.notes

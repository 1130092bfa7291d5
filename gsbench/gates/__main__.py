"""Test whether a scene needs time, or simplify the Gaussians of a trained model.

python -m gsbench.gates SCENE_FOLDER [--json]
python -m gsbench.gates --checkpoint RUN_FOLDER [--budget-db 0.05] [--data-root PATH]
"""

import argparse
import sys
from pathlib import Path
from typing import Any

from gsbench import scenes
from gsbench.config_roles import facts
from gsbench.errors import InputError, one_line, refuse_options
from gsbench.gates import messages
from gsbench.gates.screen import screen_time
from gsbench.models.registry import import_models
from gsbench.process.ending import end_with
from gsbench.reading import as_json

BUDGET = facts("effects.budget_db")
Answer = tuple[dict[str, Any], list[str]]  # the result of a command for JSON, and as lines


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return 0, or 2 after printing one line to stderr if an input is wrong."""
    parser = argparse.ArgumentParser(prog="python -m gsbench.gates", description=__doc__.partition("\n")[0])
    parser.add_argument("scene", type=Path, nargs="?", metavar="SCENE_FOLDER", help="of a data set that gsbench reads")
    parser.add_argument("--json", action="store_true", help="the answer as JSON")
    parser.add_argument("--seed", type=_whole, help="of the points and the permutations")
    parser.add_argument("--checkpoint", type=Path, metavar="RUN_FOLDER", help="gate this run into one beside it")
    parser.add_argument("--budget-db", type=float, help=f"{BUDGET.help} ({BUDGET.default:g})")
    parser.add_argument("--model-module", metavar="MODULE", help="that registers the run's model")
    parser.add_argument("--data-root", help="where the data set of the run is now")
    options = parser.parse_args(arguments)
    try:
        result, lines = _answer(options)
    except (InputError, OSError) as error:
        print(f"gsbench.gates: {one_line(error)}", file=sys.stderr)
        return 2
    print(as_json(result) if options.json else "\n".join(lines))
    return 0


def _whole(text: str) -> int:
    """Convert an argument of the command line to an int, from 40 characters: longer numbers are too large anyway."""
    try:
        return int(text[:40])
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a whole number, got {text[:30]!r}") from None


def _answer(options: argparse.Namespace) -> Answer:
    """Check the options, test a scene or simplify a run's Gaussians, and return the result for JSON and as lines."""
    if (options.scene is None) == (options.checkpoint is None):  # both or none
        raise InputError("expected one of SCENE_FOLDER and --checkpoint RUN_FOLDER")
    if options.checkpoint is not None:
        refuse_options(options, ("seed",), "--checkpoint")
    else:
        refuse_options(options, ("budget_db", "data_root", "model_module"), "SCENE_FOLDER")
    seed = options.seed or 0
    budget = BUDGET.default if options.budget_db is None else options.budget_db  # dB
    if not 0 <= seed < 2**63:
        raise InputError(f"--seed: expected 0 to 2^63 - 1, got {str(seed)[:30]}")
    BUDGET.check("--budget-db", budget)
    import_models(options.model_module)
    if options.checkpoint is not None:
        from gsbench.gates.finished import gate_finished  # imported here, because a screen needs no training code

        record, new = gate_finished(options.checkpoint, budget, options.data_root)
        assert record.on_demand is not None  # what the gate removed
        lines = [*messages.lines(record.on_demand), f"Written: {new}"]
        return {"on_demand": record.on_demand, "written": new}, lines
    screen = screen_time(scenes.load(options.scene), seed)
    return {"time": screen}, [messages.of_screen(screen)]


if __name__ == "__main__":
    end_with("gsbench.gates", main)

"""Test whether a scene needs time, or simplify the Gaussians of a trained model, or draw what its Gaussians depend on.

python -m gsbench.gates SCENE_FOLDER [--json]
python -m gsbench.gates --checkpoint RUN_FOLDER [--budget-db 0.05] [--data-root PATH]
python -m gsbench.gates --picture RUN_FOLDER --out FILE.png [--camera 0] [--time 0.5] [--data-root PATH]
"""

import argparse
import sys
from pathlib import Path
from typing import Any

from gsbench import scenes
from gsbench.as_json import as_json
from gsbench.config_roles import facts
from gsbench.errors import InputError, one_line
from gsbench.gates import messages
from gsbench.gates.screen import screen_time
from gsbench.models.registry import import_models
from gsbench.process.ending import end_with

BUDGET = facts("effects.budget_db")
Answer = tuple[dict[str, Any], list[str]]  # the result of a command for JSON, and as lines


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return 0, or 2 after printing one line to stderr if an input is wrong."""
    parser = argparse.ArgumentParser(prog="python -m gsbench.gates", description=__doc__.partition("\n")[0])
    parser.add_argument("scene", type=Path, nargs="?", metavar="SCENE_FOLDER", help="of a data set that gsbench reads")
    parser.add_argument("--json", action="store_true", help="the answer as JSON")
    parser.add_argument("--seed", type=_whole, default=0, help="of the points and the permutations")
    parser.add_argument("--checkpoint", type=Path, metavar="RUN_FOLDER", help="gate this run into one beside it")
    parser.add_argument("--budget-db", type=float, default=BUDGET.default, help=BUDGET.help)
    parser.add_argument("--picture", type=Path, metavar="RUN_FOLDER", help="draw its Gaussians by effect set")
    parser.add_argument("--camera", type=int, default=0, help="of --picture: the number of the evaluated view")
    parser.add_argument("--time", type=float, help="of --picture: in [0, 1]; that of the view by default")
    parser.add_argument("--out", type=Path, metavar="FILE.png", help="where --picture goes")
    parser.add_argument(
        "--model-module",
        metavar="MODULE",
        help="that registers the run's model",
    )
    parser.add_argument("--data-root", help="where the data set of the run is now")
    asked = parser.parse_args(arguments)
    try:
        if sum(one is not None for one in (asked.scene, asked.checkpoint, asked.picture)) != 1:
            raise InputError("expected one of SCENE_FOLDER, --checkpoint RUN_FOLDER and --picture RUN_FOLDER")
        if (asked.picture is None) != (asked.out is None):
            raise InputError("expected --picture RUN_FOLDER and --out FILE.png together")
        if asked.out is not None and (not asked.out.name or "\0" in str(asked.out)):
            raise InputError(f"--out: expected a file such as effect_sets.png, got {str(asked.out)!a:.200}")
        if not 0 <= asked.seed < 2**63:
            raise InputError(f"--seed: expected 0 to 2^63 - 1, got {str(asked.seed)[:30]}")
        BUDGET.check("--budget-db", asked.budget_db)
        import_models(asked.model_module)
        if asked.checkpoint is not None:
            result, lines = _gate(asked.checkpoint, asked.budget_db, asked.data_root)
        elif asked.picture is not None:
            result, lines = _draw(asked.picture, asked.camera, asked.time, asked.data_root, asked.out)
        else:
            found = screen_time(scenes.load(asked.scene), asked.seed)
            result, lines = {"time": found}, [messages.of_screen(found)]
    except (InputError, OSError) as error:
        print(f"gsbench.gates: {one_line(error)}", file=sys.stderr)
        return 2
    print(as_json(result) if asked.json else "\n".join(lines))
    return 0


def _whole(text: str) -> int:
    """Convert an argument of the command line to an int; only the first 40 characters are read."""
    try:
        return int(text[:40])
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a whole number, got {text[:30]!r}") from None


def _gate(folder: Path, budget_db: float, data_root: str | None) -> Answer:
    from gsbench.gates.finished import gate_finished  # imported here, because the test for time needs no training code

    record, new = gate_finished(folder, budget_db, data_root)
    said = messages.lines(record.on_demand) if record.on_demand else []
    return {"on_demand": record.on_demand, "written": new}, [*said, f"Written: {new}"]


def _draw(folder: Path, camera: int, time: float | None, data_root: str | None, out: Path) -> Answer:
    """Draw the Gaussians of a run by effect set, from the camera of an evaluated view, at a time or at that view's."""
    import torch

    from gsbench.gates.picture import draw
    from gsbench.measure.images import write_png
    from gsbench.run.checks import evaluated_views
    from gsbench.run.load import load_run, scene_of

    if time is not None and not 0 <= time <= 1:
        raise InputError(f"--time: expected 0 to 1, got {time}")
    run = load_run(folder)
    scene = scene_of(run, data_root)
    views = evaluated_views(scene, run.config.scene.eval_split)
    if not 0 <= camera < len(views):
        raise InputError(f"--camera: expected 0 to {len(views) - 1}, the evaluated views of {scene.name}, got {camera}")
    when, background = views[camera].time if time is None else time, torch.tensor(scene.background)
    write_png(draw(run.model, views[camera].camera, when, background, run.config.raster.antialias), out)
    return {"written": out}, [f"Written: {out}"]


if __name__ == "__main__":
    end_with("gsbench.gates", main)

"""Show trained models in a browser (``python -m gsbench.view RUN_FOLDER [RUN_FOLDER ...]``)."""

import argparse
import importlib.util
import sys
import time
import warnings
from pathlib import Path

from gsbench.errors import InputError, how_to_install, one_line, refuse_options
from gsbench.process.ending import end_with

HOST, PORT = "localhost", 8080


def main(arguments: list[str] | None = None) -> int:
    """Run the viewer until Ctrl-C; return 0, or 2 after an error, which is printed on stderr in one line."""
    parser = argparse.ArgumentParser(prog="python -m gsbench.view", description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN_FOLDER", help="results/EXPERIMENT/SCENE/MODEL/seedK")
    parser.add_argument("--page", type=Path, metavar="OUT.html", help="write a page that compares two runs, and end")
    parser.add_argument("--host", help="the address to listen on (localhost: this machine only)")
    parser.add_argument("--port", type=int, help="to listen on, or the next free one (8080)")
    parser.add_argument("--data-root", metavar="FOLDER", help="of the data set, where it has moved")
    parser.add_argument("--model-module", metavar="MODULE", help="that registers the run's model")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    options = parser.parse_args(arguments)
    try:
        serve(options)
    except (InputError, OSError) as error:
        print(f"gsbench.view: {one_line(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        pass
    return 0


def serve(options: argparse.Namespace) -> None:
    """Load the models of the given runs, and show them in the viewer until the user ends it, or write --page.

    Raises:
        InputError: viser is not installed, a folder has no checkpoint, or the runs are of different scenes.
        KeyboardInterrupt: the user ends the viewer with Ctrl-C.
    """
    if options.page is not None:
        refuse_options(options, ("host", "port"), "--page")
    elif importlib.util.find_spec("viser") is None:
        raise InputError(f"the viewer needs viser: {how_to_install('view')}", docs="viewing.md#the-viewer")
    host = HOST if options.host is None else options.host
    port = PORT if options.port is None else options.port
    if not 0 < port < 65536:
        raise InputError(f"--port: expected 1 to 65535, got {port}")
    from gsbench.models.registry import import_models
    from gsbench.run.load import load_run
    from gsbench.run.setup import check_device
    from gsbench.view.comparison_page import write_page
    from gsbench.view.video import check_file

    if options.page is not None:
        check_file("--page", options.page, ".html", ".htm")
    warnings.filterwarnings("ignore", "Queued a .* on a closed connection")  # viser's, when a browser leaves
    check_device(options.device)
    import_models(options.model_module)
    runs = [load_run(run, options.device) for run in options.runs]
    if options.page is not None:
        write_page(runs, options.page, options.data_root)
        print(f"Written: {options.page}")
        return
    from gsbench.view.viewer import Viewer

    viewer = Viewer(runs, host, port, options.data_root)
    for renderer in viewer.renderers:
        print(f"{renderer.name}: {', '.join(renderer.label[1:])} ({renderer.run.folder})")
    if isinstance(viewer.scene, str):
        print(f"no training cameras: {viewer.scene}")
    shown = f"[{host}]" if ":" in host else host
    print(f"Open http://{shown}:{viewer.server.get_port()} in a browser; Ctrl-C ends it.", flush=True)
    try:
        while True:
            time.sleep(1)  # not longer: Ctrl-C may reach another thread, and acts when this one wakes up
    finally:
        viewer.stop()


if __name__ == "__main__":
    end_with("gsbench.view", main)

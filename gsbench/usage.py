"""Say what a command line can choose: experiments, models and scenes, each by the first sentence of its YAML.

Hydra is not asked, as it would compose a config first, which takes a second. This module does not import torch.
"""

import argparse
import re
import textwrap
from collections.abc import Sequence
from pathlib import Path

from gsbench.config import CONF

WIDTH = 118  # characters of a line
_INDENT = 16  # of the sentences, characters
_SENTENCE_END = re.compile(r"\.\s+(?!\d)|[.:]$")  # not that of "et al. 2023"
USAGE = """\
gsbench: what a dimension of a Gaussian is worth, measured.

  python -m gsbench +exp=EXPERIMENT [model=MODEL] [scene=SCENE] [KEY=VALUE ...]
  python -m gsbench -m +exp=mini model=4dgs,6dgs,7dgs      one run for each
"""
MORE = """\
Often used: agr=true|false  seed=0  train.iterations=30000  scene.downscale=2  device=cpu  data.root=PATH
raster.backend=auto|reference|cpu|cuda. Every key: python -m gsbench +exp=EXPERIMENT --cfg job

Also: python -m gsbench doctor, and python -m gsbench.COMMAND --help of report, view, export, fetch, sweep, effects,
stability
"""
DESCRIBED = {  # config groups, and how they are chosen
    "exp": "Experiments, +exp=NAME",
    "model": "Models, model=NAME (7dgs)",
    "recipe": "Recipes of training, +recipe=NAME",
    "protocol": "Protocols of measuring, protocol=NAME (gsbench)",
    "launch": "Launchers of several runs, +launch=NAME (local)",
}


def text(words: Sequence[str]) -> str:
    """Return the help of `python -m gsbench`, with the user's own choices if the words name a --config-dir."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--config-dir", "-cd", type=Path)
    user = parser.parse_known_args(words)[0].config_dir
    folders = [CONF, *([user] if user else [])]
    lines = [USAGE]
    for group, title in DESCRIBED.items():
        lines += [f"{title}:"]
        for path in _files(folders, group):
            name, sentence = f"  {path.stem:{_INDENT - 2}}", first_sentence(path)
            lines += textwrap.wrap(sentence, WIDTH, initial_indent=name, subsequent_indent=" " * _INDENT) or [name]
        lines += [""]
    scenes = ", ".join(path.stem for path in _files(folders, "scene"))
    lines += ["Scenes, scene=NAME (all of the experiment; custom: any folder, with scene.name=FOLDER):"]
    lines += [*textwrap.wrap(scenes, WIDTH, initial_indent="  ", subsequent_indent="  ", break_on_hyphens=False), ""]
    return "\n".join([*lines, MORE])


def first_sentence(path: Path) -> str:
    """Return the first sentence of the comment at the head of a YAML file, without its end; "" if there is none."""
    comment: list[str] = []
    for line in path.read_text().splitlines():
        if not line.startswith("#") or line.startswith("#  "):  # a command
            break
        if not line.startswith("# @"):  # Hydra's
            comment.append(line.lstrip("# "))
    return _SENTENCE_END.split(" ".join(comment), maxsplit=1)[0]


def _files(folders: Sequence[Path], group: str) -> list[Path]:
    return sorted(path for folder in folders for path in (folder / group).glob("*.yaml"))

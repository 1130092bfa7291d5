"""Say what a command line can choose: experiments, models and scenes, each by the first sentence of its YAML.

Hydra is not asked, as it would compose a config first, which takes a second. This module does not import torch.
"""

import argparse
import re
import textwrap
from collections.abc import Sequence
from pathlib import Path

from gsbench.config import CONF, Config
from gsbench.config_key import declared
from gsbench.errors import InputError, did_you_mean

WIDTH = 118  # characters of a line
_INDENT = 16  # of the sentences, characters, at least
_MOST_INDENT = 30
_KEY_INDENT = 36  # of the meaning of keys, characters
_SENTENCE_END = re.compile(r"\.\s+(?!\d)|[.:]$")  # not that of "et al. 2023"
USAGE = """\
gsbench: what a dimension of a Gaussian is worth, measured.

  python -m gsbench +exp=EXPERIMENT [model=MODEL] [scene=SCENE] [KEY=VALUE ...]
  python -m gsbench -m +exp=mini model=4dgs,6dgs,7dgs      one run for each
"""
MORE = """\
Often used: agr=true|false  seed=0  train.iterations=30000  scene.downscale=2  device=cpu  data.root=PATH
raster.backend=auto|reference|cpu|cuda. Keys of a group, with their ranges: python -m gsbench --help train

Also: python -m gsbench doctor, and python -m gsbench.COMMAND --help of report, score, view, export, fetch, launch,
gates, stability
"""
DESCRIBED = {  # config groups, and how they are chosen
    "exp": "Experiments, +exp=NAME",
    "model": "Models, model=NAME (7dgs)",
    "recipe": "Recipes of training, +recipe=NAME",
    "protocol": "Protocols of measuring, protocol=NAME (gsbench)",
    "launch": "Launchers of several runs, +launch=NAME (local)",
}


def text(words: Sequence[str]) -> str:
    """Return the help of `python -m gsbench`, with the user's choices if the words name a --config-dir.

    With words that are config keys or groups of keys, such as `--help train.densify`, return what these keys mean.
    """
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--config-dir", "-cd", type=Path)
    options, others = parser.parse_known_args(words)
    user = options.config_dir
    if prefixes := [word for word in others if not word.startswith("-") and "=" not in word]:
        return keys(prefixes)
    folders = [CONF, *([user] if user else [])]
    lines = [USAGE]
    for group, title in DESCRIBED.items():
        lines += [f"{title}:"]
        paths = _files(folders, group)
        indent = min(_MOST_INDENT, max([_INDENT, *(len(path.stem) + 4 for path in paths)]))
        for path in paths:
            name = f"  {path.stem}  ".ljust(indent)
            lines += textwrap.wrap(name + first_sentence(path), WIDTH, subsequent_indent=" " * indent)
        lines += [""]
    scenes = ", ".join(path.stem for path in _files(folders, "scene"))
    lines += ["Scenes, scene=NAME (all of the experiment; custom: any folder, with scene.name=FOLDER):"]
    lines += [*textwrap.wrap(scenes, WIDTH, initial_indent="  ", subsequent_indent="  ", break_on_hyphens=False), ""]
    return "\n".join([*lines, MORE])


def keys(prefixes: Sequence[str]) -> str:
    """Return a line for each config key that begins with one of the prefixes: default, meaning, range.

    Raises:
        InputError: no key begins so.
    """
    known = declared(Config)
    lines = []
    for prefix in prefixes:
        of_prefix = {name: facts for name, facts in known.items() if f"{name}.".startswith(f"{prefix}.")}
        if not of_prefix:
            groups = {name.partition(".")[0] for name in known}
            raise InputError(f"--help {prefix}: expected a config key. {did_you_mean(prefix, groups)}")
        for name, facts in of_prefix.items():
            about = "; ".join(filter(None, (facts.help, f"{facts.range} {facts.unit}".strip())))
            word = f"{name}={facts.shown}"
            lines += textwrap.wrap(f"{word:{_KEY_INDENT - 1}} {about}", WIDTH, subsequent_indent=" " * _KEY_INDENT)
    return "\n".join([*lines, ""])


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

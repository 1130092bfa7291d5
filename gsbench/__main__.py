"""Compose configs from the command line and do their runs, without torch until the first one starts."""

import os
import signal
import sys
import warnings
from pathlib import Path

import hydra
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsbench.config import CONF, HERE, register_schema
from gsbench.errors import InputError, did_you_mean
from gsbench.run.stop import Stopped, stop_at_once
from gsbench.sweep.axes import expand
from gsbench.sweep.finish import see_through
from gsbench.sweep.hooks import started
from gsbench.sweep.task import do

_failures: list[str] = []  # one line for each run that did not end well; a Hydra sweep goes on after it


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def entry(composed: DictConfig) -> None:
    """Do one run of the sweep; one that fails does not stop the others."""
    if OmegaConf.is_missing(composed, "experiment"):
        raise InputError(f"no experiment was chosen: add +exp=NAME. Valid: {', '.join(_group('exp'))}.")
    if composed.experiment == "stability":  # the only experiment that trains no model on a scene
        from gsbench.stability.__main__ import main as audit

        if audit(["--out", str(Path(composed.results) / "stability")]):
            _failures.append("stability: a default breaks its bound")
        return
    if OmegaConf.is_missing(composed.data, "root"):
        raise InputError(f"data.root is not set: add data.root=PATH, the folder that holds the scenes of "
                         f"{composed.data.dataset} ({', '.join(composed.data.scenes)}), each with "
                         f"transforms_{{train,val,test}}.json and the images they name. "
                         f"Published at: {composed.data.published}")  # fmt: skip
    problem = do(composed)
    if problem:
        _failures.append(problem)


def main() -> None:
    """Run the commands `python -m gsbench` and `gsbench`; print an error as one line instead of a stack trace."""
    register_schema()
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # Hydra raises its errors, and they are explained in one line below
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(errors="replace")  # type: ignore[union-attr]  # a terminal in ASCII shows ? for other letters
    signal.signal(signal.SIGTERM, stop_at_once)
    warnings.formatwarning = _in_one_line
    try:
        sys.argv[1:] = expand(sys.argv[1:])
        broken = see_through(entry, started)
    except InputError as error:
        sys.exit(f"gsbench: error: {error}")
    except (HydraException, OmegaConfBaseException) as error:
        sys.exit(f"gsbench: error: {_explain(error)}")
    except OSError as error:  # of Hydra's own files; a run's errors end in its record
        sys.exit(f"gsbench: error: {error.filename}: {error.strerror}")
    except (Stopped, KeyboardInterrupt) as stopped:
        print(f"gsbench: {str(stopped) or 'stopped by SIGINT'}", file=sys.stderr)
        sys.exit(stopped.code if isinstance(stopped, Stopped) else 128 + signal.SIGINT)
    if broken:
        print(f"gsbench: {len(broken)} runs did not end well: python -m gsbench.sweep status "
              f"{started[0].parents[1]}", file=sys.stderr)  # fmt: skip
    sys.exit(1 if _failures or broken else 0)


_in_two_lines = warnings.formatwarning


def _in_one_line(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
) -> str:
    """Format a warning of gsbench as its errors are, without the line of code that Python adds."""
    if not Path(filename).is_relative_to(HERE):
        return _in_two_lines(message, category, filename, lineno, line)
    return f"gsbench: warning: {message}\n"


def _group(name: str) -> list[str]:
    return sorted(path.stem for path in (CONF / name).glob("*.yaml"))


def _explain(error: Exception) -> str:
    """Explain an error of Hydra or OmegaConf in one line that names the key and the nearest valid one."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file and error.options:
        group, _, name = error.missing_cfg_file.rpartition("/")
        if group == "hydra/launcher":
            return "+launch=slurm and +launch=parallel need packages of their own: pip install 'gsbench[cluster]'"
        return f"{group} '{name}' is not known. {did_you_mean(name, error.options)}"
    cause = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else error
    if isinstance(cause, OmegaConfBaseException) and cause.key is not None and cause.parent_node is not None:
        keys = [str(key) for key in cause.parent_node] if isinstance(cause.parent_node, DictConfig) else []
        if keys and cause.key not in keys:
            return f"config key '{cause.full_key}' is not known. {did_you_mean(str(cause.key), keys)}"
        return f"config key '{cause.full_key}': {str(cause).splitlines()[0]}"
    return " ".join(str(error).split())


if __name__ == "__main__":
    main()

"""Explain in one line why Hydra, OmegaConf or a launcher rejects a command line or a config."""

import re
import traceback

from hydra.errors import MissingConfigException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from gsbench.errors import did_you_mean
from gsbench.extras import how_to_install
from gsbench.run.grammar import typed

LIBRARIES = ("hydra", "omegaconf", "antlr4", "submitit")
AMBIGUOUS = re.compile(r"Ambiguous value for argument '((.*?)=(.*))'\n")  # Hydra's, of a sweep without --multirun
NO_SLURM = 'Could not detect "srun"'  # how submitit says so


def explain(error: Exception) -> str:
    """Explain an error of Hydra, OmegaConf or a launcher in one line, with the wrong key and the most similar one."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file and error.options:
        group, _, name = error.missing_cfg_file.rpartition("/")
        if group == "hydra/launcher":
            return f"+launch=slurm needs packages of its own: {how_to_install('cluster')}"
        return f"{group} '{name}' is not known. {did_you_mean(name, error.options)}"
    cause = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else error
    if isinstance(cause, OmegaConfBaseException) and cause.key is not None and cause.parent_node is not None:
        keys = [str(key) for key in cause.parent_node] if isinstance(cause.parent_node, DictConfig) else []
        if keys and cause.key not in keys:
            return f"config key '{cause.full_key}' is not known. {did_you_mean(str(cause.key), keys)}"
        return f"config key '{cause.full_key}': {str(cause).splitlines()[0]}"
    if ambiguous := AMBIGUOUS.match(str(error)):
        word, key, text = ambiguous.groups()
        return (f"{word}: commas separate the values of a sweep: type -m too for a run of each, or "
                f"{typed(key, text, several=False)} for one value")  # fmt: skip
    if str(error).startswith(NO_SLURM):
        return ("+launch=slurm: expected a machine of a Slurm cluster, srun is not on PATH: use its login node, or "
                "+launch=parallel (docs/runs.md#slurm-from-a-login-node-to-the-table)")  # fmt: skip
    return " ".join(str(error).split())


def raised_by_library(error: Exception) -> bool:
    """Tell whether Hydra or a launcher's library raised an error itself, for example because of wrong settings.

    If a run in another process fails, the launcher's library raises the run's error again. Such an error has a cause,
    which holds the original traceback. It does not count as an error of the library.
    """
    *_, (frame, _) = traceback.walk_tb(error.__traceback__)
    return error.__cause__ is None and str(frame.f_globals.get("__name__")).partition(".")[0] in LIBRARIES

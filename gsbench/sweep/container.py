"""Run the Slurm jobs of a sweep in a container image, with the folders bound that their runs read and write.

submitit starts a job by the Python of this process. A script in the sweep's folder takes its place: it starts the
image's Python. Slurm's commands are not in an image, so a job that must be requeued asks the script by an exit status.
submitit has no option for either: this module replaces two of its methods.
"""

import functools
import inspect
import os
import re
import shlex
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsbench.config import CONF
from gsbench.errors import InputError

SCRIPT, REQUEUE = "container.sh", 99
PLACES = ("results", "data.root", "init.ply", "protocol.lpips_alex", "protocol.lpips_vgg")  # keys that hold a path
_DECIDE_PLACES = re.compile(r"\+*(exp|results|data|init|protocol)\b")
_CONTENT = """\
#!/bin/bash
# Written by gsbench: the Python of a job of this sweep.
trap : USR2 TERM  # signals of Slurm are for the process in the image, which saves its run
{command} --bind {binds} --pwd {cwd} {image} {python} -P "$@"
status=$?
[ $status -eq {requeue} ] && exec scontrol requeue "$SLURM_JOB_ID"
exit $status
"""


def use(config: DictConfig, runs: Sequence[Sequence[str]]) -> None:
    """Let submitit start the jobs of a sweep in the image of `launch.container`, or without one if the key is null.

    The image is looked for when submitit makes its executor, as Hydra hides errors of callbacks. Then an `InputError`
    says that the image is missing or that a path cannot be bound, before anything is submitted.
    """
    if not config.hydra.runtime.choices["hydra/launcher"].startswith("submitit"):
        return
    from submitit.slurm.slurm import SlurmExecutor

    usual = inspect.unwrap(SlurmExecutor.__init__)
    if config.launch.container is None:
        SlurmExecutor.__init__ = usual  # type: ignore[method-assign]
        return
    script = functools.cache(lambda: shlex.quote(str(_write(config, runs))))

    @functools.wraps(usual)
    def with_script(self: Any, *args: Any, **kwargs: Any) -> None:
        usual(self, *args, **kwargs | {"python": script()})

    SlurmExecutor.__init__ = with_script  # type: ignore[method-assign]


def enter() -> None:
    """Prepare the process of a job in an image: modules of the current folder, and requeues without `scontrol`.

    Modules of the image come first (`python -P`): a checkout in the current folder has no kernels for the image.
    """
    sys.path.append(os.getcwd())
    if shutil.which("scontrol") is None:
        from submitit.slurm.slurm import SlurmJobEnvironment

        SlurmJobEnvironment._requeue = _ask_for_requeue  # type: ignore[assignment, method-assign]


def _ask_for_requeue(_: Any, __: int) -> None:
    sys.exit(REQUEUE)


def _write(config: DictConfig, runs: Sequence[Sequence[str]]) -> Path:
    """Write the script into the sweep's folder and return its absolute path."""
    image = Path(config.launch.container).absolute()
    if not image.exists():
        raise InputError(f"launch.container: expected an image, a file or folder that all nodes see, got '{image}', "
                         "which does not exist: build one", docs="install.md#in-a-container")  # fmt: skip
    binds = sorted(_binds(config, runs))
    for path in binds:
        if "," in path or ":" in path:
            raise InputError(f"launch.container: expected folders without ',' and ':', which part the folders that are "
                             f"bound, got '{path}': rename it")  # fmt: skip
    script = Path(config.hydra.sweep.dir).absolute() / SCRIPT
    script.write_text(
        _CONTENT.format(
            command=config.launch.container_command + (" --nv" if config.launch.gpus else ""),
            binds=shlex.quote(",".join(binds)),
            cwd=shlex.quote(os.getcwd()),
            image=shlex.quote(str(image)),
            python=f"python{sys.version_info.major}.{sys.version_info.minor}",  # what pickled the runs must read them
            requeue=REQUEUE,
        )
    )
    script.chmod(0o755)
    return script


def _binds(config: DictConfig, runs: Sequence[Sequence[str]]) -> set[str]:
    """Return the existing folders and files that the runs of a sweep read and write."""
    found = {os.getcwd(), str(Path(config.hydra.sweep.dir).absolute()), str(CONF)}  # Hydra composes a run in its job
    for overrides in {tuple(one for one in run if _DECIDE_PLACES.match(one)) for run in runs}:
        loader = GlobalHydra.instance().config_loader()
        found |= set(_places(loader.load_sweep_config(config, list(overrides))))
    if torch_home := os.environ.get("TORCH_HOME"):
        found.add(os.path.abspath(torch_home))
    return {path for path in found if os.path.exists(path)}


def _places(config: DictConfig) -> Iterator[str]:
    for key in PLACES:
        try:
            value = OmegaConf.select(config, key)
        except OmegaConfBaseException:  # it names a variable that only the node has, such as TMPDIR
            continue
        if value is not None and not value.startswith("pkg://"):
            yield os.path.abspath(value)

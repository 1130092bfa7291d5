"""Slurm jobs in a container image: Slurm and Apptainer are fakes on PATH, which note their arguments and go on."""

import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest
from omegaconf import DictConfig, OmegaConf
from tiny_run import ROOT, gsbench, overrides, write_moving_square

from gsbench.config import CONF
from gsbench.errors import InputError
from gsbench.sweep import container, plan, status
from gsbench.sweep.plan import Plan
from gsbench.sweep.retry import retry

FAKES = {
    "sbatch": """
        echo "$*" >> {log}/sbatch
        last=$(sed -n 's/^#SBATCH --array=0-\\([0-9]*\\).*/\\1/p' "$1")
        for task in $(seq 0 "$last"); do
          SLURM_JOB_ID=7$task SLURM_ARRAY_JOB_ID=7 SLURM_ARRAY_TASK_ID=$task setsid bash "$1" > {log}/job$task 2>&1 &
        done
        echo Submitted batch job 7
        """,
    "srun": """
        while [ "${{1#--}}" != "$1" ]; do
          case $1 in --output|--error) shift;; esac
          shift
        done
        exec "$@"
        """,
    "sacct": "printf 'JobID|State|NodeList\\n7_0|RUNNING|n\\n7_1|RUNNING|n\\n'",
    "squeue": "exit 0",
    "scontrol": 'echo "$*" >> {log}/scontrol',
    # What is in the image is this Python; Slurm's commands are not.
    "apptainer": """
        printf '%s\\n' "$@" > {log}/apptainer.$$
        while [ "${{1%.sif}}" = "$1" ]; do shift; done
        shift
        PATH={python}:/usr/bin:/bin exec "$@"
        """,
}


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of notes of fakes, which come first on PATH."""
    folder, fakes = tmp_path / "log", tmp_path / "fakes"
    for one in (folder, fakes):
        one.mkdir()
    for name, text in FAKES.items():
        path = fakes / name
        path.write_text("#!/bin/bash\n" + text.format(log=folder, python=Path(sys.executable).parent))
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{fakes}:{os.environ['PATH']}")
    return folder


def asked(log: Path) -> list[list[str]]:
    return [path.read_text().splitlines() for path in sorted(log.glob("apptainer.*"))]


@pytest.mark.slow
def test_each_job_runs_in_the_image(log: Path, tmp_path: Path) -> None:
    """Catches an array whose jobs run outside of the image, and results or data that the image does not see."""
    image, results = tmp_path / "gsbench.sif", tmp_path / "results"
    image.touch()
    data = write_moving_square(tmp_path / "data")
    words = overrides(data, results, "+launch=slurm", f"launch.container={image}", "launch.gpus=1", "seed=0,1")
    done = gsbench("-m", *words)
    assert done.returncode == 0, done.stderr + "".join(path.read_text() for path in results.rglob("*.err"))
    assert [run.state for run in status.status(status.read(results / "dnerf"))] == ["done"] * 2
    one, other = asked(log)
    assert one == other
    binds = one[one.index("--bind") + 1].split(",")
    assert {str(results), str(data), str(ROOT), str(CONF)} <= set(binds)
    assert [*one[:3], *one[4:-1]] == [
        "exec", "--nv", "--bind", "--pwd", str(ROOT), str(image), f"python3.{sys.version_info.minor}", "-P", "-u",
        "-m", "submitit.core._submit",
    ]  # fmt: skip


def test_a_missing_image_is_told_before_anything_is_submitted(log: Path, tmp_path: Path) -> None:
    """Catches an array of jobs that all fail because of a name mistyped once."""
    data = write_moving_square(tmp_path / "data")
    gone = tmp_path / "gone.sif"
    words = overrides(data, tmp_path / "results", "+launch=slurm", f"launch.container={gone}", "seed=0,1")
    done = gsbench("-m", *words)
    assert done.returncode == 2
    assert f"launch.container: expected an image, a file or folder that all nodes see, got '{gone}'" in done.stderr
    assert not (log / "sbatch").exists()


def script(folder: Path, command: str, image: str = "gsbench.sif") -> Path:
    """The script of a sweep in `folder`, whose image is there, with another command than Apptainer."""
    (folder / image).touch()
    return container._write(config(folder, str(folder / image), command), [])


def config(folder: Path, image: str | None, command: str = "apptainer exec") -> DictConfig:
    launch = {"container": image, "container_command": command, "gpus": None}
    hydra = {"sweep": {"dir": str(folder)}, "runtime": {"choices": {"hydra/launcher": "submitit_slurm"}}}
    return OmegaConf.create({"launch": launch, "hydra": hydra})


def test_a_retry_runs_in_the_image(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a retry that leaves the image out, and so trains by other versions than the sweep did."""
    monkeypatch.chdir(tmp_path)
    words = ["+exp=mini", "scene=suzanne", "+launch=slurm", "launch.container=gone.sif"]
    asked = Plan("submitit_slurm", [words], [], str(tmp_path), "elsewhere", 1, 1, 0.0)
    plan.write(asked, tmp_path / "mini" / plan.FOLDER / "2026-11-22_00-00-00.000000")
    assert retry(status.read(tmp_path / "mini"), [], print) == 1
    assert (
        f"expected an image, a file or folder that all nodes see, got '{tmp_path}/gone.sif'" in capsys.readouterr().err
    )
    assert not (log / "sbatch").exists()


@pytest.mark.usefixtures("log")
def test_an_image_is_of_one_sweep(tmp_path: Path) -> None:
    """Catches a retry whose second sweep, without an image, runs in the image of the first."""
    from submitit.slurm.slurm import SlurmExecutor

    (tmp_path / "gsbench.sif").touch()
    container.use(config(tmp_path, str(tmp_path / "gsbench.sif")), [])
    assert SlurmExecutor(tmp_path, 3).python == str(tmp_path / container.SCRIPT)
    container.use(config(tmp_path, None), [])
    assert SlurmExecutor(tmp_path, 3).python == sys.executable


def test_a_job_is_requeued_from_outside_of_the_image(log: Path, tmp_path: Path) -> None:
    """Catches a run that ends with its first job, as the image has no scontrol or Slurm's signal ends the script."""
    ready = tmp_path / "ready"
    saves = f"bash -c 'trap \"exit {container.REQUEUE}\" USR2; touch {ready}; while :; do sleep 0.05; done'"
    job = subprocess.Popen(
        [script(tmp_path, saves)], env=os.environ | {"SLURM_JOB_ID": "7"}, start_new_session=True
    )  # fmt: skip
    while not ready.exists():
        time.sleep(0.01)
    os.killpg(job.pid, signal.SIGUSR2)  # as Slurm does: to every process of the job's step
    assert job.wait(30) == 0
    assert (log / "scontrol").read_text() == "requeue 7\n"
    assert subprocess.run([script(tmp_path, "bash -c 'exit 3'")], check=False).returncode == 3


def test_a_job_in_the_image_asks_for_its_requeue(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a job that calls scontrol, which the image does not have, and a model of one's own that is not found."""
    from submitit.slurm.slurm import SlurmJobEnvironment

    monkeypatch.setattr(SlurmJobEnvironment, "_requeue", SlurmJobEnvironment._requeue)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    container.enter()
    assert sys.path[-1] == str(tmp_path)
    with pytest.raises(SystemExit) as ended:
        SlurmJobEnvironment()._requeue(1)
    assert ended.value.code == container.REQUEUE


def test_a_folder_that_cannot_be_bound_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a folder that Apptainer would read as two."""
    (tmp_path / "a,b").mkdir()
    monkeypatch.chdir(tmp_path / "a,b")
    with pytest.raises(InputError, match="a,b': rename it"):
        script(tmp_path / "a,b", "true")

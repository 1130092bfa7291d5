"""Jobs of Slurm, in a container image too: Slurm and Apptainer are fakes on PATH that note their arguments."""

import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tiny_run import ROOT, gsbench, overrides

from gsbench.errors import InputError
from gsbench.launch import plan, processes, slurm, status
from gsbench.launch.__main__ import main
from gsbench.launch.command import RunConfig, compose_run, hydra_with
from gsbench.launch.plan import Ended, Plan
from gsbench.launch.slurm import SCRIPT, STOPPED, in_container
from gsbench.launch.sweep import retry
from gsbench.run import stop

FAKES = {
    # The jobs of an array, one after the other; a job of which a run asks for it is put back and begins again.
    "sbatch": """
        printf '%s\\n' "$@" >> {log}/sbatch
        for word in "$@"; do
          case $word in --array=*) last=${{word#*-*-*-}};; --output=*) output=${{word#*=}};; esac
          script=$word
        done
        for task in $(seq 0 "${{last%\\%*}}"); do
          until SLURM_JOB_ID=7$task SLURM_ARRAY_JOB_ID=7 SLURM_ARRAY_TASK_ID=$task SLURM_CPUS_PER_TASK=1 \\
              bash "$script" >> "${{output/\\%a/$task}}" 2>&1; [ ! -e {log}/again ]; do rm {log}/again; done
        done
        echo "7;cluster"
        """,
    "srun": """
        while [ "${{1#--}}" != "$1" ]; do shift; done
        exec "$@"
        """,
    "squeue": "exit 0",
    "scontrol": 'echo "$*" >> {log}/scontrol; touch {log}/again',
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
    for path in (folder, fakes):
        path.mkdir()
    for name, text in FAKES.items():
        path = fakes / name
        path.write_text("#!/bin/bash\n" + text.format(log=folder, python=Path(sys.executable).parent))
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{fakes}:{os.environ['PATH']}")
    return folder


def test_each_run_is_a_job_in_the_image(log, square, tmp_path):
    """Catches jobs outside of the image, results or data that it does not see, and settings that Slurm does not get."""
    image, results = tmp_path / "gsbench.sif", tmp_path / "results"
    image.touch()
    of_jobs = ["+launch=slurm", f"launch.container={image}", "launch.gpus=1", "launch.at_once=3", "launch.minutes=7"]
    of_jobs += ["+launch.sbatch.account=vision", "launch.memory=1G", "+launch.sbatch.requeue=false"]
    words = overrides(square, results, *of_jobs, "seed=0,1", "model=3dgs", "train.iterations=2")
    ended = gsbench("-m", *words)
    assert ended.returncode == 0, ended.stderr + "".join(path.read_text() for path in results.rglob("*.log"))
    runs = status.status(status.read(results / "dnerf"))
    assert [(run.state, run.job) for run in runs] == [("done", None)] * 2
    asked = (log / "sbatch").read_text().splitlines()
    options = {"--array=0-1%3", "--time=7", "--mem=1G", "--gpus-per-node=1", "--account=vision", "--signal=USR2@120"}
    assert options | {"--cpus-per-task=4", "--job-name=dnerf", "--open-mode=append"} <= set(asked)
    assert not [word for word in asked if "requeue" in word or "partition" in word]
    in_image, other = [path.read_text().splitlines() for path in sorted(log.glob("apptainer.*"))]
    assert in_image[:-1] == other[:-1]
    assert {in_image[-1], other[-1]} == {"0", "1"}
    assert {str(results), str(square), str(ROOT)} <= set(in_image[in_image.index("--bind") + 1].split(","))
    (folder,) = results.glob("dnerf/.sweep/*")
    program = ["python3", "-P", "-u", "-m", "gsbench.launch", "job", str(folder)]
    assert [*in_image[:3], *in_image[4:-1]] == ["exec", "--nv", "--bind", "--pwd", str(ROOT), str(image), *program]


def test_a_stopped_run_is_requeued_as_often_as_it_may(log, tmp_path):
    """Catches a run that ends with its first job, as Slurm's signal ends the script, and one that never ends."""
    ready, script = tmp_path / "ready", tmp_path / "job.sh"
    run = f"bash -c 'trap \"exit {STOPPED}\" USR2; touch {ready}; while :; do sleep 0.05; done' --"
    script.write_text(SCRIPT.format(setup=":", command=run, folder=tmp_path, stopped=STOPPED, requeues=2))
    for status_of_job in (0, 0, STOPPED):
        ready.unlink(missing_ok=True)
        environment = os.environ | {"SLURM_JOB_ID": "70", "SLURM_ARRAY_TASK_ID": "0"}
        job = subprocess.Popen(["bash", script], env=environment, start_new_session=True)
        while not ready.exists():
            time.sleep(0.01)
        os.killpg(job.pid, signal.SIGUSR2)
        assert job.wait(30) == status_of_job
    assert (log / "scontrol").read_text() == "requeue 70\n" * 2


def test_a_job_listens_before_it_reads_its_plan(tmp_path, monkeypatch):
    """Catches a job that Slurm's signal kills without a word while it loads."""
    heard: list[bool] = []
    monkeypatch.setattr(stop, "listen", lambda: heard.append(True))
    monkeypatch.setattr(sys, "path", [*sys.path])
    assert main(["job", str(tmp_path), "0"]) == 2  # there is no plan
    assert heard


def test_a_job_ends_with_the_status_of_its_run(tmp_path, monkeypatch):
    """Catches a failed run that Slurm has as completed, another run of the plan, and a model that is not imported."""
    monkeypatch.setattr(stop, "listen", lambda: None)
    monkeypatch.setattr(sys, "path", [])
    plan.write(Plan("slurm", [["+exp=mini", "scene=suzanne", f"seed={seed}"] for seed in (5, 6)]), tmp_path)
    for ended, code in ((Ended("record.json"), 0), (Ended(reason="it diverged"), 1)):
        done: list[tuple[int, int, int]] = []

        def do(config: RunConfig, _: Path, number: int, at_once: int, ended: Ended = ended) -> Ended:
            done.append((config.config.seed, number, at_once))  # noqa: B023  it is called in this round
            return ended

        monkeypatch.setattr(processes, "do_planned", do)
        assert main(["job", str(tmp_path), "1"]) == code
        assert done == [(6, 1, 0)]
    assert os.getcwd() in sys.path


def test_a_run_that_slurm_stops_goes_on_in_its_next_job(log, square, tmp_path):
    """Catches USR2 that kills a run with its last minutes, and a job that begins from the first step again."""
    (tmp_path / "fakes" / "srun").write_text(
        "#!/bin/bash\nshift\n"
        f'"$@" & until grep -q \'"step": [1-9]\' {tmp_path}/results/dnerf/*/*/*/progress.json; do sleep 0.02; done\n'
        f"[ -e {log}/scontrol ] || kill -USR2 $!\nwait $!\n"
    )
    words = overrides(
        square, tmp_path / "results", "+launch=slurm", "model=3dgs", "train.iterations=10000", "train.densify.stop=1"
    )
    sweep = gsbench("-m", *words, "train.checkpoint_minutes=60", "train.curve_points=3")
    (path,) = (tmp_path / "results").rglob("0.log")
    assert (log / "scontrol").read_text() == "requeue 70\n", path.read_text()
    assert "continues from step" in path.read_text()
    assert sweep.returncode == 0, sweep.stderr


def test_a_missing_image_is_named_before_anything_is_submitted(log, tmp_path, monkeypatch, capsys):
    """Catches an array of jobs that all fail because of a name mistyped once, and a retry that leaves the image out."""
    monkeypatch.chdir(tmp_path)
    words = ["+exp=mini", "scene=suzanne", "+launch=slurm", "launch.container=gone.sif"]
    folder = tmp_path / "mini" / plan.FOLDER / "2026-11-22_00-00-00.000000"
    plan.write(Plan("slurm", [words], born=None, started=0.0), folder)
    assert retry(status.read(tmp_path / "mini"), []) == 1
    message = f"expected an image, a file or folder that all nodes see, got '{tmp_path}/gone.sif'"
    assert message in capsys.readouterr().err
    assert not (log / "sbatch").exists()
    assert [path.parent for path in plan.find(tmp_path / "mini")] == [folder]


def test_what_a_cluster_prints_besides_is_passed_by(log, tmp_path):
    """Catches a stack trace, or jobs that nobody waits for, where SLURM_CLUSTERS or a site's own sbatch adds a line."""
    squeue, sbatch = (log.with_name("fakes") / name for name in ("squeue", "sbatch"))
    squeue.write_text("#!/bin/bash\necho 'CLUSTER: east'\necho '7 0 PENDING Priority'\necho '7 1 RUNNING'\n")
    assert slurm.queue(["7_0"]).states == {"7_0": "PENDING Priority", "7_1": "RUNNING"}
    with hydra_with(None):
        configs = [compose_run(["+exp=mini", "scene=suzanne", "+launch=slurm"])]
    (tmp_path / "job").mkdir()
    for printed, job in (("Welcome to east\\n7;east", "7"), ("Welcome", None)):
        sbatch.write_text(f"#!/bin/bash\nprintf '{printed}\\n'\n")
        squeue.write_text('#!/bin/bash\n[ "$4" = 7 ] || echo "7 0 RUNNING"\n')
        if job is None:
            with pytest.raises(InputError, match="expected the number of a job, got 'Welcome"):
                slurm.launch(configs, Plan("slurm", []), tmp_path / "job")
        else:
            slurm.launch(configs, Plan("slurm", []), tmp_path / "job")
            assert plan.read(tmp_path / "job" / plan.FILE_NAME).job == job


@pytest.mark.parametrize("name", ["a,b", "a:b"])
def test_a_folder_that_cannot_be_bound_is_refused(name, tmp_path, monkeypatch):
    """Catches a folder that Apptainer would read as two."""
    folder = tmp_path / name
    folder.mkdir()
    monkeypatch.chdir(folder)
    plan.write(Plan("slurm", []), folder)
    (folder / "x.sif").touch()
    with hydra_with(None):
        config = compose_run(["+exp=mini", "scene=suzanne", "launch.container=x.sif"])
    with pytest.raises(InputError, match=f"{name}': rename it"):
        in_container([config], folder)


def test_jobs_that_slurm_refuses_leave_no_plan(log, tmp_path):
    """Catches runs that wait for ever for jobs that were never accepted."""
    (log.parent / "fakes" / "sbatch").write_text("#!/bin/bash\necho 'sbatch: error: invalid partition' >&2; exit 1\n")
    ended = gsbench("+exp=mini", "scene=suzanne", "+launch=slurm", f"results={tmp_path / 'results'}")
    assert ended.returncode == 2
    assert ended.stderr.splitlines()[-1] == "gsbench: error: Slurm refused the jobs: sbatch: error: invalid partition"
    assert not plan.find(tmp_path / "results" / "mini")

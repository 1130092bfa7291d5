"""The worked example of docs/adding_a_model.md, run as a reader would run it."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from forked import python
from tiny_run import ROOT, environment, overrides, write_moving_square

from benchmarks.against import WITHOUT_EDITABLE
from gsbench.measure import record
from gsbench.measure.record import Record
from gsbench.scenes.gaussian_ply import ply_of, read_trained


def blocks() -> dict[str, str]:
    """The example's two files by their path in the project."""
    page = (ROOT / "docs" / "adding_a_model.md").read_text()
    results = re.findall(r"^`([\w/]+\.(?:py|yaml))`:\n\n```\w+\n(.*?)^```", page, flags=re.MULTILINE | re.DOTALL)
    assert len(results) == 2
    return dict(results)


METHODS_FOR_GATES = """
    def static(self, raw: Raw) -> Conditioned:
        return self.condition(raw, CameraTime(raw["means"].new_zeros(3), None))

    def frozen(self, raw: Raw, queries: Sequence[CameraTime], weights: Tensor) -> dict[str, Raw]:
        return {}
"""


# An editable install finds gsbench by a hook that goes before PYTHONPATH; the copy is what is to be run.
START = f"import runpy, sys\n{WITHOUT_EDITABLE}\nrunpy.run_module(sys.argv.pop(1), run_name='__main__', alter_sys=True)"


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the project with the page's two files; `gated_balls`, which have the two methods for gates, and
    `blinks`, which are balls that are said to observe time."""
    project = tmp_path_factory.mktemp("project")
    shutil.copytree(ROOT / "gsbench", project / "gsbench", ignore=shutil.ignore_patterns("moving-matte"))
    shutil.copytree(ROOT / "conf", project / "conf")
    for path, text in blocks().items():
        (project / path).write_text(text)
        blinks = text.replace('"balls"', '"blinks"').replace("name: balls", "name: blinks")
        blinks = blinks.replace("    geometry =", '    observes = ("time",)\n    geometry =')
        (project / path.replace("balls", "blinks")).write_text(blinks)
        gated = text.replace('"balls"', '"gated_balls"').replace("name: balls", "name: gated_balls")
        gated = gated.replace("import math\n", "import math\nfrom collections.abc import Sequence\n")
        gated = gated.replace("GaussianModel, Raw\n", "Raw\nfrom gsbench.models.gated import GatedModel\n")
        gated = gated.replace("(GaussianModel)", "(GatedModel, gates=True)")
        more = METHODS_FOR_GATES if path.endswith(".py") else ""
        (project / path.replace("balls", "gated_balls")).write_text(gated + more)
    return project


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_moving_square(tmp_path_factory.mktemp("data"))


def run(project: Path, module: str, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a module of the copy."""
    return python("-c", START, module, *words, cwd=project, env=environment() | {"PYTHONPATH": os.fspath(project)})


@pytest.fixture(scope="module")
def gated(project: Path, data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of the page's model with gates and of `blinks`, with and without AGR, gated at the end."""
    words = ("model=gated_balls,blinks", "agr=true,false", "effects.gate=end")
    results = tmp_path_factory.mktemp("gated")
    done = run(project, "gsbench", "-m", *overrides(data, results, *words))
    assert "Traceback" not in done.stderr, done.stderr
    return results


def records(results: Path) -> dict[str, Record]:
    return {results.model: results for results in map(record.read, record.find(results))}


def test_the_worked_example_trains_with_and_without_agr_and_is_gated(gated):
    """Catches documentation that no longer runs: a copy of the project, the page's two files, a short run of each."""
    results = records(gated)
    for label in ("gated_balls", "gated_balls_agr"):
        assert results[label].status == "ok", results[label].reason
        assert results[label].on_demand.gates


def test_a_model_that_cannot_be_gated_is_refused_before_step_0(gated):
    """Catches a training that is lost at its gate, after the last step, to a method that the model lacks."""
    results = records(gated)
    for label in ("blinks", "blinks_agr"):
        assert results[label].status == "failed"
        assert results[label].reason == (
            "effects.gate: expected a model that gates can simplify, Balls is no GatedModel: make it one, "
            "or use effects.gate=off (docs/adding_a_model.md)"
        )
        assert results[label].provenance.data_hash == "not loaded"  # a run that began to train has the hash


def test_export_start_from_a_ply_and_a_nan(project, data, gated, tmp_path):
    """Catches what asks a model for parameters that only ours have: the PLY, what starts from it, a NaN's report. The
    second PLY is so bright that the loss of its first image is not finite."""
    (folder,) = gated.glob("*/*/gated_balls,*/seed0")
    done = run(project, "gsbench.export", str(folder), "--ply", str(tmp_path / "balls.ply"))
    assert done.returncode == 0, done.stderr
    trained = read_trained(tmp_path / "balls.ply")
    trained.dc.fill_(1e22)
    (tmp_path / "bright.ply").write_bytes(ply_of(trained))
    start = f"+init.ply={tmp_path}/balls.ply,{tmp_path}/bright.ply"
    done = run(project, "gsbench", "-m", *overrides(data, tmp_path / "started", "model=balls,blinks", start))
    assert "Traceback" not in done.stderr, done.stderr
    results = [record.read(path) for path in record.find(tmp_path / "started")]
    both = [(model, status) for model in ("balls", "blinks") for status in ("diverged", "ok")]
    assert sorted((run_record.model, run_record.status) for run_record in results) == both
    for run_record in results:
        assert run_record.status == "ok" or "the first is Gaussian " in str(run_record.reason)


def test_the_example_passes_the_linters(tmp_path):
    """Catches an example that a reader's `make lint` would refuse."""
    source = tmp_path / "balls.py"
    source.write_text(next(text for path, text in blocks().items() if path.endswith(".py")))
    done = python("-m", "ruff", "check", "--config", str(ROOT / "pyproject.toml"), str(source))
    assert done.returncode == 0, done.stdout

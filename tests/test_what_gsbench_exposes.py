"""What `import gsbench` gives: the names, their types, their documentation, and that the examples in it run."""

import ast
import doctest
import inspect
from pathlib import Path

import pytest
from forked import python
from tiny_run import ROOT, environment, run_here

import gsbench
from gsbench.measure import perceptual

EXAMPLE_RUN = ["+exp=mini", "model=3dgs", "scene=moving-matte", "train.iterations=20"]  # the run of load_run's example


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder to run examples in: with the run that they load, as one of 20 steps leaves it."""
    folder = tmp_path_factory.mktemp("examples")
    record, _ = run_here(*EXAMPLE_RUN, f"results={folder / 'results'}")
    assert record.status == "ok", record.reason
    return folder


def failures(tests: list[doctest.DocTest]) -> int:
    """Run examples; print those that fail, and count them."""
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    for test in tests:
        runner.run(test)
    return runner.failures


@pytest.mark.parametrize("name", gsbench.__all__)
def test_the_examples_run(name, folder, monkeypatch):
    """Catches a public name without an example, and an example that no longer does what it shows."""
    monkeypatch.chdir(folder)
    monkeypatch.setenv("TORCH_HOME", str(folder))  # a machine without the weights of LPIPS
    perceptual.load.cache_clear()
    tests = doctest.DocTestFinder(recurse=False).find(getattr(gsbench, name), name, globs={})
    assert any(test.examples for test in tests), f"gsbench.{name}: expected an example in its documentation"
    assert failures(tests) == 0
    wrong = doctest.DocTestParser().get_doctest(">>> 1 + 1\n3\n", {}, "wrong", None, None)
    assert failures([wrong]) == 1, "the check passes whatever examples print"


@pytest.mark.parametrize("name", gsbench.__all__)
def test_a_public_name_says_what_it_takes(name):
    """Catches a public function whose arguments, units or errors have to be guessed."""
    public = getattr(gsbench, name)
    text = inspect.getdoc(public) or ""
    arguments = [*inspect.signature(public).parameters]
    described = text.partition("Args:")[2].partition("Example:")[0]
    assert all(f"    {argument}: " in described for argument in arguments), f"gsbench.{name}: Args lacks one of them"
    raises = inspect.getdoc(public.at) or "" if name == "CameraTime" else text
    assert "Raises:" in raises


def test_import_gsbench_is_quick():
    """Catches an import that brings torch, or anything else that takes a second, before a name is asked for."""
    program = (
        "import sys, gsbench\n"
        "heavy = {'torch', 'numpy', 'hydra', 'omegaconf', 'pandas', 'skimage', 'scipy', 'cv2'} & sys.modules.keys()\n"
        "assert not heavy, heavy\n"
        "assert set(gsbench.__all__) <= set(dir(gsbench))\n"
        "gsbench.psnr\n"
        "assert 'torch' in sys.modules\n"
    )
    done = python("-c", program, env=environment(), cwd=ROOT)
    assert done.returncode == 0, done.stderr


def test_only_public_names_are_there():
    """Catches a name in `__all__` that nothing defines, and a `__getattr__` that answers to anything."""
    names: dict[str, object] = {}
    exec("from gsbench import *", names)
    assert set(names) - {"__builtins__"} == set(gsbench.__all__)
    assert not hasattr(gsbench, "rasterise")


def test_type_checkers_see_what_runs():
    """Catches a name that mypy takes from one module and Python from another, or that only one of them knows."""
    tree = ast.parse(Path(gsbench.__file__).read_text())
    guard = next(node for node in tree.body if isinstance(node, ast.If))
    visited = {
        alias.asname or alias.name: f"{node.module}.{alias.name}"
        for node in guard.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert visited == gsbench._PUBLIC
    assert sorted(visited) == gsbench.__all__
    assert (Path(gsbench.__file__).parent / "py.typed").is_file()


@pytest.mark.slow
def test_mypy_reads_the_types(tmp_path):
    """Catches public names that are `Any` to the code of others, and a misspelt one that no checker refuses."""
    user = tmp_path / "user.py"
    user.write_text("import gsbench\n\nreveal_type(gsbench.ssim)\ngsbench.rasterise\n")
    words = ("-m", "mypy", "--config-file", str(ROOT / "pyproject.toml"), str(user))
    done = python(*words, cwd=ROOT, env=environment())
    assert 'Revealed type is "def (a: ' in done.stdout, done.stdout
    assert 'Module has no attribute "rasterise"' in done.stdout, done.stdout

"""The notebooks of examples/: that they run from a fresh folder, and what is committed of them."""

import json
from pathlib import Path
from typing import Any

import pytest
from test_adding_a_model import blocks
from tiny_run import ROOT

NOTEBOOKS = {path.stem: path for path in sorted((ROOT / "examples").glob("*.ipynb"))}


def sources(name: str, kind: str) -> list[str]:
    """The cells of a kind."""
    cells = json.loads(NOTEBOOKS[name].read_text())["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == kind]


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_it_is_committed_without_outputs(name: str) -> None:
    """Catches numbers and images of one machine, which no one would notice getting old."""
    cells = json.loads(NOTEBOOKS[name].read_text())["cells"]
    ran = [cell["id"] for cell in cells if cell.get("outputs") or cell.get("execution_count")]
    assert not ran, "clear the outputs: jupyter nbconvert --clear-output --inplace examples/*.ipynb"


def test_git_ignores_what_they_write() -> None:
    """Catches a notebook that leaves scenes and results as untracked files in a checkout."""
    ignored = (ROOT / ".gitignore").read_text().splitlines()
    for name, written in {"first_look": "first_look", "own_capture": "captures", "own_model": "own_model"}.items():
        assert f"{written}/" in "".join(sources(name, "code")) or f'"{written}"' in "".join(sources(name, "code"))
        assert f"examples/{written}/" in ignored


def test_their_model_is_the_one_of_the_page() -> None:
    """Catches a notebook and a page that explain two different models by one name."""
    page = {Path(path).name: text.strip() for path, text in blocks().items()}
    assert page["balls.py"].partition("\n\n")[2].strip() in sources("first_look", "code")
    own = sources("own_model", "code")
    assert f"%%writefile own_model/balls.py\n{page['balls.py']}" in own
    settings = page["balls.yaml"].replace("name: balls\n", "name: balls\nmodule: balls\n")
    assert f"%%writefile own_model/model/balls.yaml\n{settings}" in own


def run(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[str, int]:
    """Run a notebook in a folder; return what it prints, and its number of figures."""
    import nbformat
    from nbclient import NotebookClient

    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("JUPYTER_PLATFORM_DIRS", "1")  # what jupyter_core is to become, without its warning
    notebook = nbformat.read(NOTEBOOKS[name], as_version=4)
    client = NotebookClient(notebook, timeout=240, kernel_name="python3", resources={"metadata": {"path": folder}})
    client.execute()
    outputs: list[Any] = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    text = "".join(output.text for output in outputs if output.output_type == "stream" and output.name == "stdout")
    return text, sum("image/png" in output.get("data", {}) for output in outputs)


def psnr(text: str, name: str) -> float:
    """The PSNR that a line `name: 20.00 dB` says."""
    return float(text.rpartition(f"\n{name}: ")[2].split()[0])


@pytest.mark.slow
def test_first_look_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a cell that fails, a training that does not learn, and a picture that is not drawn."""
    text, figures = run("first_look", tmp_path, monkeypatch)
    assert figures == 3
    assert "7dgs is" in text
    assert "dB ahead of 3dgs" in text
    assert float(text.partition("balls ")[2].split()[0]) > 15  # dB; a background alone has less


@pytest.mark.slow
def test_own_capture_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a capture that its own cells write wrong, times that are lost, and a training that does not learn."""
    text, figures = run("own_capture", tmp_path, monkeypatch)
    assert figures == 2
    assert "105 training views, 15 test views, 3000 points" in text
    assert psnr(text, "4dgs") > psnr(text, "3dgs") > 15


@pytest.mark.slow
def test_own_model_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a model outside of gsbench that is not found, and one that does not learn."""
    text, figures = run("own_model", tmp_path, monkeypatch)
    assert figures == 1
    assert psnr(text, "7dgs") > psnr(text, "balls") > 15

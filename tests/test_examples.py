"""The notebooks of examples/: that they run from a fresh folder, and what is committed of them."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from test_adding_a_model import blocks
from tiny_run import ROOT

NOTEBOOKS = {path.stem: path for path in sorted((ROOT / "examples").glob("*.ipynb"))}
FIGURES = {"first_look": 3, "own_capture": 2, "own_model": 1}
MOST_BYTES = 300_000  # of a notebook


def sources(name: str, kind: str) -> list[str]:
    """The cells of a kind."""
    cells = json.loads(NOTEBOOKS[name].read_text())["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == kind]


def kept(name: str) -> list[dict[str, Any]]:
    """The outputs that are committed of a notebook."""
    cells = json.loads(NOTEBOOKS[name].read_text())["cells"]
    return [output for cell in cells if cell["cell_type"] == "code" for output in cell["outputs"]]


def printed(outputs: list[Any]) -> str:
    """What cells printed."""
    return "".join(
        "".join(output["text"])
        for output in outputs
        if output["output_type"] == "stream" and output["name"] == "stdout"
    )


def figures(outputs: list[Any]) -> int:
    """The number of pictures that cells drew."""
    return sum("image/png" in output.get("data", {}) for output in outputs)


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_it_is_committed_with_small_outputs(name):
    """Catches a notebook that shows nothing where it is read, a part of a run, a warning, a path of a machine."""
    text = NOTEBOOKS[name].read_text()
    cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1)), "run it from its first cell"
    assert figures(kept(name)) == FIGURES[name]
    assert len(text) < MOST_BYTES
    for output in kept(name):
        assert output["output_type"] in ("stream", "display_data")
        assert output.get("name") != "stderr", "leave progress bars and warnings out"
    assert not re.search(r"(?<![\w.])/(home|root|tmp|work|Users)\b", printed(kept(name)))


def test_git_ignores_what_they_write():
    """Catches a notebook that leaves scenes and results as untracked files in a checkout."""
    ignored = (ROOT / ".gitignore").read_text().splitlines()
    for name, written in {"first_look": "first_look", "own_capture": "captures", "own_model": "own_model"}.items():
        assert f"{written}/" in "".join(sources(name, "code")) or f'"{written}"' in "".join(sources(name, "code"))
        assert f"examples/{written}/" in ignored


def test_their_model_is_the_one_of_the_page():
    """Catches a notebook and a page that explain two different models by one name."""
    page = {Path(path).name: text.strip() for path, text in blocks().items()}
    assert page["balls.py"].partition("\n\n")[2].strip() in sources("first_look", "code")
    cells_of_model = sources("own_model", "code")
    assert f"%%writefile own_model/balls.py\n{page['balls.py']}" in cells_of_model
    settings = page["balls.yaml"].replace("name: balls\n", "name: balls\nmodule: balls\n")
    assert f"%%writefile own_model/model/balls.yaml\n{settings}" in cells_of_model


def run(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[str, int]:
    """Run a notebook in a folder; return what it prints, and its number of figures. Decibels are those that are
    committed, but for the last digits of another processor."""
    import nbformat
    from nbclient import NotebookClient

    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.delenv("MPLBACKEND", raising=False)  # a command that a test ran may have set it: no figure appears then
    monkeypatch.delenv("PYTEST_CURRENT_TEST")  # with it, ipykernel leaves out what child processes print
    monkeypatch.setenv("JUPYTER_PLATFORM_DIRS", "1")  # what jupyter_core is to become, without its warning
    notebook = nbformat.read(NOTEBOOKS[name], as_version=4)
    client = NotebookClient(notebook, timeout=240, kernel_name="python3", resources={"metadata": {"path": folder}})
    client.execute()
    outputs: list[Any] = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    text = printed(outputs)
    assert decibels(text) == pytest.approx(decibels(printed(kept(name))), abs=0.3), "run it again, and commit it"
    return text, figures(outputs)


def decibels(text: str) -> list[float]:
    """The numbers of decibels in a text."""
    return [float(number) for number in re.findall(r"(-?[\d.]+) dB", text)]


def psnr(text: str, name: str) -> float:
    """The PSNR that is printed behind a name, as in "balls: 20.00 dB"."""
    return float(re.findall(rf"\b{name}:? ([\d.]+) dB", text)[0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "better", "worse", "also"),
    [
        ("first_look", None, "balls", r"7dgs . 3dgs: [\d.]+ dB, 95 % interval"),
        ("own_capture", "4dgs", "3dgs", "105 training views, 15 test views, 3000 points"),
        ("own_model", "7dgs", "balls", ""),
    ],
)
def test_it_runs(name, better, worse, also, tmp_path, monkeypatch):
    """Catches a cell that fails, a picture that is not drawn, a training that does not learn, a capture that its own
    cells write wrong, times that are lost, and a model outside of gsbench that is not found."""
    text, drawn = run(name, tmp_path, monkeypatch)
    assert drawn == FIGURES[name]
    assert re.search(also, text)
    least = psnr(text, worse)
    assert least > 15  # dB; a background alone has less
    assert better is None or psnr(text, better) > least

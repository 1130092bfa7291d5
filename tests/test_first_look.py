"""The notebook examples/first_look.ipynb: that it runs from a fresh folder, and what is committed of it."""

import json
from pathlib import Path
from typing import Any

import pytest
from test_adding_a_model import blocks
from tiny_run import ROOT

NOTEBOOK = ROOT / "examples" / "first_look.ipynb"


def sources(kind: str) -> list[str]:
    """The cells of a kind."""
    return ["".join(cell["source"]) for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == kind]


def test_it_is_committed_without_outputs() -> None:
    """Catches numbers and images of one machine, which no one would notice getting old."""
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    ran = [cell["id"] for cell in cells if cell.get("outputs") or cell.get("execution_count")]
    assert not ran, "clear the outputs: jupyter nbconvert --clear-output --inplace examples/first_look.ipynb"


def test_its_model_is_the_one_of_the_page() -> None:
    """Catches a notebook and a page that explain two different models by one name."""
    page = next(text for path, text in blocks().items() if path.endswith(".py"))
    without_first_line = page.partition("\n\n")[2].strip()
    assert without_first_line in sources("code")


@pytest.mark.slow
def test_it_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a cell that fails, a training that does not learn, and a picture that is not drawn."""
    import nbformat
    from nbclient import NotebookClient

    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("JUPYTER_PLATFORM_DIRS", "1")  # what jupyter_core is to become, without its warning
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    client = NotebookClient(notebook, timeout=240, kernel_name="python3", resources={"metadata": {"path": tmp_path}})
    client.execute()
    outputs: list[Any] = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 3
    text = "".join(output.text for output in outputs if output.output_type == "stream" and output.name == "stdout")
    assert "7dgs is" in text
    assert "dB ahead of 3dgs" in text
    assert float(text.partition("balls ")[2].split()[0]) > 15  # dB; a background alone has less

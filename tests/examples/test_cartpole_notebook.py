"""The notebook that trains, plots and shows a clip."""

from __future__ import annotations

import json
import sys
import types
from pathlib import Path

import pytest

from mjlab.rl import progress, runner

NOTEBOOK = Path(__file__).parents[2] / "examples" / "cartpole_notebook.ipynb"
SMALL = """
num_envs, max_iterations, clip_seconds = 8, 2, 0.2
run_folder = "runs"
"""


def code_cells() -> list[str]:
    """Return the code of the notebook, with small numbers instead of its parameters."""
    cells = []
    for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            code = "".join(cell["source"])
            cells.append(code + SMALL if "parameters" in cell["metadata"].get("tags", ()) else code)
    return cells


def test_outputs_are_stored_and_name_no_machine():
    text = NOTEBOOK.read_text(encoding="utf-8")
    cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
    kinds = {kind for cell in cells for output in cell["outputs"] for kind in output["data"]}
    assert {"text/html", "image/png"} <= kinds
    assert all(cell["execution_count"] for cell in cells)
    assert "/home/" not in text
    assert len(text) < 300_000


class Output:
    """Stands in for an output of a notebook; collects its contents."""

    def __init__(self) -> None:
        self.contents: list[dict] = []
        self.num_displays = 0

    def display(self, content: dict, *, raw: bool, display_id: bool) -> Output:
        assert raw
        assert display_id
        self.num_displays += 1
        self.contents.append(content)
        return self

    def update(self, content: dict, *, raw: bool) -> None:
        assert raw
        self.contents.append(content)


@pytest.fixture
def output(monkeypatch) -> Output:
    output = Output()
    ipython, display = types.ModuleType("IPython"), types.ModuleType("IPython.display")
    # Libraries look for a kernel as well, so only the runner finds one.
    vars(ipython).update(get_ipython=lambda: None, display=display, version_info=(9, 0))
    vars(display).update(
        display=output.display, Video=lambda path, embed: path, Image=lambda filename: filename
    )
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    monkeypatch.setattr(runner, "in_notebook", lambda: True)
    return output


def test_the_cells_train_plot_and_record_with_progress_in_one_output(
    output, gl, monkeypatch, tmp_path, capsys
):
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for code in code_cells():
        exec(compile(code, str(NOTEBOOK), "exec"), names)
    assert output.num_displays == 1
    assert len(output.contents) >= 2
    last = output.contents[-1]
    assert "Finished: unsolved at iteration 2 of 2" in last["text/plain"]
    assert "8 environments" in last["text/html"]
    assert capsys.readouterr().out == ""
    (clip,) = tmp_path.glob("runs/*/clip.mp4")
    assert clip.stat().st_size > 0
    (picture,) = tmp_path.glob("runs/*/learning_curve.png")
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("shell", "expected"),
    [(None, False), (types.SimpleNamespace(), False), (types.SimpleNamespace(kernel=1), True)],
)
def test_a_terminal_of_ipython_is_not_a_notebook(shell, expected, monkeypatch):
    module = types.SimpleNamespace(get_ipython=lambda: shell)
    monkeypatch.setitem(sys.modules, "IPython", module)
    assert progress.in_notebook() == expected


@pytest.mark.slow
def test_the_notebook_runs_in_a_kernel(gl, tmp_path):
    nbformat = pytest.importorskip("nbformat")
    client = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    notebook = nbformat.v4.new_notebook()
    notebook.cells = [nbformat.v4.new_code_cell(code) for code in code_cells()]
    resources = {"metadata": {"path": str(tmp_path)}}
    client.NotebookClient(notebook, timeout=300, resources=resources).execute()
    _, training, plot, video = notebook.cells
    (progress,) = training.outputs
    assert "Finished" in progress.data["text/plain"]
    assert "image/png" in plot.outputs[0].data
    assert "<video" in video.outputs[0].data["text/html"]

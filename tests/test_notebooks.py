"""The notebooks run from top to bottom, and learn what they say."""

import ast
import os
from pathlib import Path

import pytest
from needs import require

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))
LONG = ("ablation", "own_encoder", "own_family", "unseen_tasks")  # they take a minute each
RUN = [pytest.param(x, marks=pytest.mark.nightly if x.stem in LONG else pytest.mark.slow) for x in NOTEBOOKS]
LARGEST = 200_000  # bytes, pictures included


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_shows_its_results(path):
    """Every cell was run in order, without an error; a picture and a check of the conclusion are among them."""
    nbformat = require("nbformat")
    notebook = nbformat.read(path, as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error" or output.get("name") == "stderr"]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    statements = [node for cell in cells for node in ast.parse(cell.source).body]
    assert any(isinstance(node, ast.Assert) for node in statements), "the conclusion is not checked"
    assert path.stat().st_size < LARGEST


@pytest.mark.parametrize("path", RUN, ids=lambda path: path.stem)
@pytest.mark.filterwarnings("ignore")  # the kernel's own machinery, in this process, is not ours
def test_notebook_runs(path, monkeypatch):
    """Every cell executes as it stands, the check of the conclusion too."""
    flags = os.environ.get("XLA_FLAGS", "")  # a kernel compiles much, but what it learns takes optimised programs
    monkeypatch.setenv("XLA_FLAGS", flags.replace("optimization_level=0", "optimization_level=1"))
    notebook = require("nbformat").read(path, as_version=4)
    require("nbclient").NotebookClient(
        notebook, timeout=600, resources={"metadata": {"path": str(path.parent)}}
    ).execute()

"""Every notebook runs from top to bottom, and its two files say the same."""

import os
from pathlib import Path

import jupytext
import nbclient
import pytest

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted((ROOT / "notebooks").glob("*.py"))


def sources(notebook):
    return [(cell.cell_type, cell.source) for cell in notebook.cells]


def test_there_are_notebooks():
    assert SCRIPTS


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_script_and_notebook_agree_and_carry_no_output(script):
    notebook = jupytext.read(script.with_suffix(".ipynb"))
    remedy = f"run: jupytext --to ipynb notebooks/{script.name}"
    assert sources(notebook) == sources(jupytext.read(script)), remedy
    for cell in notebook.cells:
        assert not cell.get("outputs")
        assert cell.get("execution_count") is None


QUICK = ("first_clamping",)


@pytest.mark.parametrize(
    "script",
    [pytest.param(s, marks=() if s.stem in QUICK else pytest.mark.slow, id=s.stem) for s in SCRIPTS],
)
@pytest.mark.filterwarnings("default")  # those of the notebook machinery are not ours
def test_notebook_runs(script, monkeypatch, tmp_path):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    notebook = jupytext.read(script)
    nbclient.NotebookClient(
        notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert outputs
    assert not [output for output in outputs if output.output_type == "error"]
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    drawn = sum(
        "result.plot_" in line or line.startswith("plot_")
        for cell in notebook.cells
        for line in cell.source.splitlines()
    )
    assert len(pictures) == drawn

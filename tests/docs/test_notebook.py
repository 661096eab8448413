"""The notebook runs from its first cell to its last, and is kept without outputs."""

import json
import runpy

import pytest
from matplotlib import pyplot as plt

from tests.docs.blocks import ROOT

CELLS = json.loads((ROOT / "docs" / "notebook.ipynb").read_text(encoding="utf-8"))["cells"]


def test_the_notebook_is_kept_without_outputs():
    code = [cell for cell in CELLS if cell["cell_type"] == "code"]
    assert len(code) >= 5
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in code)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:FigureCanvasAgg is non-interactive")
def test_the_notebook_walks_from_a_drive_to_a_map_and_its_report(tmp_path, monkeypatch, capsys):
    program = "\n\n".join("".join(cell["source"]) for cell in CELLS if cell["cell_type"] == "code")
    (tmp_path / "notebook.py").write_text(program)
    monkeypatch.chdir(tmp_path)
    plt.switch_backend("agg")
    runpy.run_path("notebook.py")
    plt.close("all")
    printed = capsys.readouterr().out
    assert "verdict: PASS" in printed
    assert "diamond" in printed
    assert (tmp_path / "outputs/yard/report.html").stat().st_size > 100_000

"""The notebook runs from its first cell to its last, and is kept without outputs."""

import json
import os
import subprocess
import sys

import pytest

from tests.docs.blocks import ROOT

CELLS = json.loads((ROOT / "docs" / "notebook.ipynb").read_text(encoding="utf-8"))["cells"]


def test_the_notebook_is_kept_without_outputs():
    code = [cell for cell in CELLS if cell["cell_type"] == "code"]
    assert len(code) >= 5
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in code)


@pytest.mark.slow
def test_the_notebook_walks_from_a_drive_to_a_map_and_its_report(tmp_path):
    program = "\n\n".join("".join(cell["source"]) for cell in CELLS if cell["cell_type"] == "code")
    (tmp_path / "notebook.py").write_text(program)
    done = subprocess.run(
        [sys.executable, "notebook.py"],
        cwd=tmp_path, capture_output=True, text=True, timeout=300,
        env=os.environ | {"PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "verdict: PASS" in done.stdout
    assert "diamond" in done.stdout
    assert (tmp_path / "outputs/yard/report.html").stat().st_size > 100_000

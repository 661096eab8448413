"""A result folder is whole or absent."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from v2hdm.errors import ConfigError
from v2hdm.report.outputs import result_folder, write_json


def test_a_failed_run_leaves_the_earlier_result_untouched(tmp_path: Path) -> None:
    target = tmp_path / "run"
    with result_folder(target) as folder:
        (folder / "config.yaml").write_text("first")
    with pytest.raises(ZeroDivisionError), result_folder(target) as folder:
        (folder / "config.yaml").write_text(f"second {1 / 0}")
    assert (target / "config.yaml").read_text() == "first"
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_a_second_run_replaces_the_first_whole(tmp_path: Path) -> None:
    for name in ("first", "second"):
        with result_folder(tmp_path / "run") as folder:
            (folder / "config.yaml").write_text(name)
            (folder / name).touch()
    assert sorted(p.name for p in (tmp_path / "run").iterdir()) == ["config.yaml", "second"]


def test_somebody_elses_folder_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(ConfigError, match="output="), result_folder(tmp_path):
        pass
    assert (tmp_path / "thesis.tex").exists()


def test_json_leaves_out_what_does_not_exist(tmp_path: Path) -> None:
    write_json(tmp_path / "m.json", {"a": {"recall": float("nan"), "n": np.int64(3)}, "b": [np.float64(1.5)]})
    assert json.loads((tmp_path / "m.json").read_text()) == {"a": {"n": 3}, "b": [1.5]}

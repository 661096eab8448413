"""``--help`` explains every key, out of the docstrings."""

from __future__ import annotations

from pathlib import Path

import pytest

from export.config import ExportConfig
from train.config import TrainConfig
from v2hdm.cli.keys_help import help_text, keys_of
from v2hdm.pipeline.config import RunConfig


@pytest.mark.parametrize("schema", [RunConfig, TrainConfig, ExportConfig])
def test_every_key_is_explained(schema: type) -> None:
    keys = list(keys_of(schema))
    assert len(keys) > 10
    assert [key.name for key in keys if not key.meaning] == []
    assert not [key.name for key in keys if "`" in key.meaning or "\n" in key.meaning]


def test_the_page_has_every_key_with_its_default_and_the_runs_that_are_shipped() -> None:
    page = help_text("v2hdm map", "Maps.", RunConfig, Path(__file__).parents[1] / "conf")
    assert "v2hdm map [key=value ...]" in page
    assert "mapping.max_range_m (number, 16.0)\n      Observations farther than" in page
    assert "Shipped runs: kitti, port1, port2" in page
    assert all(key.name in page for key in keys_of(RunConfig))
    assert max(map(len, page.splitlines())) <= 110

"""What a run left over, as files: residuals and exclusions are read back as they were written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from v2hdm.errors import MapFileError
from v2hdm.io.maps.evidence import (
    ExcludedMarking,
    Residuals,
    read_exclusions,
    read_residuals,
    write_exclusions,
    write_residuals,
)
from v2hdm.records import GeodeticOrigin


def some_residuals() -> Residuals:
    random = np.random.default_rng(4)
    return Residuals(
        image=("front/a, b.png", 'rear/"c".png'),
        camera=("front", "rear"),
        taken_s=np.array([10.25, 11.5]),
        row_image=np.array([0, 0, 1]),
        marking=np.array([3, 0, 12]),
        corner=np.array([0, 3, 1]),
        is_point=np.array([True, False, True]),
        observed_px=np.round(random.uniform(0, 1000, (3, 2)), 3),
        residual_px=np.round(random.normal(0, 0.3, (3, 2)), 4),
        distance_sigma=np.array([0.5, 1.25, 2.0]),
    )


def test_residuals_are_read_back_as_written(tmp_path: Path) -> None:
    written = some_residuals()
    write_residuals(written, tmp_path / "residuals.csv")
    read = read_residuals(tmp_path / "residuals.csv")
    for name, value in vars(written).items():
        np.testing.assert_array_equal(getattr(read, name), value, err_msg=name)
    assert len(read) == 3


@pytest.mark.parametrize("line", ["front/x.png,front,1.0,2,1", "front/x.png,front,late,2,1,1,0,0,0,0,0"])
def test_a_damaged_line_is_named(line: str, tmp_path: Path) -> None:
    path = tmp_path / "residuals.csv"
    write_residuals(some_residuals(), path)
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(MapFileError, match="line 5"):
        read_residuals(path)


@pytest.mark.parametrize("origin", [None, GeodeticOrigin(53.5, 9.9, 40.0)])
def test_exclusions_are_read_back_as_written(origin: GeodeticOrigin | None, tmp_path: Path) -> None:
    written = [ExcludedMarking("diamond", np.array([1.25, -3.5]), 4, "its position is too uncertain", "both")]
    write_exclusions(written, tmp_path / "excluded.geojson", origin, None)
    (read,) = read_exclusions(tmp_path / "excluded.geojson")
    np.testing.assert_array_equal(read.position_map, written[0].position_map)
    assert (read.kind, read.sightings, read.reason, read.cameras) == (
        "diamond", 4, "its position is too uncertain", "both",
    )  # fmt: skip


def test_exclusions_without_a_place_are_refused(tmp_path: Path) -> None:
    (tmp_path / "excluded.geojson").write_text('{"features": [{"properties": {"class": "diamond"}}]}')
    with pytest.raises(MapFileError, match="feature 0"):
        read_exclusions(tmp_path / "excluded.geojson")

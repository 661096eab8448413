"""Files of a result that somebody has changed: every value of another type is one line with its place."""

import json

import pytest

from tests.faults.readers import refusal
from v2hdm.errors import MapFileError
from v2hdm.io.metrics import read_metrics
from v2hdm.report.page.layers import earlier_layer
from v2hdm.report.page.pictures import earlier_pictures

FINDING = {"check": "clock", "status": "PASS", "says": "x", "about": "poses", "value": 1.0, "limit": None}
SUSPECT = {"marking": 1, "p": 0.1, "p_shape": 1, "p_residuals": 0.1, "p_sightings": 1.0, "disputed": 0.0}
CHANGE = {
    "id": 1, "class": "diamond", "fate": "moved", "shift_m": [0.1, 0.2], "shift_sigma_m": None,
    "probability": 0.9, "views": 3, "found": 2, "before_map": [[0, 0], [0, 1], [1, 1], [1, 0]],
    "after_map": None,
}  # fmt: skip
METRICS = {
    "name": "n", "date": "2026-01-01", "version": "1", "versions": {"v2hdm": "1"},
    "drive": {"name": "d", "paths": ["/d"], "images": 3},
    "verdict": {"status": "PASS", "headline": "x", "findings": [FINDING], "passed": [], "unobservable": []},
    "results": {"front": {"Opt": {"markings": 1, "lanes": {"length_m": 1.0}, "suspicious": [SUSPECT]}}},
    "extrinsics": {"front": {"certainty": "", "x_change_m": 0.1}},
    "changes": {"listed": [CHANGE]}, "check_points": {"compared": 2, "rmse_m": 0.1}, "seconds": {"map": 1.0},
}  # fmt: skip


def places(value, place=()):
    yield place
    entries = (
        value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    )
    for key, entry in entries:
        yield from places(entry, (*place, key))


def replaced(place, new):
    content = json.loads(json.dumps(METRICS))
    if not place:
        return new
    inner = content
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = new
    return content


def written(folder, content):
    (folder / "metrics.json").write_text(json.dumps(content))
    return folder


def test_figures_are_read_as_they_were_written(tmp_path):
    assert read_metrics(written(tmp_path, METRICS)) == METRICS


@pytest.mark.parametrize("wrong", [object, "\x1b[2J", float("nan"), 1e999, [[[]]], {"a": {}}, True], ids=repr)
def test_a_figure_of_another_type_is_one_line(wrong, tmp_path):
    refused = 0
    for place in places(METRICS):
        folder = written(tmp_path, replaced(place, None if wrong is object else wrong))
        if (said := refusal(lambda folder=folder: read_metrics(folder), MapFileError)) is not None:
            refused += 1
            assert "metrics.json" in said
            assert "\n" not in said
            assert len(said) < 300
    assert refused > 15


def test_the_place_of_a_wrong_figure_is_named(tmp_path):
    content = replaced(("verdict", "findings", 0, "value"), float("nan"))
    with pytest.raises(
        MapFileError, match=r"metrics\.json: verdict\.findings\[0\]\.value: expected a finite"
    ):
        read_metrics(written(tmp_path, content))
    content = replaced(("drive", "images"), "many")
    with pytest.raises(MapFileError, match=r"metrics\.json: drive\.images: expected int, got str"):
        read_metrics(written(tmp_path, content))


def test_what_somebody_has_made_of_an_earlier_report_is_left_out():
    layer = {"src": "UklGRg==", "type": "image/webp", "bounds": [0, 0, 1, 1]}
    assert earlier_layer(layer) == layer
    for wrong in ({}, None, [], layer | {"bounds": [0, 0, 1, float("nan")]}, layer | {"src": "<x>"}):
        assert earlier_layer(wrong) is None
    picture = {"src": "a", "size": [2, 1], "camera": "c", "image": "i", "t": 1.0, "map": [[0, 1]], "seen": []}
    assert earlier_pictures({"m1": [picture]}) == {"m1": [picture]}
    assert earlier_pictures({"m1": [picture | {"t": float("nan")}]}) == {}

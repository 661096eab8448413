"""``viewer=rerun``: a run is recorded, and the recording holds what happened."""

import json
import sys
from collections import defaultdict
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from tests.ports import run_config
from v2hdm.cli.main import run as run_command
from v2hdm.detection.options import DetectorOptions
from v2hdm.errors import ConfigError
from v2hdm.io.calibration.reading import read_calibration
from v2hdm.io.drive import read_drive
from v2hdm.io.maps.reading import read_geojson
from v2hdm.pipeline.config import DriveConfig
from v2hdm.pipeline.context import Context, Unwatched
from v2hdm.pipeline.detections import detect_in_pieces
from v2hdm.pipeline.keys import Contents
from v2hdm.pipeline.run import run
from v2hdm.store.cache import StageCache
from v2hdm.viewer import FILE, RerunViewer, check_viewer

Columns = Mapping[str, list[Any]]


def configured(drive, output):
    return run_config(drive, output, name="small", cache=str(output / "cache"))


@pytest.fixture(scope="module")
def result(tiny_drive, tmp_path_factory):
    pytest.importorskip("rerun", reason="no rerun: pip install 'v2hdm[viewer]'")
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("DISPLAY", raising=False)
        patch.delenv("WAYLAND_DISPLAY", raising=False)
        output = tmp_path_factory.mktemp("outputs")
        return run(configured(tiny_drive, output), viewer=RerunViewer("small")).folder


@pytest.fixture(scope="module")
def recorded(result):
    """Columns of the recording by entity, read by Rerun's own reader."""
    from rerun.chunk import RrdReader

    columns: dict[str, dict[str, list[Any]]] = defaultdict(lambda: defaultdict(list))
    for chunk in RrdReader(result / FILE).stream().to_chunks():
        batch = chunk.to_record_batch()
        for name in (one for one in batch.schema.names if one == "image" or ":" in one):
            columns[chunk.entity_path][name] += batch.column(name).to_pylist()
    return columns


def only(columns, ending):
    (found,) = [values for name, values in columns.items() if name.endswith(ending)]
    return found


def test_every_image_is_in_the_recording_byte_for_byte(recorded, tiny_drive):
    drive = read_drive(tiny_drive)
    columns = recorded["/map/vehicle/front/image"]
    blobs = [bytes(one[0]) for one in only(columns, "EncodedImage:blob") if one]
    assert sorted(blobs) == sorted(image.path.read_bytes() for image in drive.images)
    frames = [n for n, one in zip(columns["image"], only(columns, "EncodedImage:blob"), strict=True) if one]
    assert sorted(frames) == list(range(len(drive.images)))


def test_detections_lie_in_the_images(recorded, tiny_drive):
    columns = recorded["/map/vehicle/front/image/markings"]
    strips = [strip for one in only(columns, "LineStrips2D:strips") for strip in one or ()]
    assert len(strips) > 20
    inside = [((np.array(strip) > -50) & (np.array(strip) < [690, 410])).all() for strip in strips]
    assert np.mean(inside) > 0.9
    labels = [label for one in only(columns, "LineStrips2D:labels") for label in one or ()]
    assert any(label.startswith("diamond 0.") for label in labels)


def test_the_recorded_map_is_the_written_one(recorded, result):
    (strips,) = only(recorded["/map/front/markings"], "LineStrips3D:strips")
    written = read_geojson(result / "map.geojson").markings
    assert len(strips) == len(written) > 5
    got = sorted(np.array(strip)[:4, :2].mean(axis=0).tolist() for strip in strips)
    expected = sorted(marking.corners_map.mean(axis=0).tolist() for marking in written)
    np.testing.assert_allclose(got, expected, atol=1e-3)
    assert recorded["/map/front/lanes"]


def test_the_camera_ends_where_the_calibration_has_it(recorded, result):
    columns = recorded["/map/vehicle/front"]
    found = read_calibration(result / "calibration_front.yaml").cam_from_vehicle
    centre = -found[:3, :3].T @ found[:3, 3]
    np.testing.assert_allclose(only(columns, "Transform3D:translation")[-1][0], centre, atol=1e-4)
    assert only(recorded["/map/vehicle/front/image"], "Pinhole:resolution")[0]


def test_the_recording_belongs_to_the_result_and_the_log_says_how_to_replay_it(result):
    listed = [json.loads(line) for line in (result / ".v2hdm-results.jsonl").read_text().splitlines()]
    assert any(FILE in one.values() for one in listed)
    assert f"replay the run with: rerun {FILE}" in (result / "run.log").read_text()


def test_an_unknown_viewer_is_refused():
    assert not check_viewer("none")
    with pytest.raises(ConfigError, match="viewer is 'foxglove': choose none or rerun"):
        check_viewer("foxglove")


def test_without_its_package_the_viewer_is_one_line_before_any_work(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rerun", None)
    monkeypatch.chdir(tmp_path)
    assert run_command(["map", "drive.path=nowhere", "viewer=rerun"]) == 2
    assert capsys.readouterr().err == (
        "error: viewer=rerun needs rerun: install the viewer extra, pip install 'v2hdm[viewer]'\n"
    )
    assert not (tmp_path / "outputs").exists()


def test_a_run_that_nothing_has_changed_for_is_shown_all_the_same(result, tiny_drive):
    class Seen:
        def __init__(self):
            self.calls: list[str] = []

        def begun(self, *_):
            self.calls.append("begun")

        def detected(self, found):
            self.calls.append(f"{len(found)} images")

        def mapped(self, cameras, *_):
            self.calls.append(cameras)

        def close(self):
            self.calls.append("closed")

    seen = Seen()
    run(configured(tiny_drive, result.parent), viewer=seen)
    assert seen.calls == ["begun", f"{len(read_drive(tiny_drive).images)} images", "front", "closed"]


def test_images_are_shown_as_they_are_looked_at(tiny_drive, tmp_path):
    drive = read_drive(tiny_drive, DriveConfig(limit=3))
    shown: list[list[int]] = []

    class Watching(Unwatched):
        def detected(self, detections):
            shown.append([one.image for one in detections])

    for _ in range(2):
        context = Context(StageCache(tmp_path), workers=1, viewer=Watching())
        detect_in_pieces(drive, Contents.of([drive]), DetectorOptions(), context)
    assert shown == [[], [0], [1], [2], [0, 1, 2]]

"""docs/living-map.md does what it says: its commands run on two drives through a made-up yard."""

import json
import shlex
import sys
from dataclasses import asdict, replace

import cv2
import numpy as np
import pytest

from tests.docs.blocks import blocks, document
from tests.mapping.scene import SceneOptions, make_scene, repainted
from v2hdm.cli.main import run
from v2hdm.errors import MapFileError
from v2hdm.io.drive import ReadOptions, read_drive
from v2hdm.io.drive.writing import write_drive
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.maps.reading import read_geojson
from v2hdm.pipeline import map_drive as work
from v2hdm.pipeline.base import check_together, read_base
from v2hdm.pipeline.config import ACCURACY_GOAL_CM
from v2hdm.records import Fate, GeodeticOrigin, ImageDetections, PoseNoise, Trajectory
from v2hdm.site.accuracy import accuracy_of

BOTH, LATER, _ = (" ".join(block.lines) for block in blocks("docs/living-map.md", "sh"))


def write_scene(scene, folder):
    """The drive of a scene as a folder, all of whose images are grey."""
    _, grey = cv2.imencode(".jpg", np.full((720, 1280, 3), 90, dtype=np.uint8))
    images = []
    for image in scene.drive.images:
        path = folder / image.camera / "images" / image.path.name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(grey.tobytes())
        images.append(replace(image, path=path))
    stamp_s = np.array([image.stamp_s for image in images])
    poses = np.stack([image.map_from_vehicle for image in images])
    noise = PoseNoise(**{key: float(value) for key, value in asdict(scene.drive.pose_noise).items()})
    drive = replace(scene.drive, name=folder.name, root=folder, images=images, pose_noise=noise)
    write_drive(folder, drive, Trajectory(stamp_s, poses))


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """``outputs`` after Monday's map, and after the document's two commands."""
    folder = tmp_path_factory.mktemp("living")
    options = SceneOptions(length_m=40.0, cameras=("front",), seed=21)
    scenes = {"monday": make_scene(options), "friday": make_scene(replace(options, seed=22), repainted)}
    for name, scene in scenes.items():
        write_scene(scene, folder / "drives" / name)

    def detected(drive, *_):
        out: list[ImageDetections] = []
        for session in drive.sessions:
            of_session = scenes[session.root.name].detections
            out += [replace(in_image, image=in_image.image + len(out)) for in_image in of_session]
        return out

    with pytest.MonkeyPatch.context() as patch:
        # Grey images say nothing: neither to the detector nor to the checks of images and ground.
        patch.setattr(work, "detect_in_pieces", detected)
        patch.setattr(sys.modules["v2hdm.pipeline.inspect"], "input_findings", lambda *_: [])
        patch.setattr("v2hdm.ground.estimate.estimate_cameras", lambda *_: {})
        patch.chdir(folder)
        for command in ("v2hdm map drive.path=drives/monday name=monday", BOTH, LATER):
            assert run(["map", *shlex.split(command)[2:], "workers=1", "mosaic=false"]) == 0
    return folder / "outputs"


def test_drives_are_mapped_together_each_with_its_trajectory(results):
    metrics = json.loads((results / "both" / "metrics.json").read_text())
    assert (results / "both" / "trajectory_monday.tum").is_file()
    assert (results / "both" / "trajectory_friday.tum").is_file()
    clocks = metrics["extrinsics"]["front"]["clock_offset_s"]
    assert set(clocks) == {"monday", "friday"}
    alone = json.loads((results / "monday" / "metrics.json").read_text())
    sigma = [figures["results"]["front"]["Opt"]["median_sigma_m"] for figures in (metrics, alone)]
    assert sigma[0] < sigma[1]


def test_a_later_drive_lists_what_changed(results):
    changes = json.loads((results / "friday" / "metrics.json").read_text())["changes"]
    fates = [change["fate"] for change in changes["listed"]]
    assert {Fate.MOVED.value, Fate.VANISHED.value} <= set(fates)
    features = json.loads((results / "friday" / "changes.geojson").read_text())["features"]
    assert {feature["properties"]["fate"] for feature in features} >= set(fates)
    before, after = (read_geojson(results / name / "map.geojson") for name in ("monday", "friday"))
    gone = {change["id"] for change in changes["listed"] if change["fate"] == "vanished"}
    assert {marking.id for marking in before.markings} - gone <= {marking.id for marking in after.markings}
    assert after.largest_id >= before.largest_id


def test_a_map_that_was_brought_up_to_date_is_graded_by_its_new_covariances(results):
    before, after = (read_geojson(results / name / "map.geojson") for name in ("monday", "friday"))
    for marking in (*before.markings, *after.markings):
        assert marking.accuracy == accuracy_of(marking.covariance_m2, ACCURACY_GOAL_CM / 100)
    assert all(marking.accuracy is not None for marking in after.markings)


def test_the_document_names_every_fate():
    for fate in Fate:
        assert f"| `{fate.value}` |" in document("docs/living-map.md")


def test_a_base_that_nothing_can_be_built_on_is_refused(results, tmp_path):
    with pytest.raises(MapFileError, match=r"nowhere\.geojson"):
        read_base(tmp_path / "nowhere.geojson")
    hd_map = read_geojson(results / "monday" / "map.geojson")
    naive = tuple(replace(marking, covariance_m2=None) for marking in hd_map.markings)
    for changed, verdict, message in (
        (hd_map, {"status": "FAIL"}, "the verdict on its drive is FAIL"),
        (replace(hd_map, markings=naive), None, "states no uncertainty of its markings"),
        (replace(hd_map, markings=()), None, "has no markings"),
    ):
        write_geojson(changed, tmp_path / "map.geojson", verdict)
        with pytest.raises(MapFileError, match=message):
            read_base(tmp_path)


def test_a_base_of_another_frame_or_site_is_refused(results):
    base = read_base(results / "monday")
    drive = read_drive(results.parent / "drives" / "friday", ReadOptions())
    check_together(base, drive, "monday")
    with pytest.raises(MapFileError, match="their coordinates differ"):
        check_together(base, replace(drive, origin=GeodeticOrigin(50.0, 8.0, 100.0)), "monday")
    far = [replace(image, map_from_vehicle=image.map_from_vehicle.copy()) for image in drive.images]
    for image in far:
        image.map_from_vehicle[0, 3] += 500.0
    with pytest.raises(MapFileError, match="it is a map of another site"):
        check_together(base, replace(drive, images=far), "monday")

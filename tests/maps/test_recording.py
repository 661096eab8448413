"""MCAP recordings of a map, read back by Foxglove's own ``mcap`` and its decoder of ROS 2."""

import json
import sys
from collections import defaultdict
from dataclasses import replace

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from tests.docs.blocks import ROOT
from tests.maps.gis import ORIGIN, street
from v2hdm.cli.main import run
from v2hdm.geometry.rigid import exp, rotation_from_quaternion
from v2hdm.io.maps import messages
from v2hdm.io.maps.colours import LINE, channels, colours_of
from v2hdm.io.maps.features import features_of
from v2hdm.io.maps.formats import write_map
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.trajectory import write_tum
from v2hdm.records import HDMap, Reading, Symbol, Trajectory

START_S = 1.7e9


def site(origin=ORIGIN) -> HDMap:
    """A street with a class that nobody knows and a text that was read."""
    outline = np.array([[20.0, 2.0], [22.0, 2.0], [22.0, 3.0], [20.0, 3.0]])
    hd_map = street(origin)
    strange = replace(hd_map.markings[0], kind="helipad H")
    text = Symbol("text", outline, 7, 0.01, np.ones(4), reading=Reading("EBH & 7", 0.9))
    return replace(hd_map, markings=(*hd_map.markings, strange), symbols=(text,))


def drive(start_s=START_S) -> Trajectory:
    stamp_s = start_s + np.arange(5) / 4
    poses = [exp(np.array([2.0 * k, 0.5, 1.0, 0.01, 0.02, 0.1 * k])) for k in range(5)]
    return Trajectory(stamp_s, np.array(poses))


def messages_by_topic(path):
    """The messages of the file, in order, by topic."""
    sent = defaultdict(list)
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            sent[channel.topic].append((schema.name, message.log_time, decoded))
    return sent


def written(tmp_path, hd_map, **more):
    (path,) = write_map(hd_map, tmp_path, "map", ["mcap"], **more)
    return messages_by_topic(path)


def places(points):
    return np.array([[point.x, point.y, point.z] for point in points])


def test_a_recording_holds_every_feature_with_all_its_properties(tmp_path):
    ((kind, _, message),) = written(tmp_path, site())["/map/features"]
    assert kind == messages.MAP
    assert (message.latitude_deg, message.longitude_deg) == (ORIGIN.latitude_deg, ORIGIN.longitude_deg)
    for feature, sent in zip(features_of(site()), message.features, strict=True):
        assert (sent.id, sent.label, sent.closed) == (feature.id, feature.kind, feature.closed)
        assert (sent.sightings, sent.accuracy) == (feature.sightings, feature.accuracy or "")
        np.testing.assert_array_equal(places(sent.points), feature.xyz_map[feature.ring])
        covariance = feature.ring_covariance_m2
        np.testing.assert_array_equal(sent.covariance_m2, [] if covariance is None else covariance.ravel())
        np.testing.assert_equal(sent.sigma_m, np.nan if feature.sigma_m is None else feature.sigma_m)
    text = message.features[-1]
    assert json.loads(text.properties)["text"] == "EBH & 7"


def test_markers_draw_each_class_in_the_colour_of_the_report(tmp_path):
    ((kind, _, message),) = written(tmp_path, site())["/map/markers"]
    assert kind == "visualization_msgs/msg/MarkerArray"
    features = features_of(site())
    lines = [marker for marker in message.markers if marker.ns != "texts"]
    assert {marker.ns for marker in lines} == {feature.kind for feature in features}
    assert len({(marker.ns, marker.id) for marker in message.markers}) == len(message.markers)
    diamonds = next(marker for marker in lines if marker.ns == "diamond")
    assert len(diamonds.points) == 2 * 4 * sum(feature.kind == "diamond" for feature in features)
    assert rgb(diamonds) == channels(colours_of(features)["diamond"])
    open_lines = next(marker for marker in lines if marker.ns == "lane_line")
    assert rgb(open_lines) == channels(LINE)
    (text,) = [marker for marker in message.markers if marker.ns == "texts"]
    assert text.text == "EBH & 7"
    np.testing.assert_allclose(places([text.pose.position]), [[21.0, 2.5, 1.0]])


def rgb(marker):
    return tuple(round(255 * value) for value in (marker.color.r, marker.color.g, marker.color.b))


def test_dashed_lines_are_drawn_as_dashes_along_them(tmp_path):
    ((_, _, message),) = written(tmp_path, site())["/map/markers"]
    dashed = next(
        marker for marker in message.markers if marker.ns == "lane_dash" and rgb(marker) == channels(LINE)
    )
    ends = places(dashed.points).reshape(-1, 2, 3)
    np.testing.assert_allclose(np.linalg.norm(ends[:-1, 1] - ends[:-1, 0], axis=1), 1.0, atol=1e-3)
    gaps_m = np.linalg.norm(ends[1:, 0] - ends[:-1, 1], axis=1)
    np.testing.assert_allclose(gaps_m, 1.0, atol=1e-3)


def test_poses_are_transforms_at_their_times_and_a_path(tmp_path):
    sent = written(tmp_path, site(), trajectories=[drive()])
    assert len(sent["/tf"]) == 5
    for (_, time, message), stamp_s, pose in zip(
        sent["/tf"], drive().stamp_s, drive().map_from_vehicle, strict=True
    ):
        (transform,) = message.transforms
        assert (transform.header.frame_id, transform.child_frame_id) == ("map", "vehicle")
        stamp = transform.header.stamp
        assert time == stamp.sec * 10**9 + stamp.nanosec == round(stamp_s * 1e9)
        turned = transform.transform.rotation
        quaternion = np.array([[turned.x, turned.y, turned.z, turned.w]])
        np.testing.assert_allclose(rotation_from_quaternion(quaternion)[0], pose[:3, :3], atol=1e-12)
        np.testing.assert_array_equal(places([transform.transform.translation])[0], pose[:3, 3])
    ((_, time, path),) = sent["/vehicle/path"]
    assert time == round(START_S * 1e9)
    np.testing.assert_array_equal(
        places([pose.pose.position for pose in path.poses]), drive().map_from_vehicle[:, :3, 3]
    )


def test_several_drives_have_frames_of_their_own_in_the_order_of_time(tmp_path):
    sent = written(tmp_path, site(), trajectories=[drive(START_S + 1.1), drive()])
    times = [time for _, time, _ in sent["/tf"]]
    assert times == sorted(times)
    frames = {message.transforms[0].child_frame_id for _, _, message in sent["/tf"]}
    assert frames == {"vehicle_1", "vehicle_2"}
    assert {"/vehicle_1/path", "/vehicle_2/path"} <= set(sent)


def test_what_does_not_move_reaches_late_subscribers(tmp_path):
    (path,) = write_map(site(), tmp_path, "map", ["mcap"], trajectories=[drive()])
    with path.open("rb") as file:
        channels_by_topic = {
            channel.topic: channel.metadata["offered_qos_profiles"]
            for channel in make_reader(file).get_summary().channels.values()
        }
    latched = {topic for topic, profile in channels_by_topic.items() if "transient_local" in profile}
    assert latched == {"/map/features", "/map/markers", "/vehicle/path"}


def test_a_map_without_origin_and_drive_is_a_recording_too(tmp_path):
    sent = written(tmp_path, site(None))
    assert set(sent) == {"/map/features", "/map/markers"}
    ((_, _, message),) = sent["/map/features"]
    assert message.crs == ""
    assert np.isnan(message.latitude_deg)


def test_an_export_takes_poses_and_overlays_from_beside_the_map(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_geojson(site(), tmp_path / "map.geojson")
    write_tum(drive(), tmp_path / "trajectory.tum")
    cv2.imwrite(str(tmp_path / "overlay_front.png"), np.full((4, 6, 3), 90, np.uint8))
    assert run(["export", "map.geojson", "--format", "mcap", "--output", "there"]) == 0
    sent = messages_by_topic(tmp_path / "there" / "map.mcap")
    assert len(sent["/tf"]) == 5
    ((_, _, picture),) = sent["/front/overlay"]
    assert bytes(picture.data) == (tmp_path / "overlay_front.png").read_bytes()
    assert run(["export", "map.geojson", "--format", "csv", "--path", "trajectory.tum"]) == 2
    assert "lanelet2, opendrive and mcap have a use for it" in capsys.readouterr().err


def test_without_rosbags_a_recording_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_geojson(site(), tmp_path / "map.geojson")
    monkeypatch.setitem(sys.modules, "rosbags", None)
    assert run(["export", "map.geojson", "--format", "mcap"]) == 2
    words = capsys.readouterr().err
    assert words.count("\n") == 1
    assert "pip install 'v2hdm[ros]'" in words


@pytest.mark.parametrize("kind", messages.DEFINITIONS)
def test_the_example_package_holds_the_messages_as_they_are(kind):
    path = ROOT / "examples" / "ros2" / f"{kind}.msg"
    assert path.read_text(encoding="utf-8") == messages.DEFINITIONS[kind]

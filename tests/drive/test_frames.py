"""A calibration goes back into the tree of frames that the recording came with, whatever that is like."""

import json
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from tests.drive.bags import Messages, messages_of, mountings, write_ros1, write_ros2
from v2hdm.cli.main import run
from v2hdm.errors import DriveError, MapFileError
from v2hdm.geometry.ipm import initial_extrinsic
from v2hdm.geometry.rigid import camera_centre, exp, inverse, make_transform
from v2hdm.io.calibration.reading import Provenance, read_calibration
from v2hdm.io.calibration.writing import write_calibration, write_calibration_as
from v2hdm.io.drive import ReadOptions, read_drive
from v2hdm.records import Calibration, CameraFrames, FloatArray, FrameStep

pytestmark = pytest.mark.usefixtures("working_directory")

Tree = dict[tuple[str, str], FloatArray]
OPTICAL = make_transform(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
AXLE_M = 0.46
TURNED = exp(np.array([0.02, -0.03, 0.04, 0.01, -0.02, 0.015]))  # of a camera against where its tree has it


def at(x: float, y: float, z: float, *rpy_deg: float) -> FloatArray:
    rotation = Rotation.from_euler("xyz", rpy_deg or (0, 0, 0), degrees=True).as_matrix()
    return make_transform(rotation, np.array([x, y, z]))


def tree_of(prefix: str = "tractor_07/", footprint: bool = True) -> Tree:
    """Cameras on a roof bar on base_link, which is at axle height, above base_footprint."""
    edges: Tree = {("base_link", "roof_bar"): at(1.2, 0.0, 1.1, 0, 4, 0)}
    if footprint:
        edges["base_footprint", "base_link"] = at(0, 0, AXLE_M)
    for name, place in (("front", at(0.3, -0.1, 0.2, 0, 13, 0)), ("rear", at(-0.2, 0.1, 0.3, 1, 25, 180))):
        edges["roof_bar", f"{name}_link"] = place
        edges[f"{name}_link", f"{name}_optical"] = OPTICAL
    return {(prefix + parent, prefix + child): matrix for (parent, child), matrix in edges.items()}


def composed(tree: Mapping[tuple[str, str], FloatArray], dst: str, src: str) -> FloatArray:
    """``dst_from_src`` as TF composes it: up from either frame to the root."""

    def from_root(name: str) -> FloatArray:
        above = [parent for parent, child in tree if child == name]
        return from_root(above[0]) @ tree[above[0], name] if above else np.eye(4)

    return inverse(from_root(dst)) @ from_root(src)


def with_edge(tree: Tree, parent: str, child: str, matrix: FloatArray) -> Tree:
    """The tree after an edge was published: as TF has it, a frame hangs on the one stated last."""
    return {edge: value for edge, value in tree.items() if edge[1] != child} | {(parent, child): matrix}


def matrix_of(transform: Mapping[str, Mapping[str, float]]) -> FloatArray:
    turn = Rotation.from_quat([transform["rotation"][axis] for axis in "xyzw"]).as_matrix()
    return make_transform(turn, np.array([transform["translation"][axis] for axis in "xyz"]))


def applied(tree: Tree, path: Path) -> Tree:
    """The tree with the edge of a static_transform.yaml or an origin.urdf."""
    if path.suffix == ".yaml":
        (transform,) = yaml.safe_load(path.read_text())["transforms"]
        ends = transform["header"]["frame_id"], transform["child_frame_id"]
        return with_edge(tree, *ends, matrix_of(transform["transform"]))
    root = ET.parse(path).getroot()
    parent, child = (root.find(f"joint/{end}").get("link") for end in ("parent", "child"))  # type: ignore[union-attr]
    origin = root.find("joint/origin")
    xyz, rpy = ([float(value) for value in origin.get(key, "").split()] for key in ("xyz", "rpy"))  # type: ignore[union-attr]
    matrix = make_transform(Rotation.from_euler("xyz", rpy).as_matrix(), np.array(xyz))
    return with_edge(tree, str(parent), str(child), matrix)


def recorded(folder: Path, tree: Tree, prefix: str, child: str = "base_link", ros1: bool = False) -> Messages:
    """The drive in ``folder`` with the frames of ``tree``, as messages."""
    messages = messages_of(folder, ros1=ros1, fixed_frames=False)
    for _, topic, message in messages.rows:
        if topic.startswith("/sensing"):
            message.header.frame_id = f"{prefix}{topic.split('/')[2]}_optical"
        else:
            message.header.frame_id = f"{prefix}odom"
            message.child_frame_id = f"{prefix}{child}"
    if tree:
        messages.add(messages.rows[0][0], "/tf_static", messages.transforms(messages.rows[0][0], tree))
    messages.rows.sort(key=lambda row: row[0])
    return messages


def read(path, **options):
    return read_drive(path, ReadOptions(cache=str(path.parent / "cache"), **options))


def calibrated(camera, cam_from_vehicle):
    return Calibration(camera.info, cam_from_vehicle, frames=camera.frames)


@pytest.mark.parametrize("ros1", [False, True])
@pytest.mark.parametrize("prefix", ["", "tractor_07/"])
@pytest.mark.parametrize("footprint", [True, False])
@pytest.mark.parametrize("form", ["static_transform", "urdf"])
def test_a_calibration_applied_to_its_own_tree_is_the_calibration(
    form, footprint, prefix, ros1, folder, tmp_path
):
    """Without base_footprint the height of base_link is what the user states."""
    tree = tree_of(prefix, footprint)
    messages = recorded(folder, tree, prefix, ros1=ros1)
    bag = write_ros1(tmp_path / "site", messages) if ros1 else write_ros2(tmp_path / "site", messages)
    drive = read(bag)
    if not footprint:
        stated = f"vehicle_frame_height_m={AXLE_M}"
        assert run(["check", str(bag), "--no-ground", "--write", str(tmp_path / "d"), "--set", stated,
                    "--output", str(tmp_path / "out")]) in (0, 3)  # fmt: skip
        drive = read(tmp_path / "d")
    base = prefix + "base_link"
    for name, camera in drive.cameras.items():
        optical = f"{prefix}{name}_optical"
        base_from_cam = composed(tree, base, optical)
        ground_from_base = at(0, 0, AXLE_M)
        np.testing.assert_allclose(
            initial_extrinsic(camera), inverse(ground_from_base @ base_from_cam), atol=1e-6
        )
        truth = TURNED @ inverse(ground_from_base @ base_from_cam)  # where the camera really is
        path = write_calibration_as(form, calibrated(camera, truth), Provenance(), tmp_path, name)
        got = composed(applied(tree, path), base, optical)
        np.testing.assert_allclose(ground_from_base @ got, inverse(truth), atol=1e-9)
    poses = drive.recorded.map_from_vehicle
    np.testing.assert_allclose(poses[:, 2, 3], -AXLE_M, atol=1e-9)


def test_any_edge_on_the_way_may_be_replaced_instead(folder, tmp_path):
    tree = tree_of()
    drive = read(write_ros2(tmp_path / "site", recorded(folder, tree, "tractor_07/")))
    camera = drive.cameras["rear"]
    truth = TURNED @ initial_extrinsic(camera)
    path = write_calibration_as("static_transform", calibrated(camera, truth), Provenance(), tmp_path, "rear")
    lines = [line[2:] for line in path.read_text().splitlines() if line.startswith("# ")]
    others = yaml.safe_load("\n".join(lines))["instead"]
    assert [edge["child_frame_id"].split("/")[1] for edge in others] == ["base_link", "roof_bar", "rear_link"]
    for edge in others:
        changed = with_edge(tree, edge["frame_id"], edge["child_frame_id"], matrix_of(edge))
        got = composed(changed, "tractor_07/base_footprint", "tractor_07/rear_optical")
        np.testing.assert_allclose(got, inverse(truth), atol=1e-9)


def test_a_calibration_file_keeps_its_frames_for_a_later_export(folder, tmp_path, capsys):
    tree = tree_of("", footprint=False)
    bag = write_ros2(tmp_path / "site", recorded(folder, tree, ""))
    camera = read(bag).cameras["front"]
    frames = replace(camera.frames, height_m=AXLE_M)
    file = tmp_path / "calibration_front.yaml"
    calibration = Calibration(
        camera.info, TURNED @ initial_extrinsic(camera) @ at(0, 0, -AXLE_M), frames=frames
    )
    write_calibration(calibration, file)
    again = read_calibration(file).frames
    assert (again.vehicle, again.camera, again.height_m) == ("base_link", "front_optical", AXLE_M)
    for step, expected in zip(again.steps, frames.steps, strict=True):
        assert (step.parent, step.child) == (expected.parent, expected.child)
        np.testing.assert_allclose(step.parent_from_child, expected.parent_from_child, atol=1e-12)
    assert run(["export", str(file), "--format", "static_transform", "--format", "urdf"]) == 0
    for name in ("front_static_transform.yaml", "front_origin.urdf"):
        got = composed(applied(tree, tmp_path / name), "base_link", "front_optical")
        np.testing.assert_allclose(at(0, 0, AXLE_M) @ got, inverse(calibration.cam_from_vehicle), atol=1e-9)


def test_frames_that_nobody_stated_are_in_no_file(tmp_path, folder, capsys):
    camera = read_drive(folder).cameras["front"]
    file = tmp_path / "calibration_front.yaml"
    write_calibration(Calibration(camera.info, mountings()["front"]), file)
    for form in ("static_transform", "urdf"):
        assert run(["export", str(file), "--format", form]) == 2
        error = capsys.readouterr().err
        assert "add vehicle_frame and frame to drive.yaml" in error
        assert error.count("\n") == 1
    for form in ("camera_info", "kalibr", "opencv"):
        assert run(["export", str(file), "--format", form]) == 0
    assert "frame" not in "".join(path.read_text() for path in tmp_path.glob("front_*"))


def test_a_folder_drive_names_its_frames(folder, tmp_path):
    content = yaml.safe_load((folder / "drive.yaml").read_text())
    content |= {"vehicle_frame": "rover/base_link", "vehicle_frame_height_m": 0.3}
    content["poses"] = str(folder / "poses.tum")
    content.pop("truth")
    for name, entry in content["cameras"].items():
        entry["frame"] = f"rover/{name}_optical"
        entry |= {key: str(folder / entry[key]) for key in ("camera_info", "images")}
        for key in ("ipm", "initial_ipm", "roi_vehicle"):
            entry.pop(key)
        entry["mounting"] = {"xyz_m": [1.0, 0.0, 1.5], "rpy_deg": [0, 20, 0]}
    (tmp_path / "drive.yaml").write_text(yaml.safe_dump(content))
    drive = read_drive(tmp_path)
    camera = drive.cameras["front"]
    np.testing.assert_allclose(camera_centre(initial_extrinsic(camera)), [1.0, 0.0, 1.8], atol=1e-6)
    assert camera.centre_prior is not None
    np.testing.assert_allclose(camera.centre_prior.centre_vehicle, [0.0, 0.0, 2.3])
    calibration = calibrated(camera, initial_extrinsic(camera))
    path = write_calibration_as("static_transform", calibration, Provenance(), tmp_path, "front")
    got = applied({}, path)["rover/base_link", "rover/front_optical"]
    np.testing.assert_allclose(got[:3, 3], [1.0, 0.0, 1.5], atol=1e-6)


WRONG = {
    "space": ({"vehicle_frame": "base link"}, "not the name of a frame"),
    "number": ({"vehicle_frame": 7}, "vehicle_frame: expected a text"),
    "height": ({"vehicle_frame_height_m": 46}, "46 m is not the height of a vehicle's frame"),
    "text": ({"vehicle_frame_height_m": "axle"}, "vehicle_frame_height_m: expected a finite number"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_frame_that_cannot_be_is_refused(name, folder, tmp_path):
    content, message = WRONG[name]
    whole = yaml.safe_load((folder / "drive.yaml").read_text()) | content
    (tmp_path / "drive.yaml").write_text(yaml.safe_dump(whole))
    for camera in ("front", "rear", "truth"):
        (tmp_path / camera).symlink_to(folder / camera)
    (tmp_path / "poses.tum").symlink_to(folder / "poses.tum")
    with pytest.raises(DriveError, match=message):
        read_drive(tmp_path)
    file = tmp_path / "calibration_front.yaml"
    write_calibration(Calibration(read_drive(folder).cameras["front"].info, mountings()["front"]), file)
    file.write_text(file.read_text() + yaml.safe_dump(content))
    with pytest.raises(MapFileError, match=message):
        read_calibration(file)


# What recordings do to a tree of frames: what is read then, or what is said. Rows of /tf_static and of /tf.
LINK = ("base_link", "front_optical")
PLACE = at(1.0, 0.0, 1.5, -90, 0, -90) @ at(0, 0, 0, -15, 0, 0)


def framed(folder, tmp_path, static, moving=(), child="base_link", frame="front_optical"):
    """The mounting of the camera front that a bag of one camera has, or what is asked for."""
    messages = messages_of(folder, fixed_frames=False)
    messages.rows = [row for row in messages.rows if not row[1].startswith("/sensing/rear")]
    for _, topic, message in messages.rows:
        if topic.startswith("/sensing"):
            message.header.frame_id = frame
        else:
            message.child_frame_id = child
    first = messages.rows[0][0]
    for late_s, edges in static:
        messages.add(first + late_s, "/tf_static", messages.transforms(first + late_s, edges))
    for late_s, edges in moving:
        messages.add(first + late_s, "/tf", messages.transforms(first + late_s, edges))
    messages.rows.sort(key=lambda row: row[0])
    bag = write_ros2(tmp_path / "site", messages)
    try:
        drive = read(bag)
    except DriveError as refusal:
        return str(refusal)
    centre = camera_centre(initial_extrinsic(drive.cameras["front"]))
    return centre, drive.cameras["front"].frames, drive.recorded.map_from_vehicle[:, :3, 3]


READ = {
    "once": [(0.0, {LINK: PLACE})],
    "again and again": [(0.1 * k, {LINK: PLACE}) for k in range(9)],
    "late": [(1.2, {LINK: PLACE})],
    "stamps backwards": [(1.5, {LINK: PLACE}), (0.0, {LINK: PLACE})],
    "with slashes": [(0.0, {("/base_link", "/front_optical"): PLACE})],
    "with the prefix that the driver does not know": [(0.0, {("r1/base_link", "r1/front_optical"): PLACE})],
    "beside another robot": [(0.0, {LINK: PLACE, ("r2/base_link", "r2/front_optical"): at(9, 9, 9)})],
    "beside a broken edge": [(0.0, {LINK: PLACE, ("base_link", "wheel"): np.diag([np.nan] * 4)})],
    "on two ways that agree": [
        (
            0.0,
            {LINK: PLACE, ("base_link", "bar"): at(0, 0, 1), ("bar", "front_optical"): at(0, 0, -1) @ PLACE},
        )
    ],
}


@pytest.mark.parametrize("name", READ)
def test_a_mounting_is_read_however_its_tree_was_recorded(name, folder, tmp_path):
    centre, frames, _ = framed(folder, tmp_path, READ[name])
    np.testing.assert_allclose(centre, [1.0, 0.0, 1.5], atol=1e-6)
    assert frames.steps
    assert not frames.problem


@pytest.mark.parametrize("noise", [0.0, 0.0002])
def test_a_joint_that_is_held_still_on_tf_is_fixed(noise, folder, tmp_path):
    rng = np.random.default_rng(1)
    moving = [(0.1 * k, {LINK: exp(noise * rng.normal(size=6)) @ PLACE}) for k in range(15)]
    centre, frames, _ = framed(folder, tmp_path, [], moving)
    np.testing.assert_allclose(centre, [1.0, 0.0, 1.5], atol=0.002)
    assert frames.steps


ASKED = {
    "moved mast": (
        [(0.0, {("mast", "front_optical"): PLACE})],
        [(0.1 * k, {("base_link", "mast"): at(0, 0, 0.1 * k)}) for k in range(15)],
        r"cameras\.front\.mounting",
        "mast moves on base_link while recorded, by up to 1.4 m",
    ),
    "stated twice": (
        [(0.0, {LINK: PLACE}), (1.0, {LINK: at(0.2, 0, 0) @ PLACE})],
        [],
        r"cameras\.front\.mounting",
        "states where front_optical is on base_link several times, up to 0.2 m",
    ),
    "two parents": (
        [(0.0, {LINK: PLACE, ("base_link", "bar"): at(0, 0, 1), ("bar", "front_optical"): PLACE})],
        [],
        r"cameras\.front\.mounting",
        "front_optical hangs on bar and on base_link, which puts front_optical at two places on base_link",
    ),
    "other names": (
        [(0.0, {("chassis", "bar"): at(0, 0, 1), ("bar", "front_optical"): PLACE})],
        [],
        "vehicle_frame",
        "the cameras hang on bar, chassis",
        "poses.lever_arm_m",  # of base_link, which is not in the tree
    ),
}


@pytest.mark.parametrize("name", ASKED)
def test_a_tree_that_does_not_tell_the_mounting_says_why(name, folder, tmp_path, capsys):
    static, moving, key, why, *more_keys = ASKED[name]
    refusal = framed(folder, tmp_path, static, moving)
    assert isinstance(refusal, str)
    assert re.search(key, refusal)
    assert run(["check", str(tmp_path / "site"), "--no-ground", "--write", str(tmp_path / "d")]) == 2
    message = capsys.readouterr().err
    assert message.count("--set") == 1 + len(more_keys)
    assert all(f"--set {more}=" in message for more in more_keys)
    assert why in message


def test_the_vehicle_s_frame_that_is_named_leads_to_mountings_and_poses(folder, tmp_path, capsys):
    tree = {("chassis", "bar"): at(0, 0, 0.5), ("bar", "front_optical"): PLACE, ("bar", "gps"): at(1, 0, 0)}
    assert "vehicle_frame" in framed(folder, tmp_path, [(0.0, tree)], child="gps")
    write = ["check", str(tmp_path / "site"), "--no-ground", "--output", str(tmp_path / "out"), "--write"]
    assert run([*write, str(tmp_path / "d"), "--set", "vehicle_frame=chassis"]) in (0, 3)
    content = yaml.safe_load((tmp_path / "d" / "drive.yaml").read_text())
    assert content["vehicle_frame"] == "chassis"
    assert content["poses"]["lever_arm_m"] == [1.0, 0.0, 0.5]
    np.testing.assert_allclose(content["cameras"]["front"]["mounting"]["xyz_m"], [1.0, 0.0, 2.0])
    assert run([*write, str(tmp_path / "e"), "--set", "vehicle_frame=chasis"]) == 2
    assert "no frame 'chasis'; they have bar, chassis, front_optical, gps" in capsys.readouterr().err


def test_a_footprint_that_follows_the_ground_tells_the_height_of_base_link(folder, tmp_path):
    edge = ("base_footprint", "base_link")
    bobbing = [(0.1 * k, {edge: at(0, 0, AXLE_M + 0.01 * (k % 2), 0, k % 3, 0)}) for k in range(15)]
    centre, frames, _ = framed(folder, tmp_path, [(0.0, {LINK: PLACE})], bobbing)
    assert frames.vehicle == "base_link"
    np.testing.assert_allclose(frames.height_m, AXLE_M, atol=0.011)
    np.testing.assert_allclose(centre, [1.0, 0.0, 1.5 + frames.height_m], atol=1e-6)


def test_a_camera_that_its_driver_alone_knows_is_hung_on_the_vehicle(folder, tmp_path):
    """Its driver's own edges stay; the one that is missing is what the calibration states."""
    tree: Tree = {("base_link", "lidar"): at(0, 0, 1), ("front_link", "front_optical"): OPTICAL}
    assert "mounting" in framed(folder, tmp_path, [(0.0, tree)])
    mounting = {"xyz_m": [1.0, 0.0, 1.5], "rpy_deg": [0, 15, 0]}
    said = [f"cameras.front.mounting={json.dumps(mounting)}"]
    assert run(["check", str(tmp_path / "site"), "--no-ground", "--output", str(tmp_path / "out"),
                "--write", str(tmp_path / "d"), "--set", *said]) in (0, 3)  # fmt: skip
    camera = read(tmp_path / "d").cameras["front"]
    truth = TURNED @ initial_extrinsic(camera)
    path = write_calibration_as("urdf", calibrated(camera, truth), Provenance(), tmp_path, "front")
    hung = applied(tree, path)
    assert ("base_link", "front_link") in hung
    np.testing.assert_allclose(composed(hung, "base_link", "front_optical"), inverse(truth), atol=1e-9)


def test_a_tree_that_hangs_the_vehicle_on_the_camera_is_turned_around(tmp_path, folder):
    info = read_drive(folder).cameras["front"].info
    tree: Tree = {("eye", "mast"): at(0, 0.2, 1, 10, 20, 30), ("mast", "base_link"): at(0, 0, -1, 3, 2, 1)}
    steps = tuple(FrameStep(*edge, matrix) for edge, matrix in reversed(tree.items()))
    frames = CameraFrames("base_link", "eye", 0.0, steps)
    path = write_calibration_as(
        "urdf", Calibration(info, mountings()["front"], frames=frames), Provenance(), tmp_path, "front"
    )
    got = composed(applied(tree, path), "base_link", "eye")
    np.testing.assert_allclose(got, inverse(mountings()["front"]), atol=1e-9)


@pytest.mark.parametrize(
    ("child", "offset"), [("base_link", [0, 0, 0]), ("gps", [1, 0.5, 2]), ("/gps", [1, 0.5, 2])]
)
def test_poses_are_of_the_frame_that_they_name(child, offset, folder, tmp_path):
    tree: Tree = {LINK: PLACE, ("base_link", "gps"): at(*offset)}
    _, _, places = framed(folder, tmp_path, [(0.0, tree)], child=child)
    expected = read_drive(folder).recorded
    assert expected is not None
    lever = (expected.map_from_vehicle[:, :3, :3] @ np.array(offset, dtype=float)[:, None])[..., 0]
    np.testing.assert_allclose(places, expected.map_from_vehicle[:, :3, 3] - lever, atol=1e-6)


def test_poses_that_name_no_frame_are_asked_about_in_words(folder, tmp_path, capsys):
    assert "poses.lever_arm_m" in framed(folder, tmp_path, [(0.0, {LINK: PLACE})], child="")
    assert run(["check", str(tmp_path / "site"), "--no-ground", "--write", str(tmp_path / "d")]) == 2
    message = capsys.readouterr().err
    assert "/odom does not say of which frame its poses are" in message
    assert "from base_link: [0, 0, 0] if it is that frame itself" in message


def test_names_of_a_chain_touch(folder, tmp_path):
    drive = read(write_ros2(tmp_path / "site", recorded(folder, tree_of(), "tractor_07/")))
    frames = drive.cameras["front"].frames
    for nearer, far in pairwise(frames.steps):
        assert nearer.child == far.parent
    assert (frames.steps[0].parent, frames.steps[-1].child) == (frames.vehicle, frames.camera)

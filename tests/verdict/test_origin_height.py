"""Where the vehicle's frame is not on the ground, bare ground tells its height; else nothing is said."""

from dataclasses import replace

import numpy as np
import pytest

from tests.drive.bags import Messages, write_ros2
from tests.ground.scene import extrinsic, make_drive
from tests.verdict.drives import camera, drive, estimate, poses
from v2hdm.cli.main import run
from v2hdm.geometry.rigid import inverse
from v2hdm.ground.results import GroundStatus
from v2hdm.io.drive import read_drive
from v2hdm.records import CameraFrames, FrameStep
from v2hdm.verdict import Status, Verdict, known_frames
from v2hdm.verdict.inputs.origin import check_origin_height, height_to_state

AXLE_M = 0.46
ROI_SET = "cameras.front.roi_vehicle=[[4, -2.5], [11, -2.5], [11, 2.5], [4, 2.5]]"  # of so small images
CHAIN = (FrameStep("base_link", "eye", np.eye(4)),)
TREE = CameraFrames("base_link", "eye", 0.0, CHAIN, states_height=True)
TYPED = CameraFrames(states_height=True)
BORROWED = CameraFrames()


def judged(frames, *errors_m, survey=None, height_m=0.0):
    """The findings on cameras that the ground shows higher than stated by ``errors_m``."""
    names = [f"cam{k}" for k in range(len(errors_m))]
    stated = replace(frames, height_m=height_m)
    recorded = drive(poses(), tuple(names))
    cameras = {name: replace(camera(), frames=stated, centre_prior=survey) for name in names}
    ground = {name: estimate(name, up_m=error) for name, error in zip(names, errors_m, strict=True)}
    return replace(recorded, cameras=cameras), check_origin_height(replace(recorded, cameras=cameras), ground)


@pytest.mark.parametrize("errors_m", [(AXLE_M,), (AXLE_M, AXLE_M + 0.04), (0.2, 0.22, 0.19)])
@pytest.mark.parametrize("height_m", [0.0, 0.3])
def test_a_common_error_is_told_with_the_height_to_state(errors_m, height_m):
    recorded, (finding,) = judged(TREE, *errors_m, height_m=height_m)
    expected = height_m + np.mean(errors_m)
    assert finding.status is Status.WARN
    assert f"vehicle_frame_height_m: {expected:.2f}" in finding.says
    verdict = Verdict.of([finding])
    height_m_to_state = height_to_state(recorded, verdict)
    assert height_m_to_state is not None
    np.testing.assert_allclose(height_m_to_state, expected, atol=0.01)
    assert known_frames(recorded.cameras["cam0"], verdict).problem == finding.says


@pytest.mark.parametrize(
    ("frames", "errors_m"),
    [
        (TREE, (0.0,)),
        (TREE, (0.1,)),  # on its springs
        (TREE, (-0.06, 0.07)),
        (TREE, (0.5, 0.0)),  # one camera's own
        (TYPED, (0.3,)),  # a tape, or a memory
        (BORROWED, (0.6,)),  # a homography of the ground states no height above an origin
    ],
)
def test_heights_that_are_right_or_one_cameras_own_are_no_finding(frames, errors_m):
    recorded, findings = judged(frames, *errors_m)
    assert all(finding.status is Status.PASS for finding in findings)
    assert not known_frames(recorded.cameras["cam0"], Verdict.of(findings)).problem


def test_typed_mountings_that_all_count_from_the_axle_are_told():
    _, (finding,) = judged(TYPED, AXLE_M, AXLE_M + 0.03)
    assert finding.status is Status.WARN
    assert "the origin of mountings and poses" in finding.says


def test_ground_that_shows_no_height_is_said_so():
    recorded = drive(poses())
    recorded = replace(recorded, cameras={"front": replace(camera(), frames=TREE)})
    blind = replace(estimate(), status=GroundStatus.NO_TEXTURE, parameters={})
    (finding,) = check_origin_height(recorded, {"front": blind})
    assert finding.is_unobservable


def write_bag(folder, tmp_path, below_m, footprint=False):
    """A bag of a rendered floor whose base_link is ``below_m`` above the ground."""
    true = extrinsic()
    rendered = make_drive(folder, 40.0, true)
    messages = Messages()
    for image in rendered.images:
        data = image.path.read_bytes()
        messages.add(
            image.stamp_s, "/front/image/compressed", messages.compressed(image.stamp_s, data, "png", "eye")
        )
        info = messages.info(image.stamp_s, rendered.cameras["front"].info, "eye")
        messages.add(image.stamp_s, "/front/camera_info", info)
    assert rendered.trajectory is not None
    lift = np.eye(4)
    lift[2, 3] = below_m
    for stamp_s, pose in zip(rendered.trajectory.stamp_s, rendered.trajectory.map_from_vehicle, strict=True):
        messages.add(stamp_s, "/odom", messages.odometry(stamp_s, pose @ lift, np.zeros(36), "base_link"))
    edges = {("base_link", "eye"): inverse(lift) @ inverse(true)}
    if footprint:
        edges["base_footprint", "base_link"] = lift
    messages.add(0.0, "/tf_static", messages.transforms(0.0, edges))
    messages.rows.sort(key=lambda row: row[0])
    return write_ros2(tmp_path / "site", messages)


def test_check_asks_for_the_height_of_base_link_and_then_is_content(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_bag(tmp_path / "rendered", tmp_path, AXLE_M)
    write = ["check", "site", "--workers", "1", "--output", "out", "--set", ROI_SET]
    assert run([*write, "--write", "d"]) == 2
    question = capsys.readouterr().err.strip().splitlines()[-1]
    assert "height of base_link above the ground" in question
    height_m = float(question.rpartition("--set vehicle_frame_height_m=")[2])
    assert abs(height_m - AXLE_M) < 0.03
    assert not (tmp_path / "d" / "drive.yaml").exists()
    assert run([*write, "vehicle_frame_height_m=0", "--write", "e"]) == 0
    assert "WARN origin height (poses): all cameras show the ground" in capsys.readouterr().out
    assert run([*write, f"vehicle_frame_height_m={AXLE_M}", "--write", "d", "--output", "right"]) == 0
    assert "origin height" not in capsys.readouterr().out
    read = read_drive("d")
    np.testing.assert_allclose(read.recorded.map_from_vehicle[:, 2, 3], 0.0, atol=1e-6)  # type: ignore[union-attr]


def test_check_is_content_with_a_footprint(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_bag(tmp_path / "rendered", tmp_path, AXLE_M, footprint=True)
    assert run(["check", "site", "--write", "d", "--workers", "1", "--all", "--set", ROI_SET]) == 0
    assert "PASS origin height (poses): the ground is where" in capsys.readouterr().out

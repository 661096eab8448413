"""Between full searches a tracked vehicle looks only where its map says that markings are."""

import io
import json
from dataclasses import replace

import numpy as np
import pytest

from tests.localization.driven import DIAMOND, INTRINSIC, cameras, drive, mapped, moved, yard
from v2hdm.errors import ConfigError
from v2hdm.geometry.ipm import project_ground
from v2hdm.localization.live import _Eye
from v2hdm.localization.localizer import Localizer
from v2hdm.localization.pose import Status
from v2hdm.localization.regions import Ahead, Looking, View, expected_boxes
from v2hdm.localization.seeing import Look
from v2hdm.records import Marking


def in_regions(look, regions_px):
    """The part of a look that lies whole in regions (R, 4)."""
    if regions_px is None:
        return look
    low = np.array([marking.corners_px.min(axis=0) for marking in look.markings]).reshape(-1, 1, 2)
    high = np.array([marking.corners_px.max(axis=0) for marking in look.markings]).reshape(-1, 1, 2)
    is_in = ((low > regions_px[:, :2]) & (high < regions_px[:, 2:])).all(axis=2).any(axis=1)
    return replace(
        look,
        markings=tuple(m for m, is_kept in zip(look.markings, is_in, strict=True) if is_kept),
        lanes=(),
        is_whole=False,
    )


def followed(driven, hd_map, every_full=5, hidden=lambda frame, marking: False):
    """Poses of a drive whose cameras look where the localiser says, and each moment's regions by camera."""
    localizer = Localizer(
        hd_map, driven.calibrations, driven.rough(np.random.default_rng(0)), every_full=every_full
    )
    poses, regions = [], []
    for frame, (looks, motion) in enumerate(zip(driven.looks, driven.motion, strict=True)):
        localizer.update([], motion)
        now = {look.camera: localizer.regions(look.camera, look.stamp_s) for look in looks}
        shown = [
            replace(look, markings=tuple(m for m in look.markings if not hidden(frame, m))) for look in looks
        ]
        poses.append(localizer.update([in_regions(look, now[look.camera]) for look in shown]))
        regions.append(now)
    return poses, regions


@pytest.mark.parametrize("seed", range(2))
def test_the_pose_is_as_good_as_with_full_searches(seed):
    painted = yard(seed)
    driven = drive(painted, seed)
    rmse = {}
    for every_full in (1, 5):
        poses, regions = followed(driven, mapped(painted, seed), every_full)
        tracked = [(frame, pose) for frame, pose in enumerate(poses) if pose.status == Status.TRACKING]
        errors = np.array([driven.errors(pose, frame) for frame, pose in tracked])
        bounds = np.array([(*pose.protection_m, pose.protection_rad) for _, pose in tracked])
        assert (np.abs(errors) < bounds).all()
        rmse[every_full] = np.sqrt((errors[:, :2] ** 2).mean(axis=0))
        partial = [box is not None for now in regions[len(poses) // 2 :] for box in now.values()]
        assert np.mean(partial) <= 0.8 * (every_full > 1)
        assert np.mean(partial) >= 0.5 * (every_full > 1)
    assert (rmse[5] < np.maximum(1.3 * rmse[1], 0.01)).all()


def test_of_every_five_images_of_a_camera_one_is_searched_as_a_whole():
    painted = yard(2)
    driven = drive(painted, 2)
    _, regions = followed(driven, mapped(painted, 2))
    for camera in ("front", "rear"):
        full = [frame for frame, now in enumerate(regions) if now[camera] is None]
        assert max(np.diff(full)) <= 5


def test_a_marking_that_appears_beside_all_regions_is_found_at_the_next_full_search():
    painted = yard(3)
    driven = drive(painted, 3)
    hd_map = mapped(painted, 3)
    strange = driven.looks[-1][0].markings[0]
    appears = 45
    corner_px = np.array([[60.0, 650.0], [60.0, 640.0], [50.0, 640.0], [50.0, 650.0]])
    new = replace(strange, kind="stop_line", corners_px=corner_px)
    looks = [
        [replace(look, markings=(*look.markings, new)) if frame >= appears else look for look in moment]
        for frame, moment in enumerate(driven.looks)
    ]
    _, regions = followed(replace(driven, looks=looks), hd_map)
    for camera in ("front", "rear"):
        shown = [
            new in in_regions(Look(camera, 0.0, (new,)), now[camera]).markings for now in regions[appears:]
        ]
        assert not all(shown)
        assert any(shown[:5])


def test_markings_that_are_hidden_make_the_next_look_a_full_one():
    painted = yard(4)
    driven = drive(painted, 4)
    _, regions = followed(driven, mapped(painted, 4), hidden=lambda frame, marking: 40 <= frame < 50)
    # One image, or two, without what they were to show, and all after these until some of it is there.
    assert all(box is None for now in regions[42:50] for box in now.values())
    assert any(box is not None for now in regions[53:60] for box in now.values())


def followed_by_second_looks(driven, hd_map, late, changed=lambda frame, look: look):
    """As ``followed``, with whole searches that come so many moments after the looks at parts."""
    localizer = Localizer(hd_map, driven.calibrations, driven.rough(np.random.default_rng(0)))
    poses, answers, waiting = [], [], []
    for frame, (looks, motion) in enumerate(zip(driven.looks, driven.motion, strict=True)):
        localizer.update([look for due, look in waiting if due == frame])
        localizer.update([], motion)
        now = {look.camera: localizer.glance(look.camera, look.stamp_s) for look in looks}
        shown = [changed(frame, look) for look in looks]
        waiting += [
            (frame + late, replace(look, is_second=True)) for look in shown if now[look.camera].is_all_later
        ]
        poses.append(localizer.update([in_regions(look, now[look.camera].regions_px) for look in shown]))
        answers.append(now)
    return poses, answers


@pytest.mark.parametrize("late", [1, 3])
def test_whole_searches_follow_looks_at_parts_and_come_as_often(late):
    painted = yard(2)
    driven = drive(painted, 2)
    poses, answers = followed_by_second_looks(driven, mapped(painted, 2), late)
    for camera in ("front", "rear"):
        tracked = [
            now[camera] for now, pose in zip(answers, poses, strict=True) if pose.status == Status.TRACKING
        ]
        assert np.mean([ahead.regions_px is None for ahead in tracked]) < 0.1
        whole = [
            frame
            for frame, now in enumerate(answers)
            if now[camera].is_all_later or now[camera].regions_px is None
        ]
        assert max(np.diff(whole)) <= 5
    errors = np.array(
        [driven.errors(pose, k) for k, pose in enumerate(poses) if pose.status == Status.TRACKING]
    )
    bounds = np.array(
        [(*pose.protection_m, pose.protection_rad) for pose in poses if pose.status == Status.TRACKING]
    )
    assert (np.abs(errors) < bounds).all()
    assert np.sqrt((errors[:, :2] ** 2).mean(axis=0)).max() < 0.03


def test_where_no_whole_search_comes_an_image_is_searched_at_once():
    painted = yard(2)
    driven = drive(painted, 2)
    _, answers = followed_by_second_looks(driven, mapped(painted, 2), late=1000)
    at_once = [frame for frame, now in enumerate(answers) if now["front"].regions_px is None]
    assert 5 < max(np.diff(at_once)) <= 10


def test_while_an_image_is_searched_at_once_the_next_ones_are_not():
    painted = yard(2)
    driven = drive(painted, 2)
    localizer = Localizer(mapped(painted, 2), driven.calibrations, driven.rough(np.random.default_rng(0)))
    at_once, are_searched = [], []
    for looks, motion in zip(driven.looks, driven.motion, strict=True):
        localizer.update([], motion)
        now = {look.camera: localizer.glance(look.camera, look.stamp_s) for look in looks}
        localizer.update([in_regions(look, now[look.camera].regions_px) for look in looks])
        are_searched.append(
            [ahead.regions_px is None for ahead in localizer.ahead("front", looks[0].stamp_s)]
        )
        at_once.append(now["front"].regions_px is None)
    # No whole search ever follows a look at parts: now and then one comes at once, the images after it wait.
    first = at_once.index(False)
    are_searched = are_searched[first:]
    assert any(images[0] for images in are_searched)
    assert not any(images[0] and images[1] for images in are_searched)


def test_of_two_cameras_that_show_too_little_one_gives_way_for_one_image():
    painted = yard(2)
    driven = drive(painted, 2)

    def changed(frame, look):
        return replace(look, markings=()) if 40 <= frame < 43 else look

    _, answers = followed_by_second_looks(driven, mapped(painted, 2), 2, changed)
    at_once = {
        camera: [answers[frame][camera].regions_px is None for frame in (41, 42)]
        for camera in ("front", "rear")
    }
    assert at_once == {"front": [True, True], "rear": [False, True]}
    assert answers[41]["rear"].is_all_later


def test_what_second_looks_alone_show_speaks_against_the_map():
    painted = yard(3)
    extra = [Marking("diamond", DIAMOND + np.array([x, 5.5]), 10) for x in np.arange(30.0, 100.0, 2.0)]
    driven = drive(replace(painted, markings=(*painted.markings, *extra)), 3)
    poses, answers = followed_by_second_looks(driven, mapped(painted, 3), 2)
    entered = int(np.argmax(driven.poses[:, 0, 3] > 22.0))
    said = next(frame for frame, pose in enumerate(poses) if frame >= entered and pose.reasons)
    assert "the map explains" in poses[said].reasons[0]
    assert any(now["front"].is_all_later for now in answers[entered : said + 1])


def test_a_second_look_at_an_image_that_nobody_knows_changes_nothing():
    painted = yard(3)
    driven = drive(painted, 3, seconds=2.0)
    localizer = Localizer(mapped(painted, 3), driven.calibrations, driven.rough(np.random.default_rng(0)))
    for looks, motion in zip(driven.looks, driven.motion, strict=True):
        pose = localizer.update(looks, motion)
    unknown = replace(driven.looks[-1][0], stamp_s=driven.stamp_s[-1] - 0.05, is_second=True)
    again = localizer.update([unknown])
    np.testing.assert_array_equal(again.map_from_vehicle, pose.map_from_vehicle)
    assert again.images_s == pose.images_s
    assert again.reasons == pose.reasons


def test_until_the_place_is_sure_all_is_searched():
    painted = yard(5)
    driven = drive(painted, 5, seconds=2.0)
    poses, regions = followed(driven, mapped(painted, 5))
    first = next(frame for frame, pose in enumerate(poses) if pose.status == Status.TRACKING)
    assert all(box is None for now in regions[: first + 1] for box in now.values())


def test_where_markings_were_repainted_it_is_said_with_looks_at_regions_too():
    painted = yard(7)
    driven = drive(painted, 7, seconds=10.0)
    poses, _ = followed(driven, moved(mapped(painted, 7), 0.5, 0.3, beyond_m=32.0))
    entered = int(np.argmax(driven.poses[:, 0, 3] > 32.0))
    said = next(frame for frame, pose in enumerate(poses) if frame >= entered and pose.reasons)
    assert said - entered < 25
    for frame, pose in enumerate(poses):
        if pose.status == Status.TRACKING:
            assert (np.abs(driven.errors(pose, frame)) < [*pose.protection_m, pose.protection_rad]).all()


def test_boxes_hold_the_markings_of_the_true_pose():
    painted = yard(6)
    driven = drive(painted, 6, seconds=4.0)
    localizer = Localizer(mapped(painted, 6), driven.calibrations, driven.rough(np.random.default_rng(0)))
    for looks, motion in zip(driven.looks, driven.motion, strict=True):
        localizer.update(looks, motion)
    belief = localizer._belief
    scene = localizer._scene(belief, driven.looks[-1][0], localizer_quads(driven))
    boxes = expected_boxes(belief, scene, 4.0)
    corners = np.array([marking.corners_map for marking in painted.markings])
    cam_from_map = cameras()["front"].cam_from_vehicle @ np.linalg.inv(driven.poses[-1])
    pixels, depth_m = project_ground(INTRINSIC, np.tile(cam_from_map, (len(corners), 1, 1)), corners)
    for box in boxes:
        is_in = ((pixels > box[:2]) & (pixels < box[2:])).all(axis=(1, 2)) & (depth_m > 0).all(axis=1)
        assert is_in.any()


def localizer_quads(driven):
    """No detection at all."""
    from v2hdm.localization.seeing import sighted

    return sighted(Look("front", 0.0), driven.calibrations["front"])


def test_a_number_of_images_below_one_is_refused():
    with pytest.raises(ConfigError, match="give a number of images, 1 or more"):
        Localizer(yard(0), cameras(), every_full=0)


class Asked:
    """A localiser that says the same of every image."""

    def __init__(self, regions_px):
        self.regions_px = regions_px
        self.now_s = None

    def ahead(self, camera, now_s):
        self.now_s = now_s
        return [Ahead(5.2, self.regions_px, is_all_later=True), Ahead(5.3, None)]


def test_a_camera_is_told_of_the_images_to_come_by_the_clock_of_its_files():
    eye = _Eye("front", io.StringIO(), delay_s=0.02)
    answer_to_eye = Asked(np.array([[1.0, 2.0, 3.0, 4.0]]))
    eye.point(answer_to_eye, now_s=5.15)
    assert answer_to_eye.now_s == pytest.approx(5.13)
    lines = [json.loads(line) for line in eye.stream.getvalue().splitlines()]
    assert [line["stamp_s"] for line in lines] == pytest.approx([5.22, 5.32])
    assert [line["regions_px"] for line in lines] == [[[1.0, 2.0, 3.0, 4.0]], None]
    assert [line.get("all_later", False) for line in lines] == [True, False]


def test_a_camera_that_has_ended_is_told_nothing_more():
    class Closed(io.StringIO):
        def write(self, text):
            raise BrokenPipeError

    eye = _Eye("front", Closed(), delay_s=0.0)
    eye.point(Asked(None), now_s=5.15)
    assert eye.stream.getvalue() == ""


def test_images_to_come_are_those_at_the_pace_of_the_last_ones_wherever_one_was_left_out():
    looking = Looking(5)
    assert looking.stamps_ahead("front", 5.0) == []
    for stamp_s in (5.0, 5.1, 5.3):
        looking.of("front").note(stamp_s, True, 9)
    assert looking.stamps_ahead("front", 5.35) == pytest.approx([5.4, 5.5, 5.6, 5.7])
    assert looking.stamps_ahead("front", 5.55) == pytest.approx([5.5, 5.6, 5.7, 5.8])
    looking.of("rear").note(5.0, True, 9)
    looking.of("rear").note(7.0, True, 9)
    assert looking.stamps_ahead("rear", 7.1) == []


@pytest.fixture(scope="module")
def view():
    """A tracked vehicle's belief, and what its camera ahead has before it."""
    painted = yard(2)
    driven = drive(painted, 2, seconds=6.0)
    localizer = Localizer(mapped(painted, 2), driven.calibrations, driven.rough(np.random.default_rng(0)))
    for looks, motion in zip(driven.looks, driven.motion, strict=True):
        localizer.update(looks, motion)
    scene = localizer._scene(localizer._belief, Look("front", 0.0), localizer_quads(driven))
    return View(localizer._belief, scene)


@pytest.mark.parametrize("late", [0, 1, 2])
def test_of_every_five_images_one_is_whole_however_late_they_are_told(view, late):
    """An image is told of ``late`` images before, when newer ones have not been seen."""
    looking = Looking(5)
    regions_of = {}
    wholes = []
    for number in range(60):
        regions_px = regions_of.get(number)
        wholes.append(regions_px is None)
        looking.of("front").note(0.1 * number, regions_px is None, 9)
        first = number + late + 1
        stamps_s = [0.1 * (first + later) for later in range(4)]
        for later, ahead in enumerate(looking.ahead("front", stamps_s, lambda stamp_s: view, 4.0)):
            regions_of[first + later] = ahead.regions_px
    assert max(np.diff(np.flatnonzero(wholes))) <= 5
    assert np.mean(wholes[10:]) <= 0.25


def test_cameras_search_whole_images_by_turns(view):
    looking = Looking(5)
    regions_of = dict.fromkeys(("front", "rear"))
    are_both_whole = []
    for number in range(60):
        are_both_whole.append(regions_of["front"] is None and regions_of["rear"] is None)
        for camera, regions_px in regions_of.items():
            looking.of(camera).note(0.1 * number, regions_px is None, 9)
        for camera in regions_of:
            (ahead,) = looking.ahead(camera, [0.1 * (number + 1)], lambda stamp_s: view, 4.0)
            regions_of[camera] = ahead.regions_px
    assert not any(are_both_whole[6:])


def test_a_camera_keeps_out_of_the_way_of_whole_searches_that_another_one_needs(view):
    """Requests go out four images ahead: the camera ahead is to search three in a row as a whole."""
    looking = Looking(5)
    regions_of = {"front": {}, "rear": {}}
    are_both_whole = []
    rear = []
    for number in range(80):
        now = {camera: of_camera.get(number) is None for camera, of_camera in regions_of.items()}
        are_both_whole.append(all(now.values()))
        rear.append(now["rear"])
        for camera, is_whole in now.items():
            looking.of(camera).note(0.1 * number, is_whole, 9)
        for camera, of_camera in regions_of.items():

            def view_at(stamp_s, camera=camera):
                needs_all = camera == "front" and round(10 * stamp_s) % 17 in (0, 1, 2)
                return None if needs_all else view

            stamps_s = [0.1 * (number + later) for later in range(1, 5)]
            for ahead in looking.ahead(camera, stamps_s, view_at, 4.0):
                of_camera[round(10 * ahead.stamp_s)] = ahead.regions_px
    assert not any(are_both_whole[6:])
    assert max(np.diff(np.flatnonzero(rear))) <= 5

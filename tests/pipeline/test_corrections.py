"""A person's corrections of a map hold in the next run, and nothing else changes."""

import html

import numpy as np
import pytest
import yaml

from tests.ports import run_config
from v2hdm.errors import MapFileError
from v2hdm.io.maps.corrections import (
    ACCEPTED,
    ADDED,
    ANSWERED,
    CORRECTED,
    REJECTED,
    Correction,
    read_corrections,
    write_corrections,
)
from v2hdm.io.maps.evidence import read_exclusions
from v2hdm.io.maps.reading import read_geojson
from v2hdm.io.trajectory import read_tum
from v2hdm.pipeline.config import MapConfig
from v2hdm.pipeline.run import run
from v2hdm.site.candidates import Candidates
from v2hdm.site.corrections import Stated, heard_of


@pytest.fixture(scope="module")
def corrected(small_mapped, small_drive, tmp_path_factory):
    """The map before, what a person says of it, and the folder and verdict of the next run."""
    folder, (result, cache) = tmp_path_factory.mktemp("corrected"), small_mapped
    before = read_geojson(result / "map.geojson").markings
    lane = longest_lane(result)
    (left_out, *_) = read_exclusions(result / "excluded.geojson")
    manhole, bar, dragged = before[:3]
    place = (dragged.corners_map[1] + [0.04, -0.03]).tolist()
    bare = bare_place(before, read_tum(result / "trajectory.tum").map_from_vehicle[:, :2, 3])
    again = before[3]
    said = [
        Correction(says=REJECTED, kind=manhole.kind, outline_map=manhole.corners_map.tolist(),
                   marking=manhole.id, reason="a manhole"),
        Correction(says=CORRECTED, kind=bar.kind, outline_map=bar.corners_map.tolist(),
                   new_kind="crosswalk_bar"),
        Correction(says=CORRECTED, kind=dragged.kind, outline_map=dragged.corners_map.tolist(),
                   moved={2: place}, sigma_m=0.005),
        Correction(says=ACCEPTED, kind=left_out.kind, outline_map=[left_out.position_map.tolist()]),
        Correction(says=CORRECTED, kind="diamond", outline_map=[[500.0, 500.0]]),
        Correction(says=ADDED, kind="diamond", outline_map=bare.tolist()),
        Correction(says=ADDED, kind=again.kind, outline_map=(again.corners_map + 0.02).tolist()),
        Correction(says=REJECTED, kind=lane.kind, outline_map=lane.points_map.tolist(), is_line=True),
        Correction(says=ADDED, kind=lane.kind, outline_map=half_of(lane).tolist(), is_line=True),
        Correction(says=ANSWERED, kind="line", outline_map=[[1.0, 2.0]], answer="noted"),
        Correction(says=ANSWERED, kind="direction", outline_map=[[900.0, 0.0], [905.0, 0.0]], answer="along"),
    ]  # fmt: skip
    path = folder / "corrections.yaml"
    write_corrections(said, str(result), path)
    changes = {"cache": str(cache), "map": MapConfig(corrections=str(path))}
    after = run(run_config(small_drive, folder / "out", **changes))
    return before, left_out, after


def longest_lane(folder):
    return max(read_geojson(folder / "map.geojson").lanes, key=lambda lane: len(lane.points_map))


def half_of(lane):
    return lane.points_map[: len(lane.points_map) // 2] + 0.05


SQUARE = np.array([[-0.3, -0.3], [0.3, -0.3], [0.3, 0.3], [-0.3, 0.3]])


def bare_place(markings, route_map):
    """A square on the route without paint near it, that the drive passes."""
    middles = np.array([marking.corners_map.mean(axis=0) for marking in markings])
    away_m = [np.linalg.norm(middles - place, axis=1).min() for place in route_map[8:-8]]
    return SQUARE + route_map[8:-8][int(np.argmax(away_m))]


def nearest(markings, place):
    return min(markings, key=lambda marking: np.linalg.norm(marking.corners_map.mean(axis=0) - place))


def test_rejected_markings_stay_out_with_the_reason_and_accepted_ones_come_in(corrected):
    before, left_out, result = corrected
    after = read_geojson(result.folder / "map.geojson").markings
    middle = before[0].corners_map.mean(axis=0)
    assert np.linalg.norm(nearest(after, middle).corners_map.mean(axis=0) - middle) > 0.5
    excluded = read_exclusions(result.folder / "excluded.geojson")
    assert "rejected by a person: a manhole" in [exclusion.reason for exclusion in excluded]
    came = nearest(after, left_out.position_map)
    assert np.linalg.norm(came.corners_map.mean(axis=0) - left_out.position_map) < 0.4
    assert len(after) == len(before) + 1  # one out, one in, one added


def test_a_class_is_fixed_and_a_dragged_corner_is_where_it_was_put(corrected):
    before, _, result = corrected
    after = read_geojson(result.folder / "map.geojson").markings
    assert nearest(after, before[1].corners_map.mean(axis=0)).kind == "crosswalk_bar"
    moved = nearest(after, before[2].corners_map.mean(axis=0))
    assert moved.corners_map[1] - before[2].corners_map[1] == pytest.approx([0.04, -0.03], abs=3e-3)
    assert moved.corners_map[[0, 2, 3]] == pytest.approx(before[2].corners_map[[0, 2, 3]], abs=0.02)
    same = [nearest(after, marking.corners_map.mean(axis=0)) for marking in before[3:]]
    off_m = [np.abs(a.corners_map - b.corners_map).max() for a, b in zip(same, before[3:], strict=True)]
    assert max(off_m) < 0.005


def test_an_added_marking_is_in_the_map_and_the_images_say_that_nothing_is_painted_there(corrected):
    before, _, result = corrected
    bare = bare_place(before, read_tum(result.folder / "trajectory.tum").map_from_vehicle[:, :2, 3])
    added = nearest(read_geojson(result.folder / "map.geojson").markings, bare.mean(axis=0))
    assert (added.kind, added.sightings) == ("diamond", 0)
    assert added.corners_map == pytest.approx(bare, abs=0.01)
    heard = [entry for entry in result.metrics["corrections"] if entry["says"] == "added"]
    assert sorted(entry["against"] for entry in heard) == ["", "the images show paint on 0 % of it"]


def test_half_of_a_lane_line_that_was_split_and_deleted_is_left_where_the_images_show_it(
    corrected, small_mapped
):
    lane = longest_lane(small_mapped[0])
    expected = lane.points_map[: len(lane.points_map) // 2]
    lanes = read_geojson(corrected[2].folder / "map.geojson").lanes
    (left,) = [other for other in lanes if np.abs(other.points_map[0] - expected[0]).max() < 0.2]
    assert left.points_map[-1] == pytest.approx(expected[-1], abs=0.1)
    beside_m = np.linalg.norm(left.points_map[:, None] - expected, axis=2).min(axis=1)
    assert beside_m.max() < 0.35
    heard = {entry["says"]: entry["against"] for entry in corrected[2].metrics["corrections"]}
    assert heard["drawn"] == ""


def test_an_added_marking_on_paint_that_the_images_show_is_where_they_show_it(corrected):
    before, _, result = corrected
    after = read_geojson(result.folder / "map.geojson").markings
    again = nearest(after, before[3].corners_map.mean(axis=0))
    assert again.sightings == before[3].sightings
    assert again.corners_map == pytest.approx(before[3].corners_map, abs=0.005)


def test_a_correction_of_nothing_is_a_finding_and_no_silence(corrected):
    (finding,) = [
        candidate for candidate in corrected[2].verdict.findings if candidate.check == "corrections"
    ]
    assert "1 of 9 match no candidate" in finding.says
    assert "diamond at (500.00, 500.00)" in finding.says


def test_what_the_map_follows_is_listed_beside_what_the_images_show(corrected):
    of_paint = [h for h in corrected[2].metrics["corrections"] if not h["says"].startswith("answered")]
    listed = {heard["says"]: heard["against"] for heard in of_paint}
    assert set(listed) == {
        "rejected",
        "of class crosswalk_bar",
        "corner 2 moved",
        "accepted",
        "added",
        "drawn",
        "deleted",
    }
    assert listed["of class crosswalk_bar"] == ""
    headlines = [line for line in corrected[2].headlines if line.startswith("correction followed: ")]
    assert len(headlines) == 8
    assert any("rejected" in line for line in headlines)
    log = (corrected[2].folder / "run.log").read_text()
    assert all(line in log for line in headlines)
    (finding,) = [f for f in corrected[2].verdict.findings if f.check == "corrections against images"]
    against = [says for says in listed.values() if says]
    assert finding.value == len(against)
    assert all(says in finding.says for says in against)


def test_the_report_lists_every_correction(corrected):
    page = (corrected[2].folder / "report.html").read_text()
    listed = page.split("Corrections by hand", 1)[1].split("</table>", 1)[0]
    corrections = corrected[2].metrics["corrections"]
    assert listed.count("<tr") == 1 + len(corrections)
    assert all(html.escape(heard["says"]) in listed for heard in corrections)


@pytest.mark.parametrize(("by_m", "is_against"), [(0.14, True), (0.03, False)])
def test_a_corner_that_is_dragged_off_the_paint_contradicts_the_images(by_m, is_against):
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    common = 0.3**2 * np.tile(np.eye(2), (4, 4)) + 0.004**2 * np.eye(8)
    shown = Candidates(square[None], common[None])
    said = Correction(
        says=CORRECTED, kind="diamond", outline_map=square.tolist(), moved={3: [1.0 + by_m, 1.0]}
    )
    (heard,) = heard_of(Stated({}, {0: said}), [None], np.array([9.0]), np.array([12]), shown)
    assert heard.says == "corner 3 moved"
    assert bool(heard.against) is is_against
    assert not is_against or heard.against == "the images show the paint 14.0 cm from there"


@pytest.mark.parametrize(("log_odds", "reason", "is_against"), [(9.0, None, True), (3.0, None, False)])
def test_a_rejection_of_what_the_images_surely_show_contradicts_them(log_odds, reason, is_against):
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    said = Correction(says=REJECTED, kind="diamond", outline_map=square.tolist())
    stated = Stated.of([said], square[None], ["diamond"])
    shown = Candidates(square[None], 1e-6 * np.eye(8)[None])
    (heard,) = heard_of(stated, [reason], np.array([log_odds]), np.array([12]), shown)
    assert heard.sentence == "diamond at (0.50, 0.50): rejected" + ", but 12 images show it" * is_against


def test_a_dragged_corner_has_the_error_of_the_others_and_its_own():
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    common = 0.03**2 * np.tile(np.eye(2), (4, 4)) + 0.001**2 * np.eye(8)
    shift = np.array([0.2, -0.1])  # of the whole map since the person saw it
    now = Candidates((square + shift)[None], common[None])
    correction = Correction(
        says=CORRECTED, kind="diamond", outline_map=square.tolist(), moved={3: [1.1, 1.2]}
    )
    placed = Stated({}, {0: correction}).placed(now, now)
    assert placed.corners_map[0, 2] == pytest.approx(np.array([1.1, 1.2]) + shift)
    assert placed.corners_map[0, [0, 1, 3]] == pytest.approx(square[[0, 1, 3]] + shift)
    block = placed.covariance_m2[0][4:6, 4:6]
    assert block == pytest.approx((0.03**2 + 0.001**2 / 3 + 0.02**2) * np.eye(2))
    difference = np.kron([0, -1, 1, 0], np.eye(2))  # of two corners the common error cancels
    assert np.sqrt(np.trace(difference @ placed.covariance_m2[0] @ difference.T) / 2) == pytest.approx(
        0.02, abs=2e-3
    )


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"says": "maybe"}, "expected one of accepted, rejected, corrected, added, got 'maybe'"),
        ({"moved": {5: [0, 0]}}, "no corner 5; quadrilaterals have 1 to 4"),
        ({"outline_map": [[0]]}, "outline_map: expected N x 2 numbers"),
        ({"reasons": "x"}, "unknown key 'reasons'; did you mean 'reason'"),
        ({"sigma_m": 0}, "sigma_m above 0"),
    ],
)
def test_a_damaged_file_names_its_entry(change, says, tmp_path):
    square = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
    entry = {"says": "corrected", "class": "diamond", "outline_map": square} | change
    path = tmp_path / "corrections.yaml"
    path.write_text(yaml.safe_dump({"corrections": [entry]}))
    with pytest.raises(MapFileError, match=r"corrections\[0\]") as error:
        read_corrections(path)
    assert says in str(error.value)


def test_what_is_written_is_read_back(tmp_path):
    outline = [[0.0, 1.0], [1.0, 1.0], [1.0, 2.0], [0.0, 2.0]]
    moved = {"moved": {2: [1.25, 1.0]}, "sigma_m": 0.01}
    correction = Correction(
        says=CORRECTED, kind="diamond", marking=4, outline_map=outline, new_kind="arrow", **moved
    )
    write_corrections([correction], "outputs/port1", tmp_path / "corrections.yaml")
    assert read_corrections(tmp_path / "corrections.yaml") == [correction]


def test_answers_on_lanes_are_told_and_one_without_a_lane_is_a_warning(corrected):
    _, _, result = corrected
    answered = [entry for entry in result.metrics["corrections"] if entry["says"].startswith("answered")]
    assert [entry["place"] for entry in answered] == ["line at (1.00, 2.00)", "direction at (902.50, 0.00)"]
    assert answered[0]["against"] == ""
    assert "no lane lies at (900.0, 0.0)" in answered[1]["against"]
    (finding,) = [finding for finding in result.verdict.findings if finding.check == "answers on lanes"]
    assert finding.status.value == "WARN"
    assert "1 of 2 cannot be followed" in finding.says

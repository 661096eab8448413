"""Stretches of images that are those of another drive, by which views find which markings."""

from types import SimpleNamespace

import numpy as np
import pytest

from v2hdm.errors import MappingError
from v2hdm.faults import ScoreTest, table
from v2hdm.mapping import foreign, inputs, recovery
from v2hdm.mapping.foreign import foreign_segment
from v2hdm.mapping.results import ForeignSegment
from v2hdm.verdict.results.solution import _ODDS_LIMIT

FRAMES, IN_VIEW = 90, 8


def stretch(monkeypatch, is_found, first_seen):
    """The stretch of a drive whose marking g is in view from frame ``first_seen[g]`` on."""
    group = np.repeat(np.arange(len(first_seen)), IN_VIEW)
    frame = (first_seen[:, None] + np.arange(IN_VIEW)).ravel()
    inside = (frame >= 0) & (frame < FRAMES)
    group, frame = group[inside], frame[inside]
    is_sighting = np.array([is_found(g, f) for g, f in zip(group.tolist(), frame.tolist(), strict=True)])
    monkeypatch.setattr(foreign, "easy_views", lambda *_: (group, frame))
    poses, corners = np.tile(np.eye(4), (FRAMES, 1, 1)), np.zeros((len(first_seen), 4, 2))
    poses[:, 0, 3], corners[..., 0] = np.arange(FRAMES), (first_seen + IN_VIEW)[:, None]
    rig = SimpleNamespace(map_from_vehicle=poses)
    bundle = SimpleNamespace(
        rig=rig,
        corners_map=corners,
        inliers=np.ones(is_sighting.sum(), dtype=bool),
        group=group[is_sighting],
        row=np.arange(is_sighting.sum()),
    )
    stamps = 0.1 * np.arange(FRAMES)
    sightings = SimpleNamespace(image=frame[is_sighting], session=np.zeros(FRAMES, dtype=int), stamp_s=stamps)
    views = SimpleNamespace(
        image=np.arange(FRAMES), frame=np.arange(FRAMES), camera=np.zeros(FRAMES, dtype=int)
    )
    return foreign_segment(bundle, sightings, views, ())


OWN = np.arange(-IN_VIEW, FRAMES, 2)
THEIRS = np.arange(30 - IN_VIEW, 60, 2)
BOTH = np.concatenate([OWN, THEIRS])


def is_theirs(group):
    return group >= len(OWN)


def test_images_of_another_drive_are_found_with_their_ends(monkeypatch):
    begin_s, end_s, gain = stretch(monkeypatch, lambda g, f: is_theirs(g) == (30 <= f < 60), BOTH)
    assert gain > 2 * _ODDS_LIMIT, "twice what it takes to be named"
    assert (begin_s, end_s) == pytest.approx((3.0, 5.9), abs=0.15)


def test_a_lorry_that_hides_all_markings_for_a_while_is_no_other_drive(monkeypatch):
    assert stretch(monkeypatch, lambda g, f: not 30 <= f < 40, OWN)[2] < 0


def test_worn_markings_and_missed_ones_are_no_other_drive(monkeypatch):
    rng = np.random.default_rng(0)
    worn = rng.random(len(OWN)) < 0.2
    assert stretch(monkeypatch, lambda g, f: rng.random() < (0.3 if worn[g] else 0.85), OWN)[2] < 0


def test_far_views_that_find_little_are_no_other_drive(monkeypatch):
    monkeypatch.setattr(__name__ + ".IN_VIEW", 50)
    early, late = np.arange(-45, 0, 3), np.arange(40, 60, 2)
    first_seen = np.concatenate([early, late])
    assert stretch(monkeypatch, lambda g, f: f - first_seen[g] > 38, first_seen)[2] < 0


def odds_beside(monkeypatch, gain, left, worst=20.0, rows=600):
    """Log odds of images from 3 to 6 s beside a fault that has ``left`` odds in a solve without them."""
    # A focal length that is surely longer, by a fifth of what is usual.
    numbers = {"value": 0.004, "sigma": 4e-4, "model_sigma": 4e-4, "p_value": 1e-20}
    fault = ScoreTest(table.FOCAL.name, -1, 0, -1, **numbers, gain=worst + float(np.log1p(0.2**2)))
    solved = []

    def settled(left_inputs, _):
        solved.append([in_image.image for in_image in left_inputs.detections])
        if left is None:
            raise MappingError("no marking is left")
        return SimpleNamespace(row=np.arange(rows))

    def tested(*_):
        return (ScoreTest(table.CLOCK.name, -1, 0, -1, gain=left),)

    for name, value in (
        ("foreign_segment", ForeignSegment(3.0, 6.0, gain)),
        ("views_of", None),
    ):
        monkeypatch.setattr(recovery, name, lambda *_, value=value: value)
    monkeypatch.setattr(inputs, "collect_sightings", lambda *_: None)
    monkeypatch.setattr(recovery, "_settled", settled)
    monkeypatch.setattr(recovery, "_tested", tested)
    images = [SimpleNamespace(stamp_s=float(n)) for n in range(10)]
    detections = [SimpleNamespace(image=n) for n in range(10)]
    all_inputs = inputs.Inputs(SimpleNamespace(images=images, cameras={}), detections, (), None)  # type: ignore[arg-type]
    whole = SimpleNamespace(row=np.arange(1200))
    answer = recovery._foreign(all_inputs, whole, (fault,) if worst else (), lambda _: None)  # type: ignore[arg-type]
    return answer[2], solved


def test_a_stretch_explains_what_a_solve_without_its_images_leaves_less_contradicted(monkeypatch):
    odds, solved = odds_beside(monkeypatch, 7.0, 2.0)
    assert odds == pytest.approx(7 + 20 - 2 * 2), "half as many corners hold half as much against it"
    assert solved == [[0, 1, 2, 7, 8, 9]]
    assert odds_beside(monkeypatch, 7.0, 15.0)[0] == 7.0, "a clock that wanders is as wrong without them"


@pytest.mark.parametrize(("gain", "worst"), [(-1.0, 20.0), (7.0, 0.0)])
def test_a_stretch_that_nothing_speaks_for_costs_no_solve(monkeypatch, gain, worst):
    assert odds_beside(monkeypatch, gain, 0.0, worst) == (gain, [])


def test_a_drive_without_its_stretch_that_cannot_be_mapped_explains_nothing_more(monkeypatch, caplog):
    assert odds_beside(monkeypatch, 7.0, None)[0] == 7.0
    assert "from 3.0 to 6.0 s" in caplog.text

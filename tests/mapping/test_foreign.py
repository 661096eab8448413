"""Stretches of images that are those of another drive, by which views find which markings."""

from types import SimpleNamespace

import numpy as np
import pytest

from v2hdm.mapping import foreign
from v2hdm.mapping.foreign import foreign_stretch

FRAMES, IN_VIEW = 90, 8


def stretch(monkeypatch, found, first_seen):
    """The stretch of a drive whose marking g is in view from frame ``first_seen[g]`` on."""
    group = np.repeat(np.arange(len(first_seen)), IN_VIEW)
    frame = (first_seen[:, None] + np.arange(IN_VIEW)).ravel()
    inside = (frame >= 0) & (frame < FRAMES)
    group, frame = group[inside], frame[inside]
    kept = np.array([found(g, f) for g, f in zip(group.tolist(), frame.tolist(), strict=True)])
    monkeypatch.setattr(foreign, "easy_views", lambda *_: (group, frame))
    bundle = SimpleNamespace(
        rig=None, corners_map=None, inliers=np.ones(kept.sum(), dtype=bool), group=group[kept],
        row=np.arange(kept.sum()),
    )  # fmt: skip
    stamps = 0.1 * np.arange(FRAMES)
    sightings = SimpleNamespace(image=frame[kept], visit=np.zeros(FRAMES, dtype=int), stamp_s=stamps)
    views = SimpleNamespace(image=np.arange(FRAMES), frame=np.arange(FRAMES))
    return foreign_stretch(bundle, sightings, views, ())


OWN = np.arange(-IN_VIEW, FRAMES, 2)
THEIRS = np.arange(30 - IN_VIEW, 60, 2)
BOTH = np.concatenate([OWN, THEIRS])


def is_theirs(group):
    return group >= len(OWN)


def test_images_of_another_drive_are_found_with_their_ends(monkeypatch):
    begin_s, end_s, gain = stretch(monkeypatch, lambda g, f: is_theirs(g) == (30 <= f < 60), BOTH)
    assert gain > 20
    assert (begin_s, end_s) == pytest.approx((3.0, 5.9), abs=0.15)


def test_a_lorry_that_hides_all_markings_for_a_while_is_no_other_drive(monkeypatch):
    assert stretch(monkeypatch, lambda g, f: not 30 <= f < 40, OWN)[2] < 0


def test_worn_markings_and_missed_ones_are_no_other_drive(monkeypatch):
    rng = np.random.default_rng(0)
    worn = rng.random(len(OWN)) < 0.2
    assert stretch(monkeypatch, lambda g, f: rng.random() < (0.3 if worn[g] else 0.85), OWN)[2] < 0

"""Symbols on the ground as a camera sees them, for tests of the map's symbols."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from tests.cameras import level, mounted
from v2hdm.association.ground import Views
from v2hdm.association.sightings import Rig, Symbols
from v2hdm.records import Camera, CameraInfo
from v2hdm.site.options import AcceptanceOptions
from v2hdm.site.symbols import map_symbols

INTRINSIC = np.array([[800.0, 0.0, 640.0], [0.0, 800.0, 360.0], [0.0, 0.0, 1.0]])
ROI = np.array([[4.0, -6.0], [15.0, -6.0], [15.0, 6.0], [4.0, 6.0]])
CAMERAS = [Camera(CameraInfo("front", 1280, 720, INTRINSIC), {}, "calibrated", ROI)]
ARROW = np.array(
    [[-1.5, -0.08], [0.5, -0.08], [0.5, -0.35], [1.5, 0.0], [0.5, 0.35], [0.5, 0.08], [-1.5, 0.08]]
)
JITTER_RAD = 0.002


def symbols_of(outlines, kinds):
    """One outline in each frame of one camera, whose shutter is global."""
    count, rows = len(outlines), tuple(np.zeros(len(outline)) for outline in outlines)
    seen_sides = tuple(np.ones(len(outline), dtype=bool) for outline in outlines)
    return Symbols(
        np.zeros(count, dtype=np.int64), np.arange(count), tuple(outlines), tuple(kinds), rows, seen_sides
    )


def of_outlines(symbols, outlines):
    """The symbols with other outlines, whose sides all lie along edges."""
    seen_sides = tuple(np.ones(len(outline), dtype=bool) for outline in outlines)
    rows = tuple(np.zeros(len(outline)) for outline in outlines)
    return replace(symbols, outlines_pinhole_px=tuple(outlines), row_shares=rows, seen_sides=seen_sides)


def seen(shapes, kinds, poses_x):
    """A camera's sightings, at so many places ahead, of shapes on the ground, one from each.

    It takes one image at a place, but one after the other if it stands.
    """
    places_x, frame = np.unique(poses_x, return_inverse=True)
    if len(places_x) == 1:
        places_x, frame = np.asarray(poses_x), np.arange(len(poses_x))
    rig = Rig(INTRINSIC[None], mounted([0.0, 0.0, 2.0])[None], level(places_x))
    poses = rig.map_from_vehicle[frame]
    outlines_px = [outline_px(*placed, rig.cam_from_vehicle[0]) for placed in zip(shapes, poses, strict=True)]
    return replace(symbols_of(outlines_px, kinds), frame=frame), rig


def outline_px(shape, pose, cam_from_vehicle):
    """A shape (N, 2) on the ground as a camera at a pose shows it."""
    ground = np.column_stack([shape, np.zeros(len(shape)), np.ones(len(shape))])
    cam = ground @ (cam_from_vehicle @ np.linalg.inv(pose)).T
    return (cam[:, :3] @ INTRINSIC.T)[:, :2] / cam[:, 2:3]


def mapped(symbols, rig, markings=()):
    """The symbols of the map."""
    return given_and_left_out(symbols, rig, markings)[0]


def given_and_left_out(symbols, rig, markings=()):
    """The symbols of the map and those left out, if every camera took an image at every pose."""
    cameras = CAMERAS * len(rig.intrinsic)
    return map_symbols(symbols, rig, all_views(rig), cameras, JITTER_RAD, markings, AcceptanceOptions())


def all_views(rig):
    """An image by every camera of a rig at every pose."""
    cameras, frames = len(rig.intrinsic), len(rig.map_from_vehicle)
    camera, frame = np.repeat(np.arange(cameras), frames), np.tile(np.arange(frames), cameras)
    return Views(np.arange(cameras * frames), camera, frame)


def noisy(outlines_px, rng):
    """Outlines whose sides wave by half a pixel."""
    dense = [
        np.concatenate(
            [a + np.linspace(0, 1, 40, endpoint=False)[:, None] * (b - a) for a, b in pairwise(ring)]
        )
        for ring in (np.vstack([outline, outline[:1]]) for outline in outlines_px)
    ]
    waves = [
        np.convolve(rng.normal(0, 0.5 * np.sqrt(9), len(points)), np.ones(9) / 9, "same") for points in dense
    ]
    return tuple(points + wave[:, None] for points, wave in zip(dense, waves, strict=True))


def corner_errors_m(symbol, true):
    """How far each true vertex (N, 2) is from the nearest one of a symbol that has as many."""
    assert len(symbol.outline_map) == len(true)
    return np.linalg.norm(symbol.outline_map[:, None] - true, axis=2).min(axis=0)

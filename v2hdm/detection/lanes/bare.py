"""Which traced lines are paint, by the light across them.

The network also traces edges of asphalt, seams and kerbs as lines. Across a line of paint the light rises and
falls again within a decimetre or two; across an edge it only rises. The best line is fitted to the profile of
every metre of a piece. A logistic function of how much brighter it is than either side, of its width, and of
the network's own probability tells paint from bare ground.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np

from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.quads.patch import light_tables
from v2hdm.geometry.planar import turned_left
from v2hdm.records import LANE_LINE, FloatArray, IntArray, LaneDetection

_SECTION_M = 1.0  # length of the stretch whose mean profile is looked at, m
_ALONG_M = 0.1  # distance of the profiles that are averaged, m
_REACH_M = 0.45  # how far profiles reach to either side, m: as far as both strands of a double line
_ACROSS_M = np.linspace(-_REACH_M, _REACH_M, 37)  # places (X,) along a profile, m
_STEP_M = 2 * _REACH_M / (len(_ACROSS_M) - 1)  # their distance, m

_WIDTHS_M = np.array([0.06, 0.08, 0.1, 0.12, 0.15, 0.2, 0.25, 0.3, 0.4])  # of lines that are fitted, m
_SHIFTS_M = np.arange(-0.15, 0.151, 0.025)  # offsets to the side of the traced line to try, m
_BLURS_M = np.array([0.0, 0.01, 0.02, 0.03, 0.05])  # of images, m on the ground: those of templates
_BLUR_PX = 0.6  # of images, px
_USUAL_WIDTH_M = 0.12  # width of lines, m: standards have 0.1 to 0.15 m beside 0.2 to 0.3 m
_SEAM_M = 0.03  # ground beside a line that its blurred edge brightens, m
_FLANK_M = 0.25  # distance from a line within which the ground beside it is looked at, m

FEATURES = ("bright", "uneven", "wide")
"""Features of a section.

They are how much brighter the best line is than the brighter side, in log light, from ``_FAINT`` on; the
difference of the sides; and how much the log of its width differs from the usual by more than ``_USUAL``.
"""


class Contrast(NamedTuple):
    """Log odds that a piece is paint and no bare ground, as a linear function."""

    weights: tuple[float, ...]  # of the features of a section
    section: float  # added for each section
    correlation: float  # of the errors of two sections of a piece: together they count as if fewer
    named: float  # weight of the log odds of the piece by the network, which is too sure of strange ground
    bias: float


FITTED = Contrast((2.4, -1.11, -0.93), -0.16, 0.5, 0.75, -0.6)
"""Fitted to renders, by ``python -m train.fit_bare``."""

_FAINT = 0.12  # log light over the ground from which a line is no longer faint
_MOST_BRIGHT = 0.3  # beyond that from which more says nothing
_USUAL = 0.8  # log of a width over the usual one within which all are usual

_MOST_UNEVEN = 0.5  # difference of the sides, log light, from which more says nothing

_LEAST_SHOWN_M = 0.2  # to either side of a piece that an image has to show, m
_LEAST_PROFILES = 2  # profiles of a section, at least


class Sections(NamedTuple):
    """S sections of pieces, in order: the mean light across each, and where it is."""

    profile: FloatArray  # (S, X) log light
    px_m: FloatArray  # (S,) ground a px wide, m
    piece: IntArray  # (S,) the piece of each
    end_m: FloatArray  # (S,) where it ends at the latest, m along the piece


def painted(
    pieces: Sequence[LaneDetection], image_bgr: np.ndarray, camera: RoadCamera
) -> list[LaneDetection]:
    """The pieces without those of ``lane_line`` that are likelier bare ground than paint.

    Those of other classes stay: of 222 true dashes in renders one in ten would go, too. Where the image shows
    too little of a piece, the network alone tells.
    """
    lines = [number for number, piece in enumerate(pieces) if piece.kind == LANE_LINE]
    if not lines:
        return list(pieces)
    sections = sections_of([pieces[number] for number in lines], image_bgr, camera)
    values = features(sections)
    bare: set[int] = set()
    for place, number in enumerate(lines):
        is_of_piece = sections.piece == place
        if paint_log_odds(values[is_of_piece], pieces[number].score) < 0.0:
            bare.add(number)
    return [piece for number, piece in enumerate(pieces) if number not in bare]


def sections_of(pieces: Sequence[LaneDetection], image_bgr: np.ndarray, camera: RoadCamera) -> Sections:
    """The sections of the pieces of one image that it shows."""
    lines = [(number, camera.unproject(piece.points_px)) for number, piece in enumerate(pieces)]
    least_m = _LEAST_PROFILES * _ALONG_M
    parts = [_across(number, line) for number, line in lines if line_way_m(line)[-1] > least_m]
    if not parts:
        none = np.empty(0)
        return Sections(np.empty((0, len(_ACROSS_M))), none, none.astype(np.intp), none)
    ground, piece, along_m = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    points_px = camera.project(ground.reshape(-1, 2)).reshape(ground.shape)
    # Beyond the image's border the ground is taken to go on as it is there.
    is_shown = camera.inside(points_px[:, np.abs(_ACROSS_M) <= _LEAST_SHOWN_M], 0.0).all(axis=1)
    points_px = points_px[is_shown]
    light = _light(image_bgr, points_px, linear_response=camera.camera.linear_response)
    px_m = _STEP_M / np.maximum(np.linalg.norm(np.diff(points_px, axis=1), axis=2).mean(axis=1), 1e-6)
    return _means(np.column_stack([light, px_m]), piece[is_shown], along_m[is_shown])


def _means(columns: FloatArray, piece: IntArray, along_m: FloatArray) -> Sections:
    """The sections of P profiles, by their light (P, X) and, in the last column, the ground a px wide."""
    key = np.column_stack([piece, np.floor(along_m / _SECTION_M)]).astype(np.intp)
    section_keys, section, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    share = np.zeros((len(section_keys), len(columns)))
    share[section.ravel(), np.arange(len(columns))] = 1.0 / count[section.ravel()]
    enough = count >= _LEAST_PROFILES
    means = (share @ columns)[enough]
    end_m = (section_keys[enough, 1] + 1) * _SECTION_M
    return Sections(means[:, :-1], means[:, -1], section_keys[enough, 0], end_m)


def line_way_m(points_vehicle: FloatArray) -> FloatArray:
    """The way (N,) along a line (N, 2), m."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points_vehicle, axis=0), axis=1))])


class _Profiles(NamedTuple):
    """Where P profiles across a piece lie."""

    ground: FloatArray  # (P, X, 2) m
    piece: IntArray  # (P,)
    along_m: FloatArray  # (P,) way along the piece, m


def _across(number: int, line: FloatArray) -> _Profiles:
    """The profiles across a piece, a line (N, 2) on the ground."""
    way_m = line_way_m(line)
    along_m = np.arange(_ALONG_M / 2, way_m[-1], _ALONG_M)

    def on_line(at_m: FloatArray) -> FloatArray:
        return np.column_stack([np.interp(at_m, way_m, line[:, axis]) for axis in (0, 1)])

    ahead = on_line(along_m + _SECTION_M / 2) - on_line(along_m - _SECTION_M / 2)
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    ground = on_line(along_m)[:, None] + _ACROSS_M[:, None] * turned_left(ahead)[:, None]
    return _Profiles(ground, np.full(len(along_m), number, dtype=np.intp), along_m)


def _light(image_bgr: np.ndarray, points_px: FloatArray, *, linear_response: bool) -> FloatArray:
    """The log light (P, X) of the brightest colour at points (P, X, 2): paint of any colour is bright."""
    if not len(points_px):
        return np.empty(points_px.shape[:2])
    u, v = np.moveaxis(points_px, -1, 0).astype(np.float32)
    coded = cv2.remap(image_bgr, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    blue, green, red = cv2.split(coded)
    _, logs = light_tables(linear_response)
    return np.asarray(cv2.LUT(cv2.max(cv2.max(blue, green), red), logs), dtype=np.float64)


def features(sections: Sections) -> FloatArray:
    """The :data:`FEATURES` (S, F) of sections."""
    out = np.empty((len(sections.profile), len(FEATURES)))
    nearest_blur = np.abs(_BLUR_PX * sections.px_m[:, None] - _BLURS_M).argmin(axis=1)
    for blur in np.unique(nearest_blur).tolist():
        rows = nearest_blur == blur
        out[rows] = _features(sections.profile[rows], _templates(blur))
    return out


def _features(profile: FloatArray, templates: _Templates) -> FloatArray:
    """The features (S, F) of profiles (S, X) of one blur."""
    # Of templates of norm 1 the one with the largest product fits best.
    best = (profile @ templates.lines.T).argmax(axis=1)
    inside, left, right = (
        (profile * mask[best]).sum(axis=1) for mask in (templates.inside, templates.left, templates.right)
    )
    bright = np.clip(inside - np.maximum(left, right) - _FAINT, 0.0, _MOST_BRIGHT)
    uneven = np.minimum(np.abs(left - right), _MOST_UNEVEN)
    width = np.abs(np.log(_WIDTHS_M[best // len(_SHIFTS_M)] / _USUAL_WIDTH_M))
    return np.column_stack([bright, uneven, np.maximum(width - _USUAL, 0.0)])


class _Templates(NamedTuple):
    """Profiles of L lines, and where each line and its sides are."""

    lines: FloatArray  # (L, X) of mean 0 and norm 1
    inside: FloatArray  # (L, X) weights of a mean
    left: FloatArray  # (L, X) weights of a mean
    right: FloatArray  # (L, X) weights of a mean


@cache
def _templates(blur: int) -> _Templates:
    """The templates of one of the blurs."""
    half_m = np.repeat(_WIDTHS_M, len(_SHIFTS_M))[:, None] / 2
    from_m = _ACROSS_M - np.tile(_SHIFTS_M, len(_WIDTHS_M))[:, None]
    lines = np.clip((half_m - np.abs(from_m)) / _STEP_M + 0.5, 0.0, 1.0)
    beyond_m = np.abs(from_m) - half_m
    beside = (beyond_m > _SEAM_M) & (beyond_m < _FLANK_M)
    blurred = _blurred(lines, float(_BLURS_M[blur] / _STEP_M))
    centred = blurred - blurred.mean(axis=1, keepdims=True)
    normed = centred / np.linalg.norm(centred, axis=1, keepdims=True)
    masks = (beyond_m < _STEP_M / 2, beside & (from_m < 0), beside & (from_m > 0))
    return _Templates(normed, *(mask / mask.sum(axis=1, keepdims=True) for mask in masks))


def _blurred(profiles: FloatArray, sigma: float) -> FloatArray:
    """Profiles (N, X) blurred by so many places."""
    if sigma == 0.0:
        return profiles
    size = (2 * math.ceil(3.0 * sigma) + 1, 1)
    return np.asarray(cv2.GaussianBlur(profiles, size, sigma, borderType=cv2.BORDER_REPLICATE))


def paint_log_odds(values: FloatArray, score: float, model: Contrast = FITTED) -> float:
    """The log odds that a piece is paint, by the features (S, F) of its sections and the network's score."""
    ratio = shared(values @ np.array(model.weights) + model.section, model.correlation)
    return float(ratio + model.named * math.log(score / (1.0 - score)) + model.bias)


def shared(ratio: FloatArray, correlation: float) -> float:
    """The joint log likelihood ratio of sections by their own (S,), whose errors are correlated."""
    return float(ratio.sum() / (1.0 + correlation * (len(ratio) - 1)))

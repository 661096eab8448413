"""Spots of sun that the network confidently takes for markings, which the classifier must reject by itself.

Renders show spots, too, but the network seldom takes them for paint there, so that a judge who has learnt
from what it does alone would believe it where it is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from train.examples import MAX_RANGE_M, Example
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.network import NetworkOutput
from v2hdm.records import CROSSWALK_BAR, DIAMOND, LANE_DASH, FloatArray

SPOTS = 3  # spots of sun that an image gets at most
_TRIES = 20  # places that are tried for one spot
_RADIUS_M = (0.2, 0.9)  # least and largest radius of a spot, m
_SLIM = (0.3, 1.0)  # least and largest ratio of a spot's axes
_SOFT = (0.15, 0.8)
"""By which share of its radius a spot fades out."""

_GAIN = (1.3, 3.5)  # least and largest factor on the light in a spot
_BOUND_PX = 6
"""Distance of spots from markings, which must not change, px."""

_CLAIM_ODDS = (4.0, 16.0)
"""How fast the network's log odds of paint rise with the light of a spot."""

_CLAIM_LOGIT = 8.0  # logits that the claimed class gains within a spot
# Shares of the classes that the network takes spots for.
_CLAIMED = {DIAMOND: 0.6, LANE_DASH: 0.2, CROSSWALK_BAR: 0.2}


@dataclass(frozen=True)
class Spots:
    """Spots of sun in an image: ``light`` (H, W) from 0 to 1, and what the network is to say of them."""

    light: np.ndarray
    steepness: float
    kind: str

    def claimed(self, output: NetworkOutput) -> NetworkOutput:
        """The network's output, in which the spots are confident paint of their class."""
        paint = output.paint.copy()
        kinds = output.kinds.copy()
        stride = output.stride
        light = self._at(paint.shape, stride, output.top)
        claimed = np.clip(self.steepness * (light - 0.5), -6, 6)
        np.maximum(paint, claimed, out=paint, where=light > 0)
        step = round(stride * output.kind_scale)
        within = self._at((kinds.shape[1], kinds.shape[2]), step, output.top) > 0.05
        kinds[:, within] = kinds[:, within].min(axis=0)
        kinds[output.classes.index(self.kind), within] += _CLAIM_LOGIT
        areas = output.areas.copy()
        areas[:, within] -= _CLAIM_LOGIT
        return replace(output, paint=paint, kinds=kinds, areas=areas)

    def _at(self, shape: tuple[int, ...], step: int, top: int) -> np.ndarray:
        """The light (h, w) at elements ``step`` px apart, from image row ``top`` on."""
        v, u = (np.arange(n, dtype=np.float32) * step + (step - 1) / 2 for n in shape)
        return cv2.remap(self.light, *np.meshgrid(u, v + top), cv2.INTER_LINEAR, borderValue=0)


def lit(shown: Example, view: RoadCamera, rng: np.random.Generator) -> tuple[Example, Spots]:
    """An image with some spots of sun on its ground, none of them on a marking."""
    occupied = np.zeros(shown.image.shape[:2], dtype=np.uint8)
    for true in shown.markings:
        cv2.fillPoly(occupied, [np.round(true.polygon_px).astype(np.int32)], 1)
    occupied = cv2.dilate(occupied, np.ones((2 * _BOUND_PX + 1,) * 2, np.uint8))
    light = np.zeros(occupied.shape, dtype=np.float32)
    soft = rng.uniform(*_SOFT)
    ground = _ground(occupied.shape, view)
    for _ in range(SPOTS):
        for _ in range(_TRIES):
            spot = _spot(ground, view, soft, rng)
            if spot is not None and not occupied[spot > 0].any():
                light = np.maximum(light, spot)
                occupied = occupied | (cv2.dilate(spot, None) > 0).astype(np.uint8)
                break
    gain = 1 + (rng.uniform(*_GAIN) - 1) * light[..., None]
    image = np.clip(np.round(shown.image * gain), 0, 255).astype(np.uint8)
    kind = str(rng.choice(list(_CLAIMED), p=list(_CLAIMED.values())))
    return replace(shown, image=image), Spots(light, float(rng.uniform(*_CLAIM_ODDS)), kind)


def _ground(shape: tuple[int, ...], view: RoadCamera) -> FloatArray:
    """Where each pixel (H, W, 2) shows the ground, vehicle frame, m; NaN above the rows in reach."""
    v, u = np.mgrid[view.far_row : shape[0], 0 : shape[1]]
    ground = np.full((*shape, 2), np.nan)
    pixels = np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)
    ground[view.far_row :] = view.ground(view.undistort(pixels)).reshape(*v.shape, 2)
    return ground


def _spot(ground: FloatArray, view: RoadCamera, soft: float, rng: np.random.Generator) -> np.ndarray | None:
    """The light (H, W) of an ellipse somewhere on the ground that is wholly in the image; None for none."""
    height, width = ground.shape[:2]
    centre = ground[rng.integers(view.far_row, height), rng.integers(width)]
    if not view.range_m(centre) < MAX_RANGE_M:
        return None
    radius_m = rng.uniform(*_RADIUS_M)
    slim = rng.uniform(*_SLIM)
    turn = rng.uniform(0, np.pi)
    axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    axes /= np.array([[radius_m], [radius_m * slim]])
    radius = np.linalg.norm((ground - centre) @ axes.T, axis=2)
    fade = np.clip((1 + soft / 2 - np.nan_to_num(radius, nan=9.0)) / soft, 0, 1)
    light = (fade * fade * (3 - 2 * fade)).astype(np.float32)
    border = np.concatenate([light[0], light[-1], light[:, 0], light[:, -1]])
    return light if light.any() and not border.any() else None

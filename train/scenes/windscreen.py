"""Draws what lies between scene and sensor: glare, wet reflections, the own vehicle, what is on its glass.

All of it is drawn on the radiance that reaches the lens, so that blur and noise of the sensor come after.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from v2hdm.records import FloatArray
from v2hdm.simulate.render.ground import intersect_ground
from v2hdm.simulate.render.scene import Float32, Light, Scene
from v2hdm.simulate.render.view import View

Hidden = NDArray[np.bool_]
BeforeLens = Callable[[View, Float32, Hidden], None]

LOW_SUN_SINE = 0.2
"""Below this sine of its elevation the sun glares on the ground; that of 11.5 degrees."""

RAINED_FRACTION = 0.7
"""From this wet fraction on the ground mirrors what stands on it."""

_LEAST_MIRRORED_PX = 8  # least number of rows above and below the horizon to mirror


def before_lens(
    for_weather: np.random.Generator, for_vehicle: np.random.Generator, scene: Scene, own_vehicle: float
) -> BeforeLens:
    """Light that the weather and, in a share ``own_vehicle`` of images, the own vehicle add."""

    def draw(view: View, radiance: Float32, hidden: Hidden) -> None:
        if scene.ground.wet_fraction >= RAINED_FRACTION:
            _mirror(for_weather, view, radiance, hidden)
        if is_dusk(scene.light):
            _headlights(for_weather, view, radiance)
        elif scene.light.sun_direction_map[2] < LOW_SUN_SINE:
            _glare(for_weather, scene.light, view, radiance)
        if for_vehicle.random() < own_vehicle:
            _own_vehicle(for_vehicle, radiance, hidden)

    return draw


def is_dusk(light: Light) -> bool:
    """Whether no sun is left at all."""
    return max(light.sun_bgr) == 0


def _pixels(radiance: Float32) -> tuple[Float32, Float32]:
    """Columns (1, W) and rows (H, 1)."""
    height, width = radiance.shape[:2]
    return np.arange(width, dtype=np.float32)[None], np.arange(height, dtype=np.float32)[:, None]


def _horizon_row(view: View) -> float:
    """The row of the horizon in the middle of the image, as a pinhole sees it."""
    forward = view.cam_from_map[2, :3]
    ahead = np.array([forward[0], forward[1], 0.0]) / max(float(np.hypot(*forward[:2])), 1e-6)
    at = view.rays.info.intrinsic @ (view.cam_from_map[:3, :3] @ ahead)
    return float(at[1] / at[2])


def _mirror(rng: np.random.Generator, view: View, radiance: Float32, hidden: Hidden) -> None:
    """Wet ground mirrors, drawn out downwards, what stands above the horizon."""
    horizon = round(_horizon_row(view))
    height = len(radiance)
    if not _LEAST_MIRRORED_PX < horizon < height - _LEAST_MIRRORED_PX:
        return
    above = radiance[:horizon][::-1]
    deep = height - horizon
    above = np.concatenate([above, np.repeat(above[-1:], max(deep - horizon, 0), axis=0)])[:deep]
    tall = float(rng.uniform(2, 12))
    mirrored = cv2.GaussianBlur(np.ascontiguousarray(above), (0, 0), 0.3 * tall, sigmaY=tall)
    _, row = _pixels(above)
    patches = cv2.GaussianBlur(rng.standard_normal((9, 16)).astype(np.float32), (0, 0), 1.0)
    wet = cv2.resize(patches, radiance.shape[1::-1], interpolation=cv2.INTER_CUBIC)[horizon:]
    share = rng.uniform(0.2, 0.7) * np.exp(-row / (rng.uniform(0.2, 0.9) * height)) * np.clip(0.8 + wet, 0, 1)
    share = np.where(hidden[horizon:], 0, share).astype(np.float32)[..., None]
    radiance[horizon:] += share * (mirrored - radiance[horizon:])


def _headlights(rng: np.random.Generator, view: View, radiance: Float32) -> None:
    """The own headlights on the ground, and lamps of others about the horizon."""
    ground = intersect_ground(view)
    level = float(radiance.mean())
    if ground is not None and rng.random() < 0.75:
        beam = np.exp(-((ground.y_m / (1.2 + 0.22 * np.maximum(ground.x_m, 0))) ** 2))
        beam *= np.exp(-np.maximum(ground.x_m, 0) / np.float32(rng.uniform(6, 20)))
        gain = (1 + np.float32(rng.uniform(1, 6)) * beam)[..., None]
        radiance[ground.first_row :] *= gain * np.array([0.85, 1.0, 1.1], dtype=np.float32)
    column, row = _pixels(radiance)
    for _ in range(int(rng.poisson(4))):
        u = rng.uniform(0, column.size)
        v = _horizon_row(view) + rng.normal(0, 0.12) * row.size
        size = float(np.exp(rng.uniform(np.log(1), np.log(8))))
        low, high = (int(np.clip(at, 0, n)) for at, n in ((v - 4 * size, row.size), (v + 9 * size, row.size)))
        below = np.maximum(row[low:high] - v, 0) / 2.5 + np.minimum(row[low:high] - v, 0)
        lobe = np.exp(-((column - u) ** 2 + below**2) / (2 * size**2))[..., None]
        colour = np.array([(0.8, 0.9, 1.0), (0.05, 0.05, 1.0), (0.1, 0.6, 1.0)][int(rng.integers(3))])
        radiance[low:high] += (lobe * colour * level * rng.uniform(2, 20)).astype(np.float32)


def _glare(rng: np.random.Generator, light: Light, view: View, radiance: Float32) -> None:
    """A low sun ahead: its broad mirror image on the ground, and its light scattered in the lens."""
    at = view.rays.info.intrinsic @ view.cam_from_map[:3, :3] @ np.array(light.sun_direction_map)
    if at[2] < 0.2:
        return
    u, v = at[:2] / at[2]
    column, row = _pixels(radiance)
    width = column.size
    height = row.size
    level = float(radiance.mean())
    wide = rng.uniform(0.08, 0.35) * width
    below = row - _horizon_row(view)
    lobe = np.exp(-0.5 * ((column - u) / (wide + 0.3 * np.maximum(below, 0))) ** 2) * (below > 0)
    lobe *= np.exp(-np.maximum(below, 0) / (rng.uniform(0.3, 1.2) * height))
    # A rough surface mirrors by its grains: dark ones less.
    grains = np.clip(radiance[..., 1] / level, 0.3, 2.0) ** 0.4
    shine = (rng.uniform(0.3, 2.0) * lobe * grains)[..., None]
    distance = np.hypot(column - u, row - v) / width
    veil = (rng.uniform(0.0, 0.5) * np.exp(-2.5 * distance) + 3.0 * np.exp(-25.0 * distance))[..., None]
    radiance += (level * (shine + veil) * np.array([0.75, 0.95, 1.1])).astype(np.float32)


def _own_vehicle(rng: np.random.Generator, radiance: Float32, hidden: Hidden) -> None:
    """The bonnet or dashboard at the image's bottom, wipers, dirt, drops and reflections on the glass."""
    if rng.random() < 0.4:
        _reflections(rng, radiance)
    if rng.random() < 0.4:
        _spots(rng, radiance)
    if rng.random() < 0.85:
        _bonnet(rng, radiance, hidden)
    if rng.random() < 0.45:
        _wipers(rng, radiance, hidden)


def _mix(radiance: Float32, share: Float32, colour: Float32 | FloatArray) -> None:
    radiance += share[..., None] * (np.asarray(colour, dtype=np.float32) - radiance)


def _bonnet(rng: np.random.Generator, radiance: Float32, hidden: Hidden) -> None:
    """Lacquer that mirrors what lies ahead, markings and sky, under a curved edge; or a matt dashboard."""
    height, width = radiance.shape[:2]
    column, row = _pixels(radiance)
    across = (column / width - rng.uniform(0.2, 0.8)) * 2
    edge = height * (1 - rng.uniform(0.05, 0.35)) + height * rng.uniform(0.0, 0.25) * np.abs(across) ** (
        rng.uniform(1.5, 4)
    )
    first = max(int(edge.min()) - 1, 0)
    rows = row[first:]
    share = np.clip((rows - edge) / rng.uniform(0.8, 3) + 0.5, 0, 1).astype(np.float32)
    level = float(radiance.mean())
    tint = np.exp(rng.normal(0, 0.25, 3)) if rng.random() < 0.5 else np.ones(3)
    glossy = rng.random() < 0.7
    grey = rng.choice([rng.uniform(0.02, 0.15), rng.uniform(0.4, 1.8)]) if glossy else rng.uniform(0.02, 0.3)
    body = (level * grey * tint).astype(np.float32) * np.ones((height - first, width, 1), np.float32)
    body *= (1 + rng.uniform(-0.5, 0.5) * (rows - edge)[..., None] / height).astype(np.float32)
    if glossy:
        shrink = rng.uniform(0.6, 3.0)
        u = np.broadcast_to(column + rng.uniform(-0.3, 0.3) * across * width / 4, (len(rows), width))
        v = np.maximum(edge - shrink * (rows - edge), 0)
        mirrored = cv2.remap(radiance, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
        if rng.random() < 0.6:
            mirrored = cv2.GaussianBlur(mirrored, (0, 0), float(rng.uniform(0.7, 4)))
        body = body + np.float32(rng.uniform(0.1, 0.8)) * mirrored
        if rng.random() < 0.5:
            body += np.float32(level * rng.uniform(0.3, 2.5)) * _clouds(rng, len(rows), width)[..., None]
    for _ in range(int(rng.poisson(1.5))):
        middle = width * (0.5 + rng.normal(0, 0.3)) + rng.normal(0, 1.5) * (rows - height)
        crease = np.exp(-(((column - middle) / rng.uniform(1, 6)) ** 2))[..., None]
        body *= (1 + rng.choice([-0.6, 0.8, 2.0]) * crease).astype(np.float32)
    if rng.random() < 0.5:
        at = edge + rng.uniform(2, 25)
        body += (level * rng.uniform(0.2, 2) * np.exp(-(((rows - at) / rng.uniform(1, 5)) ** 2)))[
            ..., None
        ].astype(np.float32)
    if rng.random() < 0.4:
        for part in _quads(rng, width, height, (0.02, 0.12), int(rng.integers(2, 8))):
            mask = _filled(part - (0, first), body.shape[:2])
            _mix(body, mask, level * np.full(3, rng.uniform(0.0, 2.5)))
    _mix(radiance[first:], share, body)
    hidden[first:] |= share > 0.5


def _clouds(rng: np.random.Generator, rows: int, columns: int) -> Float32:
    """Cover (rows, columns) of clouds, or of gaps in leaves, by the sky that lacquer mirrors."""
    cells = int(rng.integers(2, 12))
    aspect = rng.uniform(1.0, 4.0)
    noise = np.zeros((rows, columns), dtype=np.float32)
    for octave in range(3):
        across = cells << octave
        down = max(int(across * rows / columns * aspect), 2)
        grains = rng.standard_normal((down, across)).astype(np.float32)
        noise += np.float32(0.5**octave) * cv2.resize(grains, (columns, rows), interpolation=cv2.INTER_CUBIC)
    edge = rng.uniform(0.05, 0.8)
    return np.asarray(np.clip((noise / noise.std() - rng.uniform(-0.3, 1.5)) / edge, 0, 1), dtype=np.float32)


def _quads(
    rng: np.random.Generator, width: int, height: int, size: tuple[float, float], count: int
) -> list[FloatArray]:
    """Corners (4, 2) of slanted quadrilaterals in the lower half of an image."""
    out = []
    for _ in range(count):
        half = rng.uniform(*size, 2) * width / 2 * (1, 0.5)
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half * rng.uniform(0.6, 1.2, (4, 2))
        corners[:, 0] += rng.normal(0, 0.8) * corners[:, 1]
        out.append(corners + np.array([rng.uniform(0, width), rng.uniform(0.5, 1.0) * height]))
    return out


def _filled(polygon_px: FloatArray, shape: tuple[int, ...]) -> Float32:
    """Coverage (H, W) of a polygon (N, 2)."""
    mask = np.zeros(shape, dtype=np.uint8)
    cv2.fillPoly(mask, [np.round(polygon_px * 16).astype(np.int32)], 255, cv2.LINE_AA, 4)
    return mask.astype(np.float32) * np.float32(1 / 255)


def _wipers(rng: np.random.Generator, radiance: Float32, hidden: Hidden) -> None:
    """One or two dark blades that rise from the image's bottom."""
    height, width = radiance.shape[:2]
    level = float(radiance.mean())
    lean = rng.choice([-1, 1]) * rng.uniform(2, 12)
    for _ in range(int(rng.integers(1, 3))):
        foot = np.array([rng.uniform(0, width), height + 4.0])
        tip = foot + rng.uniform(0.1, 0.3) * height * np.array([lean, -1.0])
        thick = rng.uniform(2, 9) * np.array([[0.0, 1.0]])
        share = _filled(
            np.vstack([foot - thick, tip - 0.5 * thick, tip + 0.5 * thick, foot + thick]), (height, width)
        )
        _mix(radiance, share, level * np.full(3, rng.uniform(0.02, 0.2)))
        hidden |= share > 0.5


def _reflections(rng: np.random.Generator, radiance: Float32) -> None:
    """The dashboard and what lies on it, mirrored faintly by the glass: paint behind it shows through."""
    height, width = radiance.shape[:2]
    small = np.zeros((height // 2, width // 2), dtype=np.float32)
    for quad in _quads(rng, width, height, (0.05, 0.5), int(rng.integers(1, 7))):
        small = np.maximum(small, _filled(quad / 2, small.shape) * np.float32(rng.uniform(0.03, 0.45)))
    small = cv2.GaussianBlur(small, (0, 0), float(rng.uniform(0.6, 4)))
    veil = cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)[..., None]
    radiance += veil * np.float32(radiance.mean())


def _spots(rng: np.random.Generator, radiance: Float32) -> None:
    """Drops or dirt on the glass, out of focus: they blur what is behind and lighten or darken it."""
    height, width = radiance.shape[:2]
    mask = np.zeros((height, width), dtype=np.uint8)
    for _ in range(int(rng.integers(5, 50))):
        at = int(rng.integers(width)), int(rng.integers(height))
        axes = tuple(int(a) for a in rng.integers(2, 9, 2))
        cv2.ellipse(mask, at, axes, float(rng.uniform(0, 180)), 0, 360, float(rng.uniform(80, 255)), -1)
    share = cv2.GaussianBlur(mask, (0, 0), float(rng.uniform(0.7, 2.5))).astype(np.float32) * np.float32(
        0.9 / 255
    )
    small = cv2.resize(radiance, (width // 8, height // 8), interpolation=cv2.INTER_AREA)
    behind = cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
    _mix(radiance, share, behind * np.float32(rng.uniform(0.7, 1.5)))

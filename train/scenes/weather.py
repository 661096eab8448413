"""Light and weather that photographs have: rain, low sun, dusk, spots of sun; and photographed grounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from train.scenes.windscreen import LOW_SUN_SINE, RAINED_FRACTION, is_dusk
from v2hdm.simulate.render.renderer import Optics
from v2hdm.simulate.render.scene import Dapple, Ground, Light
from v2hdm.simulate.render.textures import GROUNDS

_FLECK_SIZES_M = tuple(float(s) for s in np.geomspace(0.12, 2.5, 10)[:6])
"""Of the sizes that the renderer keeps tiles for, those of gaps in near leaves."""


def rain(rng: np.random.Generator, ground: Ground, light: Light, share: float) -> tuple[Ground, Light]:
    """These, or in a ``share`` of cases a dark ground, wet all over, under an overcast, bright sky."""
    if rng.random() >= share:
        return ground, light
    dark = rng.uniform(0.5, 1.0)
    blue, green, red = (float(dark * c) for c in ground.albedo_bgr)
    wet = replace(
        ground, albedo_bgr=(blue, green, red), wet_fraction=float(rng.uniform(RAINED_FRACTION, 0.99))
    )
    grey, bright = rng.uniform(0.25, 0.6), rng.uniform(0.7, 1.8)
    tint = np.exp(rng.normal(0, 0.06, 3))
    sky = _bgr(grey * tint)
    return wet, replace(
        light, sun_bgr=_bgr(rng.uniform(0.01, 0.15) * tint), sky_bgr=sky, horizon_bgr=_bgr(bright * tint),
        zenith_bgr=_bgr(0.7 * bright * tint),
    )  # fmt: skip


def low_sun(rng: np.random.Generator, light: Light, share: float) -> Light:
    """This light, or in a ``share`` of cases a warm sun at 3 to 11 degrees, half of the time ahead."""
    if rng.random() >= share:
        return light
    sine = rng.uniform(0.05, 0.95 * LOW_SUN_SINE)
    azimuth = rng.normal(0, 0.35) if rng.random() < 0.5 else rng.uniform(0, 2 * np.pi)
    level = np.sqrt(1 - sine**2)
    warm = rng.uniform(0.05, 0.35)
    sun = rng.uniform(0.8, 2.5) * np.array([1 - warm, 1.0, 1 + warm])
    direction = float(level * np.cos(azimuth)), float(level * np.sin(azimuth)), float(sine)
    return replace(
        light, sun_direction_map=direction,
        sun_bgr=_bgr(sun), sky_bgr=_bgr(np.array(light.sky_bgr) * rng.uniform(0.3, 0.9)),
    )  # fmt: skip


def dusk(rng: np.random.Generator, light: Light, share: float) -> Light:
    """This light, or in a ``share`` of cases none but that of a bluish or reddish sky after sunset."""
    if rng.random() >= share:
        return light
    sky, red = rng.uniform(0.05, 0.3), rng.uniform(-0.2, 0.5)
    return replace(
        light, sun_bgr=(0.0, 0.0, 0.0), sky_bgr=_bgr(sky * np.array([1.3, 1.0, 0.85])),
        zenith_bgr=_bgr(sky * rng.uniform(0.3, 1.0) * np.array([1.5, 0.9, 0.7])),
        horizon_bgr=_bgr(sky * rng.uniform(0.5, 3.0) * np.array([1 - red, 1.0, 1 + red])),
    )  # fmt: skip


def in_the_dark(rng: np.random.Generator, optics: Optics, light: Light) -> Optics:
    """These optics, or at dusk those of a sensor at a high gain: darker, blurred and noisy."""
    if not is_dusk(light):
        return optics
    return replace(
        optics, mean_level=float(optics.mean_level * rng.uniform(0.3, 1.0)),
        full_well_electrons=float(optics.full_well_electrons * rng.uniform(0.15, 0.8)),
        read_noise=float(optics.read_noise * rng.uniform(1, 3)),
    )  # fmt: skip


def sun_flecks(rng: np.random.Generator, share: float) -> tuple[Dapple, ...]:
    """In a ``share`` of cases a deep shade over all the ground that few spots of sun break."""
    if rng.random() >= share:
        return ()
    return (
        Dapple(
            shaded=float(rng.uniform(0.85, 0.99)),
            scale_m=float(rng.choice(_FLECK_SIZES_M)),
            transmission=float(rng.uniform(0.0, 0.1)),
            seed=int(rng.integers(1 << 20)),
        ),
    )


def photographed(rng: np.random.Generator, ground: Ground, share: float) -> Ground:
    """This ground, or in a ``share`` of cases, if it is asphalt or concrete, with a photographed grain."""
    if rng.random() >= share or ground.texture not in ("asphalt", "concrete"):
        return ground
    return replace(ground, texture=str(rng.choice(GROUNDS)), contrast=float(rng.uniform(0.03, 0.2)))


def _bgr(colour: np.ndarray) -> tuple[float, float, float]:
    blue, green, red = (float(c) for c in colour)
    return blue, green, red

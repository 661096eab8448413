"""How the map and the calibration settle while markings are added in the order of the drive."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from v2hdm.mapping.bundle import Bundle
from v2hdm.mapping.markings.completion import complete_corners
from v2hdm.mapping.markings.conclude import Optimised
from v2hdm.mapping.optimise import Optimiser
from v2hdm.mapping.results import GrowthStep

IntArray = NDArray[np.int64]


def grow_map(
    optimiser: Optimiser,
    optimised: Optimised,
    steps: int = 8,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[GrowthStep, ...]:
    """Solve again with only the first n accepted markings, for up to ``steps`` values of n.

    Markings count in the order in which the drive first saw them; n grows geometrically, since most
    happens early. Associations and accepted observations are those of the whole drive; each solve
    starts from the initial extrinsics. ``progress`` is called with (done, total).
    """
    order = _order_of_sight(optimised)
    counts = growth_counts(len(order), steps)
    out: list[GrowthStep] = []
    for count in counts:
        if progress:
            progress(len(out), len(counts))
        chosen = order[:count]
        whole = count == len(order)
        bundle = optimised.bundle if whole else optimiser.solve_groups(optimised, optimised.groups[chosen])
        out.append(_step(bundle, optimised, chosen, optimiser.camera_names))
    return tuple(out)


def growth_counts(total: int, steps: int) -> list[int]:
    """Distinct marking counts from 2 to ``total``, geometrically spaced, at most ``steps``."""
    if total < 2:
        return [total] if total else []
    return sorted({round(float(count)) for count in np.geomspace(2, total, steps)})


def _order_of_sight(optimised: Optimised) -> IntArray:
    """Indices of the markings by the first sighting that counts; the table is in image order."""
    bundle = optimised.bundle
    first = np.full(bundle.association.count, len(optimised.usable), dtype=np.int64)
    np.minimum.at(first, bundle.group, bundle.row)
    return np.argsort(first[optimised.groups], kind="stable")


def _step(bundle: Bundle, optimised: Optimised, chosen: IntArray, names: tuple[str, ...]) -> GrowthStep:
    """The map so far; markings that only the shape of their class can place are left out of it."""
    corners = complete_corners(bundle.corners_map[optimised.groups[chosen]])
    return GrowthStep(
        markings=tuple(
            replace(optimised.markings[m], corners_map=corners[row], covariance_m2=None)
            for row, m in enumerate(chosen)
            if np.isfinite(corners[row]).all()
        ),
        cam_from_vehicle={name: bundle.rig.cam_from_vehicle[c] for c, name in enumerate(names)},
    )

"""Which corner of a sighting is which corner of its marking, decided once the map is known.

A quadrilateral looks the same after a quarter turn if it is a square, and a half-hidden one after any
turn that its visible corners survive. The order found while linking sightings rests on positions
under a coarse IPM; under the solved bundle the image itself says.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from v2hdm.geometry.ipm import project_ground
from v2hdm.geometry.quadrilateral import SHIFTS
from v2hdm.mapping.association.groups import Association
from v2hdm.mapping.bundle import Bundle
from v2hdm.mapping.sightings.table import Sightings
from v2hdm.records import BoolArray, FloatArray, IntArray

# Root mean square distance from which a sighting does not fit as it is, and the share of it that another
# order must leave at most.
_MISFIT_PX = 4.0
_BETTER_SHARE = 0.5


def settle_corner_order(bundle: Bundle, sightings: Sightings, usable: BoolArray) -> Association:
    """The association of ``bundle`` with sightings turned whose corners fit another order far better.

    Args:
        bundle: The solved bundle.
        sightings: The table that its association indexes.
        usable: Which corners (S, 4), in the sightings' own order, may be used.

    Returns:
        The bundle's own association where every sighting fits best as it is.
    """
    association = bundle.association
    rows = np.flatnonzero(association.group >= 0)
    misfit_px = _misfits(bundle, sightings, usable, rows)
    turn = np.argmin(misfit_px, axis=1)
    as_it_is, best = misfit_px[:, 0], np.take_along_axis(misfit_px, turn[:, None], axis=1)[:, 0]
    turned = np.isfinite(as_it_is) & (as_it_is > _MISFIT_PX) & (best < _BETTER_SHARE * as_it_is)
    if not turned.any():
        return association
    shift = association.shift.copy()
    shift[rows[turned]] = (shift[rows[turned]] + turn[turned]) % 4
    return replace(association, shift=shift)


def _misfits(bundle: Bundle, sightings: Sightings, usable: BoolArray, rows: IntArray) -> FloatArray:
    """Root mean square distances (R, 4), px, of sightings ``rows`` from the map after 0 to 3 turns.

    Infinite where fewer than two corners can be compared.
    """
    rig, association = bundle.rig, bundle.association
    camera, frame = sightings.camera[rows], sightings.frame[rows]
    cam_from_map = rig.cam_from_vehicle[camera] @ np.linalg.inv(rig.map_from_vehicle[frame])
    predicted, depth = project_ground(
        rig.intrinsic[camera], cam_from_map, bundle.corners_map[association.group[rows]]
    )
    own = association.corner_order()[rows][:, SHIFTS]
    observed = sightings.corners_pinhole_px[rows[:, None, None], own]
    with np.errstate(invalid="ignore"):
        squared = np.sum((observed - predicted[:, None]) ** 2, axis=-1)
        known = usable[rows[:, None, None], own] & np.isfinite(squared) & (depth > 0)[:, None]
    count = known.sum(axis=-1)
    mean = np.where(known, squared, 0.0).sum(axis=-1) / np.maximum(count, 1)
    return np.asarray(np.where(count >= 2, np.sqrt(mean), np.inf))

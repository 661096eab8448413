"""How the map and the calibration settle while markings are added in the order of the drive."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from v2hdm.mapping.bundle import Bundle
from v2hdm.mapping.conclude import Optimised, solved_places
from v2hdm.mapping.optimise import Optimiser
from v2hdm.mapping.results import GrowthStep
from v2hdm.records import IntArray, Marking
from v2hdm.site.candidates import Counts
from v2hdm.site.posterior import posterior


def grow_map(
    optimiser: Optimiser,
    optimised: Optimised,
    steps: int = 8,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[GrowthStep, ...]:
    """Solve again with only the first n accepted markings, for up to ``steps`` values of n.

    Markings count in the order in which the drive first saw them; n grows geometrically, since most
    happens early. Associations and accepted observations are those of the whole drive; each solve
    starts from the initial extrinsics, and its corners are fused with the shapes of their classes.
    ``progress`` is called with (done, total).
    """
    order = _order_of_sight(optimised)
    counts = growth_counts(len(order), steps)
    out: list[GrowthStep] = []
    for count in counts:
        if progress:
            progress(len(out), len(counts))
        chosen = order[:count]
        if count == len(order):
            bundle, markings = optimised.bundle, tuple(optimised.markings[m] for m in order)
        else:
            bundle = optimiser.solve_groups(optimised, optimised.groups[chosen])
            markings = _markings(bundle, optimised, chosen)
        extrinsics = bundle.rig.cam_from_vehicle
        out.append(GrowthStep(markings, dict(zip(optimiser.camera_names, extrinsics, strict=True))))
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


def _markings(bundle: Bundle, optimised: Optimised, chosen: IntArray) -> tuple[Marking, ...]:
    """The map so far; markings of too few corners, which the whole map's shapes would place, are left out."""
    solved = solved_places(bundle).subset(optimised.groups[chosen])
    whole = np.flatnonzero(solved.known.all(axis=1))
    names = [optimised.markings[m].kind for m in chosen[whole]]
    kind = np.array([names.index(name) for name in names], dtype=np.int64)
    nothing_counted = Counts(*np.zeros((6, len(kind)), dtype=np.int64))
    shaped = posterior(solved.subset(whole), kind, nothing_counted).places
    return tuple(
        replace(optimised.markings[m], corners_map=corners, covariance_m2=covariance)
        for m, corners, covariance in zip(
            chosen[whole], shaped.corners_map, shaped.covariance_m2, strict=True
        )
    )

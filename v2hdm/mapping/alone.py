"""Each camera solved without the others: only so does it show whether cameras agree.

Sightings stay linked as all cameras together have linked them. Only the last solve is done again, camera by
camera, with all observations, which the loss weighs anew.
"""

from __future__ import annotations

import numpy as np

from v2hdm.errors import AdjustError, MappingError
from v2hdm.mapping.bundle import Bundle
from v2hdm.mapping.conclusion import Optimised, calibrations_of
from v2hdm.mapping.recovery import Outcome
from v2hdm.mapping.results import MethodResult
from v2hdm.records import BEST, HDMap, Marking


def map_alone(outcome: Outcome, optimised: Optimised) -> dict[str, MethodResult]:
    """By camera the mounting and the accepted markings that it places alone; empty for a single camera.

    A camera that cannot be adjusted without the others is missing.
    """
    inputs = outcome.inputs
    if len(inputs.cameras) < 2:
        return {}
    results = {}
    for name in inputs.cameras:
        try:
            bundle = inputs.optimiser.solve_alone(outcome.settled, name)
        except (MappingError, AdjustError):
            continue
        cameras = {other: inputs.drive.cameras[other] for other in inputs.sightings.cameras}
        mounting = {name: calibrations_of(bundle, cameras)[name]}
        hd_map = HDMap(_markings(bundle, optimised), (), inputs.drive.origin)
        results[name] = MethodResult(BEST, (name,), hd_map, mounting)
    return results


def _markings(bundle: Bundle, optimised: Optimised) -> tuple[Marking, ...]:
    """The accepted markings whose four corners a camera has placed."""
    corners_map = bundle.corners_map[optimised.groups]
    return tuple(
        Marking(marking.kind, corners, marking.sightings)
        for marking, corners in zip(optimised.markings, corners_map, strict=True)
        if np.isfinite(corners).all()
    )

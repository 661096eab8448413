"""Settings for acceptance into the map, and for lanes."""

from __future__ import annotations

from dataclasses import dataclass, field

from v2hdm.io.maps.corrections import Correction


@dataclass(kw_only=True)
class AcceptanceOptions:
    """Conditions for a candidate to enter the map.

    A candidate must be a marking (by shape and detections) and lie on the ground (by parallax) with at least
    ``min_probability``. The sigma of its worst corner may exceed that of the map's best by ``max_sigma_m`` at
    most. ``corrections`` are a person's decisions, from the file ``map.corrections``.
    """

    min_probability: float = 0.9
    max_sigma_m: float = 0.06
    corrections: list[Correction] = field(default_factory=list)


AFTER = "after"
JOINT = "joint"  # values of ``mapping.lanes.model``


@dataclass(kw_only=True)
class LaneOptions:
    """Options of the polylines of lane paint.

    ``model`` is ``after``, which draws lanes after the adjustment, or ``joint``, which adjusts them as cubic
    splines whose vertices have sigmas. Lane paint counts up to ``max_range_m`` from the camera; a vertex
    needs ``min_images``.
    """

    model: str = AFTER
    max_range_m: float = 12.0
    min_images: int = 3

"""Settings for what enters the map."""

from __future__ import annotations

from dataclasses import dataclass, field

from v2hdm.io.maps.corrections import Correction


@dataclass(kw_only=True)
class AcceptanceOptions:
    """The conditions for a candidate to enter the map.

    It must be a marking (from its shape and the images that show it or not) and lie on the ground (from its
    motion in the images) with at least ``min_probability``. The sigma of its worst corner may exceed that of
    the map's best corner by at most ``max_sigma_m``. ``corrections`` are a person's decisions on candidates,
    read from the file ``map.corrections``.
    """

    min_probability: float = 0.9
    max_sigma_m: float = 0.06
    corrections: list[Correction] = field(default_factory=list)


AFTER, JOINT = "after", "joint"  # values of ``mapping.lanes.model``


@dataclass(kw_only=True)
class LaneOptions:
    """How lane paint becomes polylines.

    ``model`` is ``after``, which draws lanes after the adjustment, or ``joint``, which makes them part of it
    as cubic splines whose vertices have sigmas. Lane paint is used up to ``max_range_m`` from the camera. A
    vertex needs ``min_images`` that show it.
    """

    model: str = AFTER
    max_range_m: float = 12.0
    min_images: int = 3

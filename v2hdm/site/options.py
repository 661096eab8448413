"""Settings of what enters the map."""

from __future__ import annotations

from dataclasses import dataclass, field

from v2hdm.io.maps.corrections import Correction


@dataclass(kw_only=True)
class AcceptanceOptions:
    """The conditions for a candidate to enter the map.

    ``min_probability`` of being a marking, given its shape, how often it was seen and where it was not, and
    of lying on the ground, given how it moves in the images; and a worst corner less certain than the best
    one of the map by at most ``max_sigma_m``. ``corrections`` are what a person says of candidates, which
    ``map.corrections`` reads from a file.
    """

    min_probability: float = 0.9
    max_sigma_m: float = 0.06
    corrections: list[Correction] = field(default_factory=list)


AFTER, JOINT = "after", "joint"  # values of ``mapping.lanes.model``


@dataclass(kw_only=True)
class LaneOptions:
    """How lane paint becomes polylines.

    ``model`` is ``after``: lanes are drawn under the finished adjustment; or ``joint``: they take part in it
    as cubic splines, and each vertex states its sigma.
    Paint counts up to ``max_range_m`` from the camera, and a vertex needs ``min_images`` that show it.
    """

    model: str = AFTER
    max_range_m: float = 12.0
    min_images: int = 3

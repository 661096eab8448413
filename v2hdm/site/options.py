"""Settings for acceptance into the map, and for lanes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from v2hdm.io.maps.corrections import Correction
from v2hdm.records import ACCURACIES
from v2hdm.settings import NOT_NEGATIVE, Within


@dataclass(kw_only=True)
class AcceptanceOptions:
    """Conditions for a candidate to enter the map."""

    min_probability: Annotated[
        float,
        Within(0, 1 - 1e-9, open=True),
        "least probability with which a candidate must be a marking (by shape and detections) and "
        "lie on the ground (by parallax).",
    ] = 0.9
    accuracy: Annotated[
        str, "markings of a worse grade are left out of the map: A, B or C (none is left out)."
    ] = ACCURACIES[-1]
    corrections: Annotated[list[Correction], "a person's decisions, from the file map.corrections."] = field(
        default_factory=list
    )


AFTER = "after"
JOINT = "joint"  # values of ``mapping.lanes.model``


@dataclass(kw_only=True)
class LaneOptions:
    """Options of the polylines of lane paint."""

    model: Annotated[
        str,
        "after, which draws lanes after the adjustment, or joint, which adjusts them as cubic splines whose "
        "vertices have sigmas.",
    ] = AFTER
    max_range_m: Annotated[
        float, NOT_NEGATIVE, "distance from the camera, m, up to which lane paint counts."
    ] = 12.0
    min_images: Annotated[
        int, NOT_NEGATIVE, "least number of images that must show a vertex of a lane line."
    ] = 3

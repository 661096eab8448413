"""Settings of the association."""

from __future__ import annotations

from dataclasses import dataclass

LEAST_SIGHTINGS = 3
"""Images that must show a marking where nothing else is weighed: in the naive methods, and of a track before
the incremental map takes it up."""


@dataclass(kw_only=True)
class AssociationOptions:
    """How sightings of one marking find each other.

    ``ipm_sigma_rad`` is how wrong the direction of a camera's initial IPM may be (one sigma): it
    sets how far a marking may seem to move between two images. ``refined_sigma_rad`` is the same
    once the extrinsic has been optimised. ``gate_sigmas`` is the size of every gate in sigmas and
    ``max_gate_m`` its limit. A track survives images without a sighting for ``max_gap_m`` of
    travel. ``shape_tolerance`` is how far corners may deviate from another sighting of the same
    shape, as a fraction of the marking's diameter. ``naive_merge_m`` is how far apart the naive
    methods, which know of no uncertainty, may put two tracks of one marking.
    """

    ipm_sigma_rad: float = 0.015
    refined_sigma_rad: float = 0.002
    gate_sigmas: float = 4.0
    max_gate_m: float = 1.5
    max_gap_m: float = 4.0
    shape_tolerance: float = 0.25
    naive_merge_m: float = 1.0

"""How the ground is matched and what is believed before it is."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class GroundOptions:
    """How the ground is matched.

    Attributes:
        pairs: image pairs that the mounting is found from.
        clock_pairs: further pairs, where speed or yaw rate change, for the clock.
        shortest_m: distance between the images of a pair; the error of a position weighs the less the longer.
        longest_m: beyond this the ground changes its looks and leaves the region that both see.
        strip_m: ground so far to either side of the driven path is taken for road.
        patch_m: side of a square patch.
        step_m: distance of neighbouring patches, which share a third of their sides.
        grid_m: spacing of the laid-out ground.
        free: names of the parameters to free, one at a time, beside the mounting; see :class:`Parameter`.
        readings: whether to try how else the poses could be read.
    """

    pairs: int = 36
    clock_pairs: int = 16
    shortest_m: float = 2.0
    longest_m: float = 4.0
    strip_m: float = 2.0
    patch_m: float = 0.9
    step_m: float = 0.6
    grid_m: float = 0.04
    free: tuple[str, ...] = (
        "clock_s",
        "focal_scale",
        "distortion_k1",
        "grade",
        "up_m",
        "forward_m",
        "left_m",
    )
    readings: bool = True

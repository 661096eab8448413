"""Whitenings and evaluations at once, in C++, of problems in which cameras alone move.

That is the paper's model, and that of every coarse stage. There the reduced unknowns are the extrinsics: few
numbers, which took torch longer than the passes over the observations. The reference is
:mod:`v2hdm.adjust.whitening`, which goes step by step; an engine without C++ does so, too.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch

from v2hdm import native
from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.kernels.layout import Layout
from v2hdm.adjust.kernels.tables import EXP_TERMS, LEFT_JACOBIAN_TERMS
from v2hdm.adjust.tiles import TiledCholesky
from v2hdm.records import FloatArray


class Parts(NamedTuple):
    """All of a problem but its observations, as the compiled kernels read it; see :class:`Arrays`."""

    vehicle_from_map: FloatArray  # (J, 4, 4)
    centre: FloatArray  # (C, 3)
    centre_root: FloatArray  # (C, 3)
    ground_plane: FloatArray  # (C, 4)
    ground_root: FloatArray  # (C, 3, 4)
    exp_series: FloatArray
    jacobian_series: FloatArray


def make_rig(arrays: Arrays, layout: Layout) -> Any:
    """The compiled form of a problem in which cameras alone move; None of another, or without C++."""
    kernels = native.kernels()
    if kernels is None or arrays.states or arrays.moves:
        return None
    return kernels.adjust.Rig(
        layout,
        Parts(
            vehicle_from_map=arrays.vehicle_from_map.numpy(),
            centre=arrays.centre.numpy(),
            centre_root=arrays.centre_information_root.numpy(),
            ground_plane=arrays.ground_plane.numpy(),
            ground_root=arrays.ground_root.numpy(),
            exp_series=EXP_TERMS,
            jacobian_series=LEFT_JACOBIAN_TERMS,
        ),
    )


class Evaluated(NamedTuple):
    """A compiled evaluation: costs by name as in :func:`terms_of`, what moved, and the gradient."""

    costs: tuple[float, ...]
    cam_from_vehicle: FloatArray  # (C, 4, 4)
    corners_map: FloatArray  # (N, 2)
    gradient: FloatArray  # by the whitened variables


def terms_of(costs: tuple[float, ...]) -> dict[str, float]:
    """The cost by name of a compiled whitening or evaluation."""
    observations, camera_centre, ground_planes, control_points, known_lengths = costs
    return {
        "observations": observations,
        "camera_centre": camera_centre,
        "ground_planes": ground_planes,
        "frame_states": 0.0,
        "clock_offsets": 0.0,
        "control_points": control_points,
        "known_lengths": known_lengths,
    }


def factor_of(whitening: Any) -> TiledCholesky:
    """L_S of a compiled whitening: of the tip alone."""
    tip = torch.from_numpy(whitening.tip)
    size = int(np.sqrt(len(tip)))
    held = torch.from_numpy(whitening.held).view(size, size) if len(whitening.held) else None
    return TiledCholesky((), (), (), tip.view(size, size), tip, held)

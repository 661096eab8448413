"""Types of arrays that records hold."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

JointCovariance = Callable[[IntArray, IntArray], FloatArray]
"""Joint covariance (2N, 2N), m^2, of the corners (N,) of markings (N,) of a map, stacked x0, y0, x1, ..."""

"""Sizes that a user states for classes of markings, as distances between their corners."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from v2hdm.adjust import KnownLengths
from v2hdm.mapping.options import SizeOptions
from v2hdm.records import DIAMOND, FloatArray, IntArray

_DIAGONALS = (((0, 2),), ((1, 3),))
_SIDES = (((0, 1), (3, 2)), ((1, 2), (0, 3)))
"""Pairs of corners that are as far apart as a marking is long, or wide: which of the two, the map tells."""


def known_lengths(
    sizes: SizeOptions, kind: Sequence[str], corners_map: FloatArray, corner_index: IntArray
) -> KnownLengths | None:
    """The distances between corners that sizes imply, None if there are none.

    Of a diamond the size is that of its diagonals, of all others that of its sides. A marking that is not of
    its class's size is another thing, or cut off; nothing is known of it.

    Args:
        sizes: What the user says.
        kind: (G,) class of every group.
        corners_map: (G, 4, 2) about where the corners lie, nan where nobody knows.
        corner_index: (G, 4) the corners' numbers in the adjustment, -1 for none.
    """
    first, second, length_m = [], [], []
    for name, size in sizes.by_class_m.items():
        spans = _DIAGONALS if name == DIAMOND else _SIDES
        for group in np.flatnonzero(np.array(kind) == name):
            corners = corners_map[group]
            apart = [[np.linalg.norm(corners[a] - corners[b]) for a, b in span] for span in spans]
            seen = np.array([np.mean(distances) for distances in apart])
            wanted = np.array(size) if seen[0] >= seen[1] else np.array(size)[::-1]
            # Also false where a corner is nowhere: then it is not known which of the two is the longer one.
            if not (np.abs(seen - wanted) <= sizes.tolerance * wanted).all():
                continue
            for span, metres in zip(spans, wanted, strict=True):
                ends = corner_index[group][np.array(span)]
                for a, b in ends[(ends >= 0).all(axis=1)]:
                    first.append(a)
                    second.append(b)
                    length_m.append(metres)
    if not first:
        return None
    sigma_m = np.full(len(first), sizes.sigma_m)
    return KnownLengths(np.array(first), np.array(second), np.array(length_m), sigma_m)

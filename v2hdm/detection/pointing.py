"""Where to look in the next image, from lines that somebody else writes: ``v2hdm localize --live``."""

from __future__ import annotations

import json
import logging
from collections import deque
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from v2hdm.records import FloatArray
from v2hdm.safe.texts import shown

_log = logging.getLogger(__name__)

_SAME_S = 0.05  # largest difference, s, between the times of an image and of its line


_KEPT = 16  # lines that are kept


class Pointed(NamedTuple):
    """Where to look in an image expected at a time."""

    stamp_s: float
    regions_px: FloatArray | None  # boxes (R, 4), px; None for everywhere
    is_all_later: bool = False  # whether all of it is to be searched once there is time


class Pointer:
    """The latest lines; one that cannot be read is left out with a warning, once."""

    def __init__(self) -> None:
        self._latest = deque[Pointed](maxlen=_KEPT)
        self._has_warned = False

    def follow(self, lines: Iterable[str]) -> None:
        """Take lines until there are no more."""
        for line in lines:
            try:
                record = json.loads(line)
                stated = record["regions_px"]
                regions_px = None if stated is None else np.array(stated, dtype=np.float64).reshape(-1, 4)
                is_all_later = record.get("all_later", False) is True
                self._latest.append(Pointed(float(record["stamp_s"]), regions_px, is_all_later))
            except (ValueError, TypeError, KeyError, AttributeError):
                self._latest.clear()
                if not self._has_warned:
                    _log.warning(
                        "--regions: %s is left out; give stamp_s and regions_px, as "
                        "[[left, top, right, bottom], ...]",
                        shown(line.strip()),
                    )
                self._has_warned = True

    def at(self, stamp_s: float | None) -> Pointed | None:
        """The boxes of the latest line about an image taken at a time; None to look everywhere."""
        if stamp_s is None:
            return None
        of_image = [pointed for pointed in tuple(self._latest) if abs(pointed.stamp_s - stamp_s) < _SAME_S]
        return of_image[-1] if of_image else None

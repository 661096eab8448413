"""The start: which place of a patch of markings is surely the vehicle's, or that none is."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np

from v2hdm.localization.agreement import Agreement
from v2hdm.localization.areas import AreaMap
from v2hdm.localization.paint import Paint
from v2hdm.localization.places import Patch, Place, Prior, search, vehicle_at
from v2hdm.localization.seeing import Look
from v2hdm.localization.words import WordPatch
from v2hdm.records import Calibration, FloatArray

# Least log likelihood ratio of the best place to any other: one wrong in e^10.
_SURER_BY = 10.0
_LEAST_MATCHED = 4  # markings of the place
_LEAST_SHARE = 0.6  # of what is seen
_SEARCH_S = 0.3  # time between searches
_TRIED_LOOKS = 4  # images, each a search, that test a place
_TRIED_PLACES = 6  # places that are tried: each costs as much as the images of 0.2 s
_LOST_S, _LOST_WAY_M = 0.8, 8.0  # after so long, or so far, without a place nothing fits
_STILL_M = 0.5  # a vehicle that has moved less stands: it may not have seen enough


class Proposal(NamedTuple):
    """A place that is sure, as x, y, m, and heading, rad, of the vehicle; else why there may be none."""

    pose: FloatArray | None
    reason: str | None = None


_NOTHING = Proposal(None)


@dataclass
class Quest:
    """The search for a place: the rough one and where the odometry was then, since when, and the last one."""

    prior: Prior | None
    local: FloatArray = field(default_factory=lambda: np.zeros(3))
    since_s: float | None = None
    since_m: float = 0.0
    last_s: float = -np.inf
    patch: Patch = field(default_factory=Patch)
    words: WordPatch = field(default_factory=WordPatch)
    looks: deque[Look] = field(default_factory=lambda: deque(maxlen=_TRIED_LOOKS))

    def propose(
        self,
        look: Look,
        local: FloatArray,
        way_m: float,
        paint: Paint,
        areas: AreaMap,
        calibrations: Mapping[str, Calibration],
        tried: Callable[[Place], Agreement],
    ) -> Proposal:
        """Search after a look, taken at a pose ``local`` (3,) of the odometry and a way of it.

        ``tried`` lays the last looks at a place and counts how the map explains them.
        """
        if self.since_s is None and self.patch.objects:
            self.since_s = look.stamp_s
            self.since_m = way_m
        if self.since_s is None or not self._is_due(look.stamp_s):
            return _NOTHING
        self.last_s = look.stamp_s
        self.looks.append(look)
        word_scores = partial(self.words.scores, area_map=areas)
        places = search(self.patch, paint, calibrations, self.local, self.prior, word_scores)
        if places:
            proposal = self._judged(places, local, tried)
            if proposal is not _NOTHING:
                return proposal
        waited_s = look.stamp_s - self.since_s
        waited_m = way_m - self.since_m
        is_long = (waited_s > _LOST_S and waited_m > _STILL_M) or waited_m > _LOST_WAY_M
        share = places[0].matched / max(places[0].quads, 1) if places else 0.0
        if is_long and len(self.patch.sure) >= _LEAST_MATCHED + 2 and share < _LEAST_SHARE:
            return Proposal(
                None,
                f"no place there explains more than {100 * share:.0f} % of the markings seen: is it the map "
                "of this site, as painted today, in these coordinates, and are these its cameras?",
            )
        return _NOTHING

    def _is_due(self, stamp_s: float) -> bool:
        """Whether it is time for a search: in turn, or because a map that is wrong is to be said by now."""
        assert self.since_s is not None
        is_deadline = self.last_s < self.since_s + _LOST_S < stamp_s
        return is_deadline or not 0 <= stamp_s - self.last_s < _SEARCH_S

    def _judged(
        self, places: list[Place], local: FloatArray, tried: Callable[[Place], Agreement]
    ) -> Proposal:
        """The place that the patch makes sure, or else the last images; or that all places contradict it."""
        best = places[0]
        second = places[1].score if len(places) > 1 else 0.0
        share = best.matched / max(best.quads, 1)
        is_enough = best.matched >= _LEAST_MATCHED and share >= _LEAST_SHARE
        if is_enough and best.score - max(second, 0.0) > _SURER_BY:
            return Proposal(vehicle_at(best.map_from_local, local))
        rivals = [place for place in places if best.score - place.score < _SURER_BY]
        if len(self.looks) < 2 or len(rivals) > _TRIED_PLACES:
            return _NOTHING
        agreements = [tried(place) for place in rivals]
        if all(agreement.differs for agreement in agreements):
            return Proposal(
                None,
                "wherever the vehicle may be, many markings seen lie beside those of the map: is it the map "
                "of this site, as painted today?",
            )
        pairs = zip(agreements, rivals, strict=True)
        scores = np.array([agreement.score + place.word_score for agreement, place in pairs])
        order = np.argsort(-scores)
        likeliest = agreements[order[0]]
        surer_by = scores[order[0]] - max(scores[order[1]] if len(order) > 1 else 0.0, 0.0)
        if likeliest.quads < _LEAST_MATCHED + 2 or likeliest.differs or surer_by <= _SURER_BY:
            return _NOTHING
        return Proposal(vehicle_at(rivals[order[0]].map_from_local, local))

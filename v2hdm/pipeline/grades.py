"""The accuracy of everything that was mapped, by the user's goal, and what is left out for it.

Grades come after mapping and its checks: maps in the cache hold all markings, whatever goal and grade a run
asks for, and a verdict on inputs does not depend on what is left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from v2hdm.errors import MappingError
from v2hdm.io.maps.corrections import Correction
from v2hdm.io.maps.features import features_of
from v2hdm.mapping.results import MethodResult
from v2hdm.pipeline.evaluate import CameraSets
from v2hdm.pipeline.stages import MappedSet
from v2hdm.records import ACCURACIES, BEST, Exclusion, FloatArray, HDMap, Marking, Symbol
from v2hdm.site.accuracy import accuracy_of, objection_to
from v2hdm.site.corrections import is_confirmed
from v2hdm.survey.run import Survey

_Paint = TypeVar("_Paint", Marking, Symbol)


def of_all_grades(survey: Survey) -> Survey:
    """The survey with settings of the mapping that leave out no grade."""
    acceptance = replace(survey.mapping.acceptance, accuracy=ACCURACIES[-1])
    return replace(survey, mapping=replace(survey.mapping, acceptance=acceptance))


def graded_sets(sets: Mapping[str, MappedSet], goal_m: float) -> dict[str, MappedSet]:
    """Mapped sets with the grade of every marking and symbol of every method; ``goal_m`` is a 95 % radius."""
    return {
        name: replace(
            mapped,
            methods={
                method: replace(result, hd_map=graded(result.hd_map, goal_m))
                for method, result in mapped.methods.items()
            },
        )
        for name, mapped in sets.items()
    }


def graded(hd_map: HDMap, goal_m: float) -> HDMap:
    """The map with the accuracy of its markings and symbols; an earlier map's grade does not stay."""

    def with_grade(paint: _Paint) -> _Paint:
        return replace(paint, accuracy=accuracy_of(paint.covariance_m2, goal_m))

    return replace(
        hd_map,
        markings=tuple(with_grade(marking) for marking in hd_map.markings),
        symbols=tuple(with_grade(symbol) for symbol in hd_map.symbols),
    )


def accurate_enough(
    methods: CameraSets, least_accuracy: str, corrections: Sequence[Correction] = ()
) -> CameraSets:
    """Results without markings below ``least_accuracy``, except those that a person has confirmed.

    Raises:
        MappingError: nothing of the map of all cameras would be left.
    """
    chosen = {
        name: {
            method: without_worse(result, least_accuracy, corrections) for method, result in by_method.items()
        }
        for name, by_method in methods.items()
    }
    name = list(methods)[-1]
    markings = methods[name][BEST].hd_map.markings
    if markings and not chosen[name][BEST].hd_map.markings:
        best = min(marking.accuracy or "" for marking in markings)
        raise MappingError(
            f"none of {len(markings)} markings is of accuracy {least_accuracy}, for which "
            f"mapping.acceptance.accuracy asks; the best are of accuracy {best}: ask for that, or see "
            "docs/accuracy.md"
        )
    return chosen


def without_worse(
    result: MethodResult, least_accuracy: str, corrections: Sequence[Correction] = ()
) -> MethodResult:
    """The result without markings and symbols of a worse grade, which become exclusions.

    The others keep the ids that they have in the whole map. What a person accepted or corrected stays.
    """

    def objection(paint: Marking | Symbol) -> str | None:
        against = objection_to(paint.accuracy, least_accuracy)
        return None if against and is_confirmed(_outline(paint), corrections) else against

    ids = [feature.id for feature in features_of(result.hd_map)]
    hd_map = _with_ids(result.hd_map, ids)
    paints: list[Marking | Symbol] = [*hd_map.markings, *hd_map.symbols]
    excluded = [
        Exclusion(paint.kind, _outline(paint).mean(axis=0), paint.sightings, reason)
        for paint in paints
        if (reason := objection(paint)) is not None
    ]
    if not excluded:
        return result
    markings = tuple(marking for marking in hd_map.markings if objection(marking) is None)
    symbols = tuple(symbol for symbol in hd_map.symbols if objection(symbol) is None)
    result = replace(result, excluded=(*result.excluded, *excluded))
    return _with_fewer_markings(result, replace(hd_map, markings=markings, symbols=symbols))


def _with_fewer_markings(result: MethodResult, hd_map: HDMap) -> MethodResult:
    """The result with some of its map's markings removed; the others keep their ids."""
    kept_ids = [marking.id or 0 for marking in hd_map.markings]
    residuals = result.residuals
    if residuals is not None:
        is_kept = np.isin(residuals.marking, kept_ids)
        residuals = replace(residuals, marking=np.where(is_kept, residuals.marking, 0))
    return replace(
        result,
        hd_map=hd_map,
        residuals=residuals,
        suspicions=[suspicion for suspicion in result.suspicions if suspicion.marking in kept_ids],
        joint_covariance=None,  # it numbers the markings as they were
    )


def with_composed(methods: CameraSets, goal_m: float) -> CameraSets:
    """Results whose best maps hold crosswalks, double lines and give-way lines, with grades by ``goal_m``."""
    return {
        name: {
            method: result if method != BEST else _composed(result, goal_m)
            for method, result in by_method.items()
        }
        for name, by_method in methods.items()
    }


def _composed(result: MethodResult, goal_m: float) -> MethodResult:
    """One result of :func:`with_composed`."""
    from v2hdm.site.composed import composed  # heavy for those who only check a drive

    hd_map = composed(result.hd_map)
    if len(hd_map.markings) == len(result.hd_map.markings):
        return replace(result, hd_map=graded(hd_map, goal_m))
    # Give-way lines took the place of their pieces: the others keep the ids that they would have had.
    ids = [feature.id for feature in features_of(result.hd_map)]
    hd_map = composed(_with_ids(result.hd_map, ids))
    return _with_fewer_markings(result, graded(hd_map, goal_m))


def _with_ids(hd_map: HDMap, ids: list[int]) -> HDMap:
    """The map with these ids of its markings, lanes, and symbols, in this order."""
    number = iter(ids)
    return replace(
        hd_map,
        markings=tuple(replace(marking, id=next(number)) for marking in hd_map.markings),
        lanes=tuple(replace(lane, id=next(number)) for lane in hd_map.lanes),
        symbols=tuple(replace(symbol, id=next(number)) for symbol in hd_map.symbols),
        largest_id=max([hd_map.largest_id, *ids]),
    )


def _outline(paint: Marking | Symbol) -> FloatArray:
    """Corners of a marking, or vertices of a symbol."""
    return paint.corners_map if isinstance(paint, Marking) else paint.outline_map

"""The edits of a person in a map's file, in a GIS for one, as corrections of the map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from v2hdm.errors import MapFileError
from v2hdm.io.maps.corrections import (
    ADDED,
    CORRECTED,
    REJECTED,
    Correction,
    is_quadrilateral,
)
from v2hdm.io.maps.reading import LAYERS, geopackage_rows, read_map
from v2hdm.records import FloatArray, HDMap, Lane, Marking, Symbol

_STILL_M = 2e-3  # largest difference, m, of places that are the same: files state them to a millimetre
_FARTHEST_M = 20.0  # largest distance, m, over which a person moves most markings of a map
_OUR_TABLES = ("v2hdm", *LAYERS.values())
_NAMED = 5  # features or layers that a sentence names


@dataclass(frozen=True)
class MapEdits:
    """The corrections that an edited file states, and sentences on what in it is no correction."""

    corrections: list[Correction]
    ignored: list[str] = field(default_factory=list)


def read_edits(path: Path, hd_map: HDMap) -> MapEdits:
    """The edits of the map ``hd_map`` in a GeoJSON or GeoPackage that was written of it.

    Raises:
        MapFileError: the file is no map, or one of another place or in another coordinate system.
    """
    edited, _ = read_map(path)
    edits = edits_between(hd_map, edited, str(path))
    layers = _foreign_layers(path)
    if not layers:
        return edits
    names = ", ".join(layers[:_NAMED])
    return MapEdits(edits.corrections, [*edits.ignored, f"{path}: not ours and not read: layer {names}"])


def edits_between(hd_map: HDMap, edited: HDMap, where: str) -> MapEdits:
    """The features deleted, reclassified, moved or added in the copy ``edited``, which is ``where``."""
    corrections = []
    ignored = []
    marking_of_id = {marking.id: marking for marking in edited.markings}
    _refuse_elsewhere(hd_map, marking_of_id, where)
    for marking in hd_map.markings:
        correction = _marking_edit(marking, marking_of_id.pop(marking.id, None))
        if correction is not None:
            corrections.append(correction)
    for marking in marking_of_id.values():
        corrections.append(_addition(marking, where))
    symbol_of_id = {symbol.id: symbol for symbol in edited.symbols}
    for symbol in hd_map.symbols:
        other = symbol_of_id.pop(symbol.id, None)
        correction = _symbol_edit(symbol, other)
        if correction is not None:
            corrections.append(correction)
        if other is not None and _has_moved(symbol.outline_map, other.outline_map):
            ignored.append(f"{where}: symbol {symbol.id} was moved, which no run reads; delete it instead")
    for symbol in symbol_of_id.values():
        place = symbol.outline_map.mean(axis=0)
        ignored.append(
            f"{where}: {symbol.kind} at ({place[0]:.2f}, {place[1]:.2f}) was added without four corners, "
            "which no run reads"
        )
    ignored += _lane_edits(hd_map, edited, where)
    return MapEdits(corrections, ignored)


def _refuse_elsewhere(hd_map: HDMap, marking_of_id: Mapping[int | None, Marking], where: str) -> None:
    """Refuse a copy whose markings lie elsewhere: a map of another site, or another coordinate system."""
    pairs = [(marking, marking_of_id.get(marking.id)) for marking in hd_map.markings]
    shared = [(before, after) for before, after in pairs if after is not None]
    if not shared:
        if hd_map.markings:
            raise MapFileError(
                f"{where}: none of its markings has an id of this map; give a copy of this map"
            )
        return
    away_m = [
        np.linalg.norm(before.corners_map.mean(axis=0) - after.corners_map.mean(axis=0))
        for before, after in shared
    ]
    if np.median(away_m) > _FARTHEST_M:
        raise MapFileError(
            f"{where}: its markings lie {np.median(away_m):.0f} m from those of this map; save it in the "
            "coordinate system that it was written in, or give a copy of this map"
        )


def _marking_edit(before: Marking, after: Marking | None) -> Correction | None:
    """The correction of a marking, None where it stayed."""
    outline = before.corners_map.tolist()
    if after is None:
        return Correction(says=REJECTED, kind=before.kind, outline_map=outline, marking=before.id)
    off_m = np.linalg.norm(after.corners_map - before.corners_map, axis=1)
    moved = {
        int(corner) + 1: after.corners_map[corner].tolist() for corner in np.flatnonzero(off_m > _STILL_M)
    }
    new_kind = after.kind if after.kind != before.kind else None
    if not moved and new_kind is None:
        return None
    return Correction(
        says=CORRECTED,
        kind=before.kind,
        outline_map=outline,
        marking=before.id,
        new_kind=new_kind,
        moved=moved,
    )


def _addition(marking: Marking, where: str) -> Correction:
    if not is_quadrilateral(marking.corners_map):
        place = marking.corners_map.mean(axis=0)
        raise MapFileError(
            f"{where}: the {marking.kind} at ({place[0]:.2f}, {place[1]:.2f}) crosses itself; draw it again"
        )
    return Correction(says=ADDED, kind=marking.kind, outline_map=marking.corners_map.tolist())


def _symbol_edit(before: Symbol, after: Symbol | None) -> Correction | None:
    outline = before.outline_map.tolist()
    if after is None:
        return Correction(says=REJECTED, kind=before.kind, outline_map=outline, marking=before.id)
    if after.kind == before.kind:
        return None
    return Correction(
        says=CORRECTED, kind=before.kind, outline_map=outline, marking=before.id, new_kind=after.kind
    )


def _has_moved(before: FloatArray, after: FloatArray) -> bool:
    return before.shape != after.shape or bool(np.abs(before - after).max() > _STILL_M)


def _lane_edits(hd_map: HDMap, edited: HDMap, where: str) -> list[str]:
    """A sentence on lane lines that differ, which no run reads."""

    def lines(lanes: tuple[Lane, ...]) -> dict[int | None, Lane]:
        return {lane.id: lane for lane in lanes}

    before = lines(hd_map.lanes)
    after = lines(edited.lanes)
    changed = [
        str(number)
        for number in before.keys() | after.keys()
        if number not in before
        or number not in after
        or _has_moved(before[number].points_map, after[number].points_map)
    ]
    if not changed:
        return []
    return [
        f"{where}: {len(changed)} lane lines were edited, which no run reads: {', '.join(changed[:_NAMED])}"
    ]


def _foreign_layers(path: Path) -> list[str]:
    """The layers of a GeoPackage that are not of a map."""
    if path.suffix.lower() != ".gpkg":
        return []
    rows = geopackage_rows(path, "gpkg_contents")
    tables = [str(row.get("table_name")) for row in rows]
    return sorted(table for table in tables if table not in _OUR_TABLES and table != "layer_styles")

"""The questions of a lane graph, as GeoJSON, and the answers that people write into it.

A question is a point, or a line where a way or a direction is asked about; its property ``answer`` is empty.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import MapFileError, shown
from v2hdm.geometry.geodetic import enu_from_geodetic
from v2hdm.io.maps.corrections import Correction, read_corrections
from v2hdm.io.maps.geojson import geojson_feature, geojson_positions, write_features
from v2hdm.records import FloatArray, GeodeticOrigin
from v2hdm.store.files import load_json, take_array, take_mapping
from v2hdm.topology.answers import Answer
from v2hdm.topology.graph import SUBJECTS, Question


def questions_file(name: str) -> str:
    """The file of the questions on a map of this name."""
    return f"{name}_questions.geojson"


def write_questions(questions: Sequence[Question], origin: GeodeticOrigin | None, path: Path) -> None:
    """Write questions, atomically, each with its ``subject``, its ``text`` and its local place, m."""
    features = []
    for number, question in enumerate(questions, start=1):
        places = [place for place in (question.place_map, question.to_map) if place is not None]
        positions = geojson_positions(np.stack(places), None, origin)
        properties: dict[str, Any] = {"id": number, "subject": question.subject, "text": question.text}
        properties["answer"] = None
        properties["points_map"] = np.stack(places).tolist()
        shape = "Point" if len(places) == 1 else "LineString"
        coordinates = positions[0] if len(places) == 1 else positions
        features.append(geojson_feature(number, shape, coordinates, properties))
    write_features(path, features, origin, {"questions": len(features)})


def answers_among(corrections: Sequence[Correction]) -> list[Answer]:
    """The answers to questions on lanes among a person's corrections."""
    answers = []
    for correction in corrections:
        if correction.is_answer:
            places = np.array(correction.outline_map)
            to_map = places[-1] if len(places) > 1 else None
            where = f"the answer on the {correction.place}"
            answers.append(Answer(correction.kind, correction.answer, places[0], to_map, where))
    return answers


def read_answers(path: Path, origin: GeodeticOrigin | None) -> list[Answer]:
    """The answers in a file of questions, and in lines that a person has drawn into it.

    A YAML file is one of corrections, with the answers given in ``v2hdm view``. Raises MapFileError where the
    file is neither, or an answer has no place.
    """
    if path.suffix.lower() in (".yaml", ".yml"):
        return answers_among(read_corrections(path))
    content = take_mapping(load_json(path, MapFileError), str(path), MapFileError)
    features = content.get("features")
    if not isinstance(features, list):
        raise MapFileError(f"{path}: not a GeoJSON of questions; give the map_questions.geojson of an export")
    answers = []
    for number, feature in enumerate(features, start=1):
        where = f"{path}, feature {number}"
        entry = take_mapping(feature, where, MapFileError)
        properties = take_mapping(entry.get("properties"), f"{where}, properties", MapFileError)
        if properties.get("answer") in (None, ""):
            continue
        subject = properties.get("subject")
        if subject not in SUBJECTS:
            subjects = ", ".join(SUBJECTS)
            raise MapFileError(
                f"{where}: {shown(subject)} is not a subject of a question; give one of {subjects}"
            )
        places = _places(entry.get("geometry"), origin, where)
        to_map = places[-1] if len(places) > 1 else None
        answers.append(Answer(subject, str(properties["answer"]).strip(), places[0], to_map, where))
    return answers


def _places(geometry: object, origin: GeodeticOrigin | None, where: str) -> FloatArray:
    """The points (N, 2), m, of a point or a line."""
    entry = take_mapping(geometry, f"{where}, geometry", MapFileError)
    if entry.get("type") not in ("Point", "LineString"):
        raise MapFileError(f"{where}: its geometry is a {shown(entry.get('type'))}; draw a line or a point")
    coordinates = entry.get("coordinates")
    rows = [coordinates] if entry["type"] == "Point" else coordinates
    flat = [row[:2] if isinstance(row, list) else row for row in rows] if isinstance(rows, list) else rows
    positions = take_array(flat, (-1, 2), f"{where}, coordinates", MapFileError)
    if not len(positions):
        raise MapFileError(f"{where}: its geometry is empty; draw a line or a point")
    if origin is None:
        return positions
    if (np.abs(positions[:, 1]) > 90).any():
        raise MapFileError(
            f"{where}: its geometry is not in degrees of longitude and latitude; save it in EPSG:4326"
        )
    height_m = np.full(len(positions), origin.altitude_m)
    return enu_from_geodetic(origin, np.column_stack([positions[:, ::-1], height_m]))[:, :2]

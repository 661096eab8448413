"""What a lane graph leaves open, as GeoJSON: a point for each question, a line where a way is asked about."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.io.maps.geojson import geojson_feature, geojson_positions, write_features
from v2hdm.records import GeodeticOrigin
from v2hdm.topology.graph import Question


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
        properties["points_map"] = np.stack(places).tolist()
        shape = "Point" if len(places) == 1 else "LineString"
        coordinates = positions[0] if len(places) == 1 else positions
        features.append(geojson_feature(number, shape, coordinates, properties))
    write_features(path, features, origin, {"questions": len(features)})

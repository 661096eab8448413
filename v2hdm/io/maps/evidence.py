"""Evidence beside a map: corner observations with residuals, as CSV, and rejected candidates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from v2hdm.errors import MapFileError
from v2hdm.io.maps.features import FARTHEST_M, ground_height_m
from v2hdm.io.maps.geojson import geojson_feature, geojson_positions, write_features
from v2hdm.records import BoolArray, Exclusion, FloatArray, GeodeticOrigin, IntArray, Road
from v2hdm.store import files

_LARGEST_ID = 1_000_000_000  # of a marking, as in its map
_LARGEST = 1e12  # pixel, standard deviation or time, s: chosen, beyond any that was

COLUMNS = (
    *("image", "camera", "taken_s", "marking", "corner", "point"),
    *("u_px", "v_px", "du_px", "dv_px", "distance_sigma"),
)
"""``image`` is a path below the drive's folder; ``marking`` the id of a feature of ``map.geojson``, empty
where the candidate was left out; ``corner`` counts from 1 in the order of its ``corners_map``; ``point`` is 0
where only the distance from a line was seen. ``u_px``, ``v_px`` are pinhole pixels, ``du_px``, ``dv_px``
projected minus observed, ``distance_sigma`` the same in standard deviations."""


@dataclass(frozen=True)
class Residuals:
    """K corner observations in I images that an optimisation accepted."""

    image: tuple[str, ...]  # I paths below the drive's folder
    camera: tuple[str, ...]  # the name of each image's camera
    taken_s: FloatArray  # (I,) times of the images, on the clock of the poses
    row_image: IntArray  # (K,) indices into the images
    marking: IntArray  # (K,) the id of the marking, 0 where its candidate was left out of the map
    corner: IntArray  # (K,) 0 to 3, in the order of its corners
    is_point: BoolArray  # (K,) whether the observation says where the corner is, not only on which line
    observed_px: FloatArray  # (K, 2) pinhole pixels
    residual_px: FloatArray  # (K, 2) projected minus observed
    distance_sigma: FloatArray  # (K,) its length in standard deviations

    def __len__(self) -> int:
        return len(self.row_image)

    def whole_views(self) -> set[tuple[str, int]]:
        """Pairs of an image, by path, and the id of a marking of the map whose four corners it shows."""
        pairs = np.column_stack([self.row_image, self.marking])[self.is_point & (self.marking > 0)]
        views, corners = np.unique(pairs, axis=0, return_counts=True)
        return {(self.image[image], marking) for image, marking in views[corners == 4].tolist()}

    def take(self, rows: BoolArray) -> Residuals:
        """The observations at ``rows`` (K,), in the same images."""
        names = ("row_image", "marking", "corner", "is_point", "observed_px", "residual_px", "distance_sigma")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def renamed(self, marking: IntArray, corner: IntArray) -> Residuals:
        """The same with new ids (M,) for markings 1 to M, 0 for none, and new corner numbers (M, 4)."""
        has_id = self.marking > 0
        row = np.maximum(self.marking - 1, 0)
        return replace(
            self,
            marking=np.where(has_id, np.append(marking, 0)[row], 0),
            corner=np.where(has_id, np.vstack([corner, np.arange(4)])[row, self.corner], self.corner),
        )


def write_residuals(residuals: Residuals, path: Path) -> None:
    """Write ``residuals`` to ``path``, atomically, one row for each observation."""
    described = zip(residuals.image, residuals.camera, residuals.taken_s.tolist(), strict=True)
    # All that may need quotes is told once an image.
    begins = [
        files.csv_text([(image, camera, f"{taken_s:.6f}")]).removesuffix("\n")
        for image, camera, taken_s in described
    ]
    columns = (
        residuals.row_image, residuals.marking, residuals.corner, residuals.is_point,
        *residuals.observed_px.T, *residuals.residual_px.T, residuals.distance_sigma,
    )  # fmt: skip
    lines = [
        f"{begins[i]},{marking or ''},{corner + 1},{point:d},{u:.3f},{v:.3f},{du:.4f},{dv:.4f},{sigma:.3f}"
        for i, marking, corner, point, u, v, du, dv, sigma in zip(
            *(column.tolist() for column in columns), strict=True
        )
    ]
    files.replace_text(path, "\n".join([",".join(COLUMNS), *lines, ""]))


def read_residuals(path: Path) -> Residuals:
    """Read the file of :func:`write_residuals`; raises MapFileError where it is missing or damaged."""
    rows = files.read_csv(path, MapFileError)
    if not rows or tuple(rows[0]) != COLUMNS:
        raise MapFileError(f"{path}: its columns are not {','.join(COLUMNS)}; map the drive again")
    images: dict[str, tuple[int, str, float]] = {}
    row_image = []
    numbers = []
    problem = f"not {len(COLUMNS)} fields as in the header, with possible numbers; map the drive again"
    for line, row in enumerate(rows[1:], start=2):
        try:
            image, camera, taken_s, marking, *figures = row
            number, _, _ = images.setdefault(image, (len(images), camera, float(taken_s)))
            numbers.append([float(marking or 0), *map(float, figures)])
            if len(row) != len(COLUMNS):
                raise ValueError
        except ValueError:
            raise MapFileError(f"{path}: line {line}: {problem}") from None
        row_image.append(number)
    table = np.array(numbers, dtype=np.float64).reshape(-1, len(COLUMNS) - 3)
    cameras = tuple(camera for _, camera, _ in images.values())
    stamps = np.array([stamp for _, _, stamp in images.values()])
    is_sound = _are_sound(table, stamps[row_image])
    if not is_sound.all():
        raise MapFileError(f"{path}: line {int(np.argmin(is_sound)) + 2}: {problem}")
    ids, corners = table[:, :2].astype(np.int64).T
    return Residuals(
        image=tuple(images),
        camera=cameras,
        taken_s=stamps,
        row_image=np.array(row_image, dtype=np.int64),
        marking=ids,
        corner=corners - 1,
        is_point=table[:, 2] > 0,
        observed_px=table[:, 3:5],
        residual_px=table[:, 5:7],
        distance_sigma=table[:, 7],
    )


def _are_sound(table: FloatArray, taken_s: FloatArray) -> BoolArray:
    """Whether the numbers (K, 8) of lines, from ``marking`` on, and the times of their images can be."""
    marking, corner = table[:, :2].T
    is_whole = (marking >= 0) & (marking <= _LARGEST_ID) & (marking == np.floor(marking))
    is_place = (np.abs(table[:, 2:5]) <= _LARGEST).all(axis=1) & (np.abs(taken_s) <= _LARGEST)
    # A corner behind the camera has a place in the image, and no finite residual.
    off = table[:, 5:]
    is_residual = ((np.abs(off) <= _LARGEST) | ~np.isfinite(off)).all(axis=1)
    return np.asarray(is_whole & np.isin(corner, (1, 2, 3, 4)) & is_place & is_residual)


def write_exclusions(
    excluded: Sequence[Exclusion], path: Path, origin: GeodeticOrigin | None, road: Road | None
) -> None:
    """Write a FeatureCollection of points, atomically; ``cameras`` names the camera set of each."""
    features = []
    for number, exclusion in enumerate(excluded):
        place = exclusion.position_map.reshape(1, 2)
        heights = None if road is None else ground_height_m(road, place)
        properties = {
            "id": number,
            "class": exclusion.kind,
            "reason": exclusion.reason,
            "sightings": exclusion.sightings,
        }
        properties |= {"cameras": exclusion.cameras, "position_map": exclusion.position_map.tolist()}
        (position,) = geojson_positions(place, heights, origin)
        features.append(geojson_feature(f"excluded/{number}", "Point", position, properties))
    write_features(path, features, origin, {})


def read_exclusions(path: Path) -> list[Exclusion]:
    """Read the file of :func:`write_exclusions`; raises MapFileError where it is missing or damaged."""
    features = files.load_json(path, MapFileError).get("features")
    if not isinstance(features, list):
        raise MapFileError(f"{path}: no 'features'; give a file that v2hdm map wrote")
    excluded = []
    for number, feature in enumerate(features):
        where = f"{path}: feature {number}"
        feature = files.take_mapping(feature, where, MapFileError)
        entry = files.take_mapping(feature.get("properties"), where, MapFileError)
        kind, reason, cameras = (
            files.take_text(entry.get(key), f"{where}: {key}", MapFileError)
            for key in ("class", "reason", "cameras")
        )
        at = files.take_array(entry.get("position_map", np.nan), (2,), f"{where}: position_map", MapFileError)
        if np.abs(at).max() > FARTHEST_M:
            raise MapFileError(f"{where}: position_map: lies beyond the earth; map the drive again")
        sightings = files.take_number(entry.get("sightings"), f"{where}: sightings", MapFileError)
        excluded.append(Exclusion(kind, at, int(sightings), reason, cameras))
    return excluded

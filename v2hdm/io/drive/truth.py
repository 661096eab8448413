"""Reading ground truth beside a drive, for the report alone: the mapper never imports this module."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.io.calibration.reading import take_rigid
from v2hdm.io.maps.reading import read_geojson
from v2hdm.io.trajectory import read_tum
from v2hdm.records import BoolArray, Drive, FloatArray, HDMap, Image, Truth
from v2hdm.store.files import check_keys, load_yaml, read_csv, take_mapping, take_number
from v2hdm.store.names import MAP

SIGHTINGS = ("camera", "timestamp", "marking", "visible_fraction")
LANE_VISIBLE = ("lane", "vertex")
TEXTS = ("symbol", "text")
TEXTS_FILE = "texts.csv"
"""Words of the true map's symbols, by their number; left out where none says anything."""


def read_truth(drive: Drive) -> Truth:
    """The ground truth of ``drive``, its rows in the order of ``drive.images``; raises DriveError without."""
    if drive.joined:
        return _joined_truth(drive)
    folder = drive.truth_dir
    if folder is None:
        raise DriveError(f"{drive.root}: has no ground truth to compare with; drop the comparison")
    hd_map = read_geojson(folder / MAP)
    noted = folder / "disturbances.yaml"
    named = load_yaml(noted, DriveError)
    markings = len(hd_map.markings)
    visibility = _read_sightings(folder / "sightings.csv", drive.images, markings + len(hd_map.symbols))
    return Truth(
        map=hd_map,
        cam_from_vehicle=_read_cameras(folder / "cameras.yaml", drive),
        map_from_vehicle=_read_poses(folder / "poses.tum", drive.images),
        visibility=visibility[:, :markings],
        lane_visible=_read_lane_visible(folder / "lane_visible.csv", hd_map),
        disturbances={key: take_number(value, f"{noted}: {key}", DriveError) for key, value in named.items()},
        symbol_visibility=visibility[:, markings:],
        texts=_read_texts(folder / TEXTS_FILE, len(hd_map.symbols)),
    )


def has_truth(drive: Drive) -> bool:
    """Whether there is a ground truth that holds for all of the drive: joined ones must share it."""
    if not drive.joined:
        return drive.truth_dir is not None
    folders = [session.truth_dir for session in drive.sessions if session.truth_dir is not None]
    if len(folders) < len(drive.sessions):
        return False
    maps = [read_geojson(folder / MAP) for folder in folders]
    corners = [[marking.corners_map for marking in hd_map.markings] for hd_map in maps]
    same_origin = all(hd_map.origin == maps[0].origin for hd_map in maps)
    return same_origin and all(np.array_equal(corners[0], corners_of_map) for corners_of_map in corners)


def _joined_truth(drive: Drive) -> Truth:
    """The truths of all sessions as one, in the order of the joined drive's images."""
    parts = []
    rows = []
    for number, session in enumerate(drive.joined):
        own_name = {joined: name_of_session for name_of_session, joined in session.cameras.items()}
        rows_of_session = [i for i, image in enumerate(drive.images) if image.session == number]
        images = [replace(drive.images[i], camera=own_name[drive.images[i].camera]) for i in rows_of_session]
        cameras = {name: drive.cameras[joined] for name, joined in session.cameras.items()}
        rows.append(rows_of_session)
        parts.append(
            read_truth(Drive(session.name, session.root, cameras, images, truth_dir=session.truth_dir))
        )
    order = np.argsort(np.concatenate(rows), kind="stable")
    cam_from_vehicle: dict[str, FloatArray] = {}
    disturbances: dict[str, float] = {}
    for session, part in zip(drive.joined, parts, strict=True):
        disturbances |= {f"{session.name}: {key}": value for key, value in part.disturbances.items()}
        for name, matrix in part.cam_from_vehicle.items():
            cam_from_vehicle.setdefault(session.cameras[name], matrix)
    lanes = zip(*[part.lane_visible for part in parts], strict=True)
    return Truth(
        map=parts[0].map,
        cam_from_vehicle=cam_from_vehicle,
        map_from_vehicle=np.concatenate([part.map_from_vehicle for part in parts])[order],
        visibility=np.concatenate([part.visibility for part in parts])[order],
        lane_visible=tuple(np.logical_or.reduce(flags) for flags in lanes),
        disturbances=disturbances,
        symbol_visibility=np.concatenate([_of_symbols(part) for part in parts])[order],
        texts=parts[0].texts,
    )


def _of_symbols(truth: Truth) -> FloatArray:
    """The visible shares (I, S) of the symbols in each image."""
    visibility = truth.symbol_visibility
    if visibility is None:
        return np.zeros((len(truth.visibility), len(truth.map.symbols)))
    return visibility


def _microseconds(stamp_s: float) -> int:
    return round(stamp_s * 1e6)  # text with fewer decimals must still match


def _read_cameras(path: Path, drive: Drive) -> Mapping[str, FloatArray]:
    content = load_yaml(path, DriveError)
    cam_from_vehicle = {}
    for name in drive.cameras:
        where = f"{path}: camera '{name}'"
        if name not in content:
            raise DriveError(f"{where}: missing; add its cam_from_vehicle")
        entry = take_mapping(content[name], where, DriveError)
        check_keys(entry, ("cam_from_vehicle",), (), where, DriveError)
        cam_from_vehicle[name] = take_rigid(entry["cam_from_vehicle"], where)
    return cam_from_vehicle


def _read_poses(path: Path, images: Sequence[Image]) -> FloatArray:
    trajectory = read_tum(path)
    row_of = {_microseconds(stamp): row for row, stamp in enumerate(trajectory.stamp_s)}
    rows = [row_of.get(_microseconds(image.stamp_s), -1) for image in images]
    if -1 in rows:
        missing = images[rows.index(-1)]
        raise DriveError(f"{path}: no true pose at the time {missing.stamp_s:.9f} of {missing.path}; add it")
    return np.asarray(trajectory.map_from_vehicle[rows])


def _read_sightings(path: Path, images: Sequence[Image], markings: int) -> FloatArray:
    """Fractions (I, J) of markings, then symbols, without the sightings of images that were left out."""
    row_of = {(image.camera, _microseconds(image.stamp_s)): i for i, image in enumerate(images)}
    visibility = np.zeros((len(images), markings))
    for where, (camera, stamp, marking, fraction) in _rows(path, SIGHTINGS):
        try:
            key = (camera, _microseconds(float(stamp)))
            j = int(marking)
            value = float(fraction)
        except ValueError:
            raise DriveError(f"{where}: not '{','.join(SIGHTINGS)}'; fix that line") from None
        if not 0 <= j < markings or not 0.0 <= value <= 1.0:
            raise DriveError(f"{where}: marking must be below {markings}, visible_fraction in 0 to 1; fix")
        if key in row_of:
            visibility[row_of[key], j] = value
    return visibility


def _read_texts(path: Path, symbols: int) -> Mapping[int, str]:
    """The texts of a map's symbols, by their number."""
    texts: dict[int, str] = {}
    for where, (symbol, text) in _rows(path, TEXTS) if path.is_file() else ():
        if not symbol.isdecimal() or int(symbol) >= symbols or not text:
            raise DriveError(f"{where}: no text of a symbol below {symbols}; fix that line")
        texts[int(symbol)] = text
    return texts


def _read_lane_visible(path: Path, hd_map: HDMap) -> tuple[BoolArray, ...]:
    visible = tuple(np.zeros(len(lane.points_map), dtype=np.bool_) for lane in hd_map.lanes)
    for where, (lane, vertex) in _rows(path, LANE_VISIBLE):
        is_index = lane.isdecimal() and vertex.isdecimal()
        if not is_index or int(lane) >= len(visible) or int(vertex) >= len(visible[int(lane)]):
            raise DriveError(f"{where}: no vertex {vertex} of a lane {lane} in the true map; fix that line")
        visible[int(lane)][int(vertex)] = True
    return visible


def _rows(path: Path, columns: Sequence[str]) -> Iterator[tuple[str, list[str]]]:
    """The rows of a CSV file below its header, each with its place for messages."""
    header, *rows = read_csv(path, DriveError) or [[]]
    if header != list(columns):
        raise DriveError(f"{path}: line 1: expected the header '{','.join(columns)}'; add it")
    for number, row in enumerate(rows, start=2):
        where = f"{path}: line {number}"
        if len(row) != len(columns):
            raise DriveError(f"{where}: expected {len(columns)} columns, got {len(row)}; fix that line")
        yield where, row

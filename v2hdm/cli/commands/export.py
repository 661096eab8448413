"""``v2hdm export MAP --format gpkg``: one line per file that was written (docs/exports.md).

A map is ``map.geojson`` or ``map.gpkg`` as a run wrote it or a GIS has edited it, a calibration a
``calibration_<camera>.yaml``.
"""

from __future__ import annotations

import argparse
import logging
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from v2hdm.cli.command import Command
from v2hdm.errors import ConfigError, MapFileError, shown

if TYPE_CHECKING:
    from v2hdm.records import FloatArray, HDMap, Trajectory
    from v2hdm.topology.answers import Answer


def _run(arguments: Sequence[str]) -> None:
    """Convert a map or a calibration."""
    parser = COMMAND.parser()
    parser.add_argument("source", type=Path, metavar="MAP", help="map.geojson, .gpkg, or calibration_*.yaml")
    kinds = (
        "for a map: geojson, csv, gpkg, lanelet2, dxf, qgis, opendrive, landxml, flatgeobuf, shapefile, kml, "
    )
    kinds += "jsonfg, pmtiles, geoparquet, mcap; for mosaic.tif: pcd, pmtiles, xyz; "
    kinds += "for a calibration: camera_info, static_transform, urdf, kalibr, opencv; may be repeated"
    parser.add_argument("--format", action="append", required=True, metavar="NAME", help=kinds)
    parser.add_argument("--output", type=Path, metavar="DIR", help="output folder (default: that of MAP)")
    ways = "for lanelet2: Local, MGRS, or LocalCartesian (default with an origin, else Local)"
    parser.add_argument("--projector", metavar="NAME", help=ways)
    system = "coordinate system of the output, such as EPSG:25832, or local for the drive's own frame"
    parser.add_argument("--crs", metavar="NAME", help=system)
    paths = (
        "for lanelet2, opendrive and mcap: poses of a drive in the map's frame, which say where lanes lead; "
    )
    paths += "may be repeated (default: trajectory*.tum beside MAP)"
    parser.add_argument("--path", action="append", type=Path, metavar="FILE", help=paths)
    answered = "for lanelet2 and opendrive: map_questions.geojson of an export with answers, or corrections "
    answered += "by v2hdm view"
    parser.add_argument("--answers", type=Path, metavar="FILE", help=answered)
    parsed = parser.parse_args(arguments)
    from v2hdm.pipeline.context import logging_to
    from v2hdm.store.results import listed_files

    handler = logging.StreamHandler()
    folder = parsed.output or parsed.source.parent
    handler.setLevel(logging.INFO)
    exports = {".yaml": _export_calibration, ".yml": _export_calibration, ".tif": _export_mosaic}
    export = exports.get(parsed.source.suffix.lower(), _export_map)
    try:
        with logging_to(handler):
            source = os.path.relpath(parsed.source.resolve(), folder.resolve())  # both may be moved together
            with listed_files(folder, "--output", f"v2hdm export of {source}") as check:
                files = export(parsed, folder, check)
            print("\n".join(map(str, files)))
    except BrokenPipeError:  # the reader of our output has had enough
        raise
    except OSError as error:
        raise MapFileError(f"{error.filename}: cannot be written ({error.strerror}); set --output") from None


def _export_map(parsed: argparse.Namespace, folder: Path, check: Callable[[Path], object]) -> list[Path]:
    from v2hdm.io.maps import formats
    from v2hdm.io.maps.questions import questions_file, read_answers
    from v2hdm.io.maps.reading import read_map
    from v2hdm.store.names import OVERLAYS

    if ground := [form for form in parsed.format if form in formats.GROUND_FORMATS]:
        raise ConfigError(
            f"--format {ground[0]}: a map file does not hold the ground; let the run write it with "
            f"'export=[geojson,{ground[0]}]'"
        )
    formats.check_formats(parsed.format, "--format")
    name = parsed.source.stem
    chosen = formats.with_data(parsed.format)
    hd_map, verdict = read_map(parsed.source)
    grid = formats.check_crs(parsed.crs, chosen, hd_map.origin, "--crs").get("gpkg")
    # A project uses an existing GeoPackage of this map, whatever wrote it.
    geopackage = folder / formats.FORMATS["gpkg"].file.format(name=name)
    crs = None if grid is None else grid.crs
    is_kept = "gpkg" not in parsed.format and formats.holds(geopackage, hd_map, crs)
    kept_formats = ["gpkg"] if is_kept else []
    files = [
        folder / formats.FORMATS[form].file.format(name=name) for form in chosen if form not in kept_formats
    ]
    trajectories = []
    answers: list[Answer] = []
    _check_used(parsed.path, "--path", formats.DRIVEN_FORMATS, chosen)
    _check_used(parsed.answers, "--answers", formats.LANE_FORMATS, chosen)
    if set(formats.DRIVEN_FORMATS) & set(chosen):
        trajectories = _driven(parsed, hd_map)
    if set(formats.LANE_FORMATS) & set(chosen):
        answers = [] if parsed.answers is None else read_answers(parsed.answers, hd_map.origin)
        files.append(folder / questions_file(name))
    if parsed.source.resolve() in [file.resolve() for file in files]:
        raise ConfigError(f"{parsed.source} would be overwritten: set another --output or --format")
    if parsed.answers is not None and parsed.answers.resolve() in [file.resolve() for file in files]:
        raise ConfigError(f"{parsed.answers} would be overwritten: set another --output")
    for file in files:
        check(file)
    return formats.write_map(
        hd_map,
        folder,
        name,
        parsed.format,
        verdict,
        parsed.projector,
        parsed.crs,
        kept_formats,
        trajectories,
        answers,
        sorted(parsed.source.parent.glob(OVERLAYS)),
    )


def _check_used(value: object, option: str, users: Sequence[str], chosen: Sequence[str]) -> None:
    """Refuse an option that none of the ``chosen`` formats uses."""
    if value and not set(users) & set(chosen):
        raise ConfigError(
            f"{option}: only the formats {', '.join(users[:-1])} and {users[-1]} have a use for it"
        )


_FARTHEST_M = 50.0  # distance, m, from the map within which a path says something of its lanes; chosen


def _driven(parsed: argparse.Namespace, hd_map: HDMap) -> list[Trajectory]:
    """The poses that the user names, else those beside the map."""
    import numpy as np

    from v2hdm.io.trajectory import read_tum
    from v2hdm.store.names import TRAJECTORIES

    paths = parsed.path or sorted(parsed.source.parent.glob(TRAJECTORIES))
    trajectories = [read_tum(path) for path in paths]
    lines = [lane.points_map for lane in hd_map.lanes if len(lane.points_map)]
    for path, trajectory in zip(paths, trajectories, strict=True):
        positions = trajectory.map_from_vehicle[:, :2, 3]
        is_near = [
            (positions > line.min(axis=0) - _FARTHEST_M) & (positions < line.max(axis=0) + _FARTHEST_M)
            for line in lines
        ]
        if lines and not np.all(is_near, axis=2).any():
            raise MapFileError(
                f"{path}: no pose is near a lane of the map; give poses in the map's own frame"
            )
    return trajectories


def _export_mosaic(parsed: argparse.Namespace, folder: Path, *_: object) -> list[Path]:
    from v2hdm.io.maps.web_tiles import write_mosaic_pmtiles, write_mosaic_xyz

    _refuse_crs(parsed, "points are in the map's own frame, and web tiles in Web Mercator")
    name = parsed.source.stem
    writers = {
        "pcd": lambda: _export_cloud(parsed.source, folder / f"{name}.pcd"),
        "pmtiles": lambda: write_mosaic_pmtiles(parsed.source, folder / f"{name}.pmtiles"),
        "xyz": lambda: write_mosaic_xyz(parsed.source, folder / f"{name}_tiles"),
    }
    if unknown := [form for form in parsed.format if form not in writers]:
        raise ConfigError(
            f"--format {shown(unknown[0])}: a mosaic is already a GeoTIFF; its other formats are "
            f"{', '.join(writers)}"
        )
    return [path for form in parsed.format for path in writers[form]()]


def _export_cloud(mosaic: Path, path: Path) -> list[Path]:
    import numpy as np

    from v2hdm.io.drive.road import lay_flat
    from v2hdm.io.maps.features import ground_height_m
    from v2hdm.io.trajectory import read_tum
    from v2hdm.store.names import TRAJECTORY
    from v2hdm.surface.strips import write_cloud

    driven = lay_flat(read_tum(mosaic.with_name(TRAJECTORY)))

    def height_m(places: FloatArray) -> FloatArray:
        return np.zeros(len(places)) if driven.road is None else ground_height_m(driven.road, places)

    write_cloud(mosaic, path, height_m)
    return [path]


def _refuse_crs(parsed: argparse.Namespace, reason: str) -> None:
    if parsed.crs is not None:
        raise ConfigError(f"--crs: {reason}; leave it out")


def _export_calibration(parsed: argparse.Namespace, folder: Path, *_: object) -> list[Path]:
    from v2hdm.io.calibration.reading import read_calibration, read_provenance
    from v2hdm.io.calibration.writing import CALIBRATION_FORMATS, write_calibration_as

    _refuse_crs(parsed, "a calibration has no position on the earth")
    unknown = [name for name in parsed.format if name not in CALIBRATION_FORMATS]
    if unknown:
        formats = ", ".join(CALIBRATION_FORMATS)
        raise ConfigError(
            f"--format: unknown format {shown(unknown[0])} for a calibration; choose from: {formats}"
        )
    calibration = read_calibration(parsed.source)
    about = read_provenance(parsed.source)
    camera = calibration.info.name
    return [write_calibration_as(name, calibration, about, folder, camera) for name in parsed.format]


COMMAND = Command(
    "v2hdm export",
    "Convert a map or a calibration to other formats.",
    _run,
    extra=None,
    interrupted="interrupted; the files listed are complete",
)

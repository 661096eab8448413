"""``v2hdm export MAP --format gpkg``: one line per file that was written (docs/exports.md).

A map is ``map.geojson`` or ``map.gpkg`` as a run wrote it or a GIS has edited it, a calibration a
``calibration_<camera>.yaml``.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.main import parser_of
from v2hdm.errors import ConfigError, MapFileError


def run(arguments: Sequence[str]) -> None:
    """Convert a map or a calibration."""
    parser = parser_of("export")
    parser.add_argument(
        "source", type=Path, metavar="MAP", help="map.geojson, map.gpkg or calibration_<camera>.yaml"
    )
    parser.add_argument(
        "--format",
        action="append",
        required=True,
        metavar="NAME",
        help="of a map: geojson, csv, gpkg, lanelet2, dxf; of a calibration: camera_info, static_transform, "
        "urdf, kalibr, opencv; may be repeated",
    )
    parser.add_argument(
        "--output", type=Path, metavar="DIR", help="folder of the files (default: that of MAP)"
    )
    parser.add_argument(
        "--projector",
        metavar="NAME",
        help="of lanelet2: Local, LocalCartesian or MGRS (default: LocalCartesian for a map with an origin, "
        "else Local)",
    )
    parsed = parser.parse_args(arguments)
    log, handler = logging.getLogger("v2hdm"), logging.StreamHandler()
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    folder = parsed.output or parsed.source.parent
    try:
        export = _export_calibration if parsed.source.suffix.lower() in (".yaml", ".yml") else _export_map
        for path in export(parsed, folder):
            print(path)
    except BrokenPipeError:  # the reader of our output has had enough
        raise
    except OSError as error:
        raise MapFileError(
            f"{error.filename}: cannot be written ({error.strerror}); set another --output"
        ) from None
    finally:
        log.removeHandler(handler)


def _export_map(parsed: argparse.Namespace, folder: Path) -> list[Path]:
    from v2hdm.io.maps.formats import FORMATS, check_formats, write_map
    from v2hdm.io.maps.reading import read_map

    check_formats(parsed.format, "--format")
    name = parsed.source.stem
    if parsed.source.resolve() in [
        (folder / FORMATS[one].file.format(name=name)).resolve() for one in parsed.format
    ]:
        raise ConfigError(f"{parsed.source} would be written over: set another --output or --format")
    hd_map, verdict = read_map(parsed.source)
    return write_map(hd_map, folder, name, parsed.format, verdict, parsed.projector)


def _export_calibration(parsed: argparse.Namespace, folder: Path) -> list[Path]:
    from v2hdm.io.calibration.reading import read_calibration, read_provenance
    from v2hdm.io.calibration.writing import CALIBRATION_FORMATS, write_calibration_as

    for name in parsed.format:
        if name not in CALIBRATION_FORMATS:
            raise ConfigError(
                f"--format: unknown format '{name}' of a calibration; "
                f"choose from: {', '.join(CALIBRATION_FORMATS)}"
            )
    calibration, about = read_calibration(parsed.source), read_provenance(parsed.source)
    return [
        write_calibration_as(name, calibration, about, folder, calibration.info.name)
        for name in parsed.format
    ]

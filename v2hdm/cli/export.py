"""The door to other tools: ``python -m v2hdm.cli.export MAP --format gpkg`` converts a map or a calibration.

A map is ``map.geojson`` or ``map.gpkg`` as a run wrote it or a GIS has edited it, a calibration a
``calibration_<camera>.yaml``. One line a file that was written. docs/exports.md describes the formats.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.door import ShowVersion, answer_signals, open_door

_INTERRUPTED = "interrupted; files that were named are whole"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the door; 0, or 2 with one line on stderr for what a user must mend."""
    parsed = _parser().parse_args(arguments)
    return open_door("v2hdm.cli.export", None, _INTERRUPTED, lambda: _export(parsed))


def _export(parsed: argparse.Namespace) -> None:
    from v2hdm.errors import MapFileError

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
    from v2hdm.errors import ConfigError
    from v2hdm.io.maps import FORMATS, check_formats, read_map, write_map

    check_formats(parsed.format, "--format")
    name = parsed.source.stem
    if parsed.source.resolve() in [
        (folder / FORMATS[one].file.format(name=name)).resolve() for one in parsed.format
    ]:
        raise ConfigError(f"{parsed.source} would be written over: set another --output or --format")
    hd_map, verdict = read_map(parsed.source)
    return write_map(hd_map, folder, name, parsed.format, verdict, parsed.projector)


def _export_calibration(parsed: argparse.Namespace, folder: Path) -> list[Path]:
    from v2hdm.errors import ConfigError
    from v2hdm.io.calibration import (
        CALIBRATION_FORMATS,
        read_calibration,
        read_provenance,
        write_calibration_as,
    )

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


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m v2hdm.cli.export", description=__doc__.split("\n\n")[0])
    parser.add_argument("--version", action=ShowVersion)
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
    return parser


if __name__ == "__main__":
    answer_signals()
    sys.exit(main())

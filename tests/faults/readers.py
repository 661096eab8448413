"""The readers of files from strangers, each with a writer of a sound file."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.drive.example import camera_info, looking_forward, make_map
from tests.faults.cases import picture
from v2hdm.detection.frames import read_bgr
from v2hdm.errors import V2hdmError
from v2hdm.io.calibration.reading import read_calibration, read_camera_info
from v2hdm.io.calibration.writing import write_calibration, write_camera_info
from v2hdm.io.importers.nmea import read_nmea
from v2hdm.io.importers.readings import read_table
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.maps.geopackage import write_geopackage
from v2hdm.io.maps.reading import read_geojson, read_geopackage
from v2hdm.io.trajectory import read_image_list, read_tum
from v2hdm.records import Calibration


def refusal(read: Callable[[], object], error: type[V2hdmError]) -> str | None:
    """What a reader says of what it refuses; None where it reads."""
    try:
        read()
    except error as refused:
        return str(refused)
    return None


def tum(path: Path) -> None:
    path.write_text("".join(f"{100 + n} {n}.5 0 0 0 0 0 1\n" for n in range(4)))


def image_list(path: Path) -> None:
    path.write_text("# timestamp filename\n100.0 a.jpg\n101.0 b.jpg\n")


def table(path: Path) -> None:
    path.write_text("stamp_s,x_m,y_m,yaw_deg,quality\n100.0,1,2,3,4\n100.5,2,2,3,4\n")


def nmea(path: Path) -> None:
    path.write_text(
        "$GPGGA,123519,4807.038,N,01131.000,E,4,08,0.9,545.4,M,46.9,M,,*42\n$GPHDT,274.07,T*03\n"
        "$GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A\n"
    )


def calibration(path: Path) -> None:
    write_calibration(Calibration(camera_info(), looking_forward(), np.eye(6) * 1e-4), path)


def geopackage(path: Path) -> None:
    write_geopackage(make_map(), path.with_suffix(".gpkg"))
    path.with_suffix(".gpkg").rename(path)


READERS: dict[str, tuple[Callable[[Path], Any], Callable[[Path], Any]]] = {
    "tum": (tum, read_tum),
    "image list": (image_list, read_image_list),
    "table": (table, lambda path: read_table(path, {}, path.parent, "here")),
    "nmea": (nmea, lambda path: read_nmea(path, {}, path.parent, "here")),
    "camera_info": (lambda path: write_camera_info(camera_info(), path), read_camera_info),
    "calibration": (calibration, read_calibration),
    "map": (lambda path: write_geojson(make_map(), path), read_geojson),
    "geopackage": (geopackage, read_geopackage),
    "jpeg": (lambda path: path.write_bytes(picture()), read_bgr),
    "png": (lambda path: path.write_bytes(picture(".png")), read_bgr),
    "tiff": (lambda path: path.write_bytes(picture(".tiff")), read_bgr),
    "bmp": (lambda path: path.write_bytes(picture(".bmp")), read_bgr),
    "webp": (lambda path: path.write_bytes(picture(".webp")), read_bgr),
}

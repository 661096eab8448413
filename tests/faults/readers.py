"""The readers of files from strangers, each with a writer of a sound file."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.drive.example import camera_info, looking_forward, make_drive, make_map
from tests.faults.pictures import picture
from v2hdm.calibration.points import read_points
from v2hdm.detection.frames import read_bgr
from v2hdm.errors import V2hdmError
from v2hdm.io.calibration.reading import read_calibration, read_camera_info
from v2hdm.io.calibration.writing import write_calibration, write_camera_info
from v2hdm.io.drive import read_drive
from v2hdm.io.image_lists import read_image_list
from v2hdm.io.importers.nmea import read_nmea
from v2hdm.io.importers.readings import read_table
from v2hdm.io.importers.rtklib import read_pos
from v2hdm.io.importers.sbet import read_sbet
from v2hdm.io.importers.ubx import read_ubx
from v2hdm.io.maps.corrections import Correction, read_corrections, write_corrections
from v2hdm.io.maps.evidence import COLUMNS, read_exclusions, read_residuals, write_exclusions
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.maps.geopackage import write_geopackage
from v2hdm.io.maps.reading import read_geojson, read_geopackage
from v2hdm.io.metrics import read_metrics
from v2hdm.io.trajectory import read_tum
from v2hdm.records import Calibration, Exclusion


def refusal(read: Callable[[], object], error: type[V2hdmError]) -> str | None:
    """A reader's sentence of refusal; None where it reads."""
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


def sbet(path: Path) -> None:
    table = np.zeros((4, 17))
    table[:, 0] = 4e5 + np.arange(4)
    table[:, 1:4] = 0.9, 0.1, 45.0
    table.tofile(path)
    rms = np.full((4, 10), 0.5)
    rms[:, 0] = table[:, 0]
    rms.tofile(path.with_name(path.name + ".rms"))


def pos(path: Path) -> None:
    path.write_text(
        "% ref pos   : 53.5 9.9 44.0\n% (e/n/u-baseline=WGS84,Q=1:fix,2:float)\n"
        "%  GPST e-baseline(m) n-baseline(m) u-baseline(m) Q ns sde(m) sdn(m) sdu(m) sden(m) sdnu(m)\n"
        "2024/05/17 08:30:30.000 1.5 2.5 0.5 1 12 0.01 0.01 0.02 -0.001 0.001 0.0\n"
        "2314 462631.000 2.5 2.5 0.5 2 12 0.01 0.01 0.02 -0.001 0.001 0.0\n"
    )


def ubx(path: Path) -> None:
    path.write_text(
        "<UBX(NAV-PVT, iTOW=08:29:53, year=2024, month=5, day=17, hour=8, min=29, second=53, validDate=1, "
        "validTime=1, nano=-1234, fixType=3, gnssFixOk=1, lon=9.02, lat=53.5, height=45123, hAcc=14)>\n"
        '{"identity": "NAV-ATT", "payload": {"iTOW": "08:29:53.100000", "roll": 1.2, "pitch": -0.5, '
        '"heading": 91.2, "accRoll": 0.1, "accPitch": 0.2, "accHeading": 0.3}}\n'
    )


def calibration(path: Path) -> None:
    write_calibration(Calibration(camera_info(), looking_forward(), np.eye(6) * 1e-4), path)


def geopackage(path: Path) -> None:
    write_geopackage(make_map(), path.with_suffix(".gpkg"))
    path.with_suffix(".gpkg").rename(path)


def metrics(path: Path) -> None:
    finding = {"check": "clock", "status": "PASS", "value": 1.5, "limit": None, "says": "x", "about": "poses"}
    change = {"id": 1, "class": "diamond", "fate": "gone", "shift_m": None, "shift_sigma_m": [0.1, 0.1]}
    change |= {"probability": 0.9, "views": 3, "found": 2, "before_map": [[0, 1.5]], "after_map": None}
    content = {
        "name": "a", "drive": {"name": "a", "paths": ["a"], "images": 2}, "changes": {"listed": [change]},
        "verdict": {"status": "PASS", "headline": "PASS: x", "findings": [finding]},
        "results": {"front": {"Opt": {"markings": 1, "lanes": {"length_m": 2.0}}}}, "seconds": {"map": 1.0},
    }  # fmt: skip
    path.write_text(json.dumps(content))
    path.with_name("metrics.json").symlink_to(path)


def corrections(path: Path) -> None:
    corners = [[0.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, 0.0]]
    moved = Correction(
        says="corrected", kind="diamond", outline_map=corners, marking=3, moved={2: [0.0, 1.1]}
    )
    write_corrections([moved], "outputs/a", path)


def exclusions(path: Path) -> None:
    write_exclusions([Exclusion("diamond", np.zeros(2), 3, "too few sightings", "front")], path, None, None)


def residuals(path: Path) -> None:
    rows = ["a/1.jpg,front,100.000000,1,2,1,10.5,20.5,0.1,-0.2,1.5", "a/2.jpg,front,101.0,,1,0,1,2,3,4,5"]
    path.write_text("\n".join([",".join(COLUMNS), *rows]) + "\n")


def drive_yaml(path: Path) -> None:
    make_drive(path.parent / "drive")
    (path.parent / "drive" / "drive.yaml").rename(path)
    (path.parent / "drive" / "drive.yaml").symlink_to(path)


def survey_points(path: Path) -> None:
    path.write_text(
        "u,v,x,y,name\n" + "".join(f"{100 + 50 * n},{300 + n * n},{5 + n},{n % 3},p{n}\n" for n in range(5))
    )


READERS: dict[str, tuple[Callable[[Path], Any], Callable[[Path], Any]]] = {
    "tum": (tum, read_tum),
    "image list": (image_list, read_image_list),
    "table": (table, lambda path: read_table(path, {}, path.parent, "here")),
    "sbet": (sbet, lambda path: read_sbet(path, {"rms": path.name + ".rms"}, path.parent, "here", 1.7e9)),
    "pos": (pos, lambda path: read_pos(path, {}, path.parent, "here")),
    "ubx": (ubx, lambda path: read_ubx(path, {}, path.parent, "here")),
    "nmea": (nmea, lambda path: read_nmea(path, {}, path.parent, "here")),
    "camera_info": (lambda path: write_camera_info(camera_info(), path), read_camera_info),
    "calibration": (calibration, read_calibration),
    "map": (lambda path: write_geojson(make_map(), path), read_geojson),
    "geopackage": (geopackage, read_geopackage),
    "metrics": (metrics, lambda path: read_metrics(path.parent)),
    "corrections": (corrections, read_corrections),
    "exclusions": (exclusions, read_exclusions),
    "residuals": (residuals, read_residuals),
    "drive": (drive_yaml, lambda path: read_drive(path.parent / "drive")),
    "points": (survey_points, read_points),
    "jpeg": (lambda path: path.write_bytes(picture()), read_bgr),
    "png": (lambda path: path.write_bytes(picture(".png")), read_bgr),
    "tiff": (lambda path: path.write_bytes(picture(".tiff")), read_bgr),
    "bmp": (lambda path: path.write_bytes(picture(".bmp")), read_bgr),
    "webp": (lambda path: path.write_bytes(picture(".webp")), read_bgr),
}

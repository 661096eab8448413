"""Bad inputs that are small: numbers that no sensor, survey, map or setting has, in tables of each format."""

import json
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import yaml

from tests.calibration.site import INFO, clicked, write_table
from tests.drive.bags import Messages, StoragePlugin, messages_of, mountings, topics_for, write_ros2
from tests.drive.example import make_drive, make_map
from tests.faults.judge import Case
from tests.faults.making import CHECK, CHECKED, Change, checked, described, drive, write, write_example
from v2hdm.io.calibration.writing import write_camera_info
from v2hdm.io.maps.geojson import write_geojson

LONG = "9" * 200_000
NO_SIGMAS = ("-1", "-0.01", "-1e-9", "-inf")
NO_NUMBERS = (*NO_SIGMAS, "x", "0x10", "1,5", "--1", "1e", LONG)


def small() -> Iterator[Case]:
    """All of them."""
    for part in (_routes, _logs, _urls, _maps, _points, _options, _bags):
        yield from part()


def entries(**content: object) -> Change:
    """Put entries into ``drive.yaml``."""
    return described(lambda entries_of_drive: entries_of_drive.update(content))


ROUTE = {"stamp_s": "100", "x_m": "0", "y_m": "0", "yaw_deg": "0", "sigma_m": ".02"}
ROUTE |= {"heading_sigma_deg": ".1"}
ROUTES = [
    *(("sigma_m", cell, "sigma_m|cells under|not a table") for cell in NO_NUMBERS),
    *(("heading_sigma_deg", cell, "heading_sigma_deg|cells under|not a table") for cell in NO_NUMBERS),
    *(("x_m", cell, "x_m|cells under|not a table") for cell in ("x", LONG)),
    *(("stamp_s", cell, "stamp_s|cells under|not a table") for cell in ("x", LONG)),
    *(("yaw_deg", cell, "yaw_deg|cells under|not a table") for cell in ("x", LONG)),
    *(("sigma_m", cell, "no position is known") for cell in ("inf", "1e300", "0.2")),
]  # fmt: skip
OPEN = {"x_m": "positions that are not numbers", "stamp_s": "lines without a time"}
OPEN |= {"yaw_deg": "headings that are not numbers"}


def _routes() -> Iterator[Case]:
    for column, says in OPEN.items():
        for cell in ("nan", "inf", ""):
            rows = [ROUTE | {"stamp_s": f"{100 + k / 10:.1f}", "x_m": str(k)} for k in range(20)]
            rows[-1][column] = cell
            text = "\n".join(",".join(row.values()) for row in (dict(zip(ROUTE, ROUTE, strict=True)), *rows))
            changes = entries(poses={"csv": "route.csv"}), write("route.csv", text)
            warning = f"left out 1 of 20 {says}"
            more = {"code": 0, "leaves": "/out(/|$)", "tells": True}
            yield checked(f"route: {column} {cell[:9]}", warning, *changes, **more)
    for column, cell, says in ROUTES:
        lines = [ROUTE | {"stamp_s": f"{100 + k / 10:.1f}", "x_m": str(k)} for k in range(20)]
        wrong = range(20) if "known" in says else [19]
        rows = [line | ({column: cell} if k in wrong else {}) for k, line in enumerate(lines)]
        text = "\n".join(",".join(row.values()) for row in (dict(zip(ROUTE, ROUTE, strict=True)), *rows))
        yield checked(
            f"route: {column} {cell[:9]}", says, entries(poses={"csv": "route.csv"}), write("route.csv", text)
        )


GST = "GNGST,120000.00,1.0,,,,{},{},0.02"
LOGS = {
    "empty": "",
    "no sentence": "words\n" * 9,
    "sentences without checksums that are cut off": "$GNGGA,1200\n" * 9,
    "wrong checksums": "$GNGGA,120000.00,5330.0,N,00957.0,E,4,12,0.8,4.0,M,40.5,M,1.0,0000*00\n" * 9,
    "negative sigmas": "".join(f"${GST.format(sigma, sigma)}\n" for sigma in NO_SIGMAS),
    "sigmas that are not known": "".join(f"${GST.format(sigma, sigma)}\n" for sigma in ("nan", "", "x")),
    "a sentence of 200000 digits": f"${GST.format(LONG, LONG)}\n",
    "bytes that do not show": "\x1b[2J\x07$\x1b\n" * 9,
}


def _logs() -> Iterator[Case]:
    for name, text in LOGS.items():
        poses = {"nmea": "log.nmea", "lever_arm_m": [0, 0, 0], "date": "2024-05-17"}
        says = "no GGA sentence|sentences are damaged"
        yield checked(f"NMEA log: {name}", says, entries(poses=poses), write("log.nmea", text))


URLS = ("s3://bucket/x", "memory://bucket/x", "http://127.0.0.1:9/x", "file:///etc/hosts")


def _urls() -> Iterator[Case]:
    """Places that a drive names: paths, never URLs."""
    for url in URLS:
        front = {
            "roi_vehicle": [[3, -3], [9, -3], [9, 3], [3, 3]],
            "mounting": {"height_m": 2, "pitch_deg": 0},
        }
        camera = {"images": "front/images.txt", "camera_info": "front/camera_info.yaml"}
        for key, value in {"images": url, "camera_info": url, "video": url}.items():
            named = {"images": {"video": value, "start_s": 0}} if key == "video" else {key: value}
            changed = entries(cameras={"front": front | camera | named})
            yield checked(f"{key} at {url}", "no such|not readable|cannot be read|missing", changed)
        for key in ("poses", "truth"):
            yield checked(f"{key} at {url}", "no such|cannot be read|not a", entries(**{key: url}))


def _maps() -> Iterator[Case]:
    """Sigmas, shares and accuracies of a map, of the first feature that may have them."""
    wrong_numbers: tuple[object, ...] = (
        -1,
        -1e-9,
        "x",
        True,
        [],
        {},
        [[1]],
        10**400,
        float("nan"),
        float("-inf"),
    )
    wrong_lists: tuple[object, ...] = (
        [-0.01] * 4,
        [0.01] * 3,
        ["x"] * 4,
        [float("nan")] * 4,
        7,
        "x",
        {},
        [[1]] * 4,
    )
    for key, values in {"relative_sigma_m": wrong_numbers, "heights_sigma_m": wrong_lists}.items():
        for value in values:
            yield _map_with(f"{key} {json.dumps(value)[:12]}", "Polygon", {key: value}, key)
    for value in ("D", "a", "", 1, True, [], ["A"], {}):
        yield _map_with(f"accuracy {json.dumps(value)}", "Polygon", {"accuracy": value}, "accuracy is")
    for value in (-1, "x", float("nan"), [1]):
        paint = {"paint_left": 0.5, "paint_left_sigma": value}
        yield _map_with(f"paint_left_sigma {value}", "Polygon", paint, "paint_left_sigma")
    for value in ([-1, 1, 1], [1, 1], "x", [float("inf")] * 3):
        yield _map_with(f"vertex_sigma_m {value}", "LineString", {"vertex_sigma_m": value}, "vertex_sigma_m")


def _map_with(name: str, shape: str, properties: dict[str, object], says: str) -> Case:
    def prepare(root: Path) -> None:
        write_geojson(make_map(), root / "map.geojson")
        content = json.loads((root / "map.geojson").read_text())
        feature = next(feature for feature in content["features"] if feature["geometry"]["type"] == shape)
        feature["properties"].update(properties)
        (root / "map.geojson").write_text(json.dumps(content))

    line = ("map.geojson", "--format", "csv", "--output", "there")
    return Case(f"map: {name}", "v2hdm export", line, prepare, says)


def _points() -> Iterator[Case]:
    """Many points, names that move a terminal's cursor, and errors that none has."""
    rng = np.random.default_rng(0)
    columns = rng.uniform(0, INFO.width - 1, 600), rng.uniform(0, INFO.height - 1, 600)
    places = rng.uniform(2, 30, 600), rng.uniform(-10, 10, 600)
    rows = "".join(f"{u:.2f},{v:.2f},{x:.3f},{y:.3f}\n" for u, v, x, y in zip(*columns, *places, strict=True))
    yield _calibrated("600 random points", f"u,v,x,y\n{rows}", "pixels and places are unrelated")
    for name in ("\x1b]0;x\x07", "\x9b2J", "\u202eP", "\u2028P", "\x08\x08", "\x7f", "P" * 100_000):
        text = f"name,u,v,x,y\n{name},-9,2,3,4\n" + "a,1,1,9,1\n" * 5
        yield _calibrated(f"the name {name[:9]!r}", text, "outside|lies|cells under")
    for option in ("--pixel-sigma", "--survey-sigma"):
        for value in ("-1", "nan", "inf", "-inf", "1e999"):
            yield _calibrated(f"{option} {value}", None, f"{option} ", f"{option}={value}")


def _calibrated(name: str, text: str | None, says: str, *options: str) -> Case:
    def prepare(root: Path) -> None:
        write_camera_info(INFO, root / "camera_info.yaml")
        write_table(root, *clicked(seed=1))
        if text is not None:
            (root / "points.csv").write_text(text)

    line = ("points.csv", "--intrinsics", "camera_info.yaml", "--output", "out", *options)
    return Case(f"calibrate: {name}", "v2hdm calibrate points", line, prepare, says)


SIGMAS = (
    "known_sizes.sigma_m", "survey.sigma_m", "survey.reach_m", "loss_scale",
)  # fmt: skip
OPTIONS = [
    *(f"mapping.{key}={value}" for key in SIGMAS for value in ("0", "-1", "nan", "inf")),
    *(
        f"mapping.survey.points=[{{id:a,position_map:[1,2],sigma_m:[{sigma},0.01]}}]"
        for sigma in ("0", "-1", "nan")
    ),
]


def _options() -> Iterator[Case]:
    for line in OPTIONS:
        words, says = ("drive.path=drive", "workers=1", line), line.split("=")[0].rpartition(".")[2]
        yield Case(f"map {line}", "v2hdm map", words, drive(), says)


@lru_cache
def _messages() -> Messages:
    with TemporaryDirectory() as folder:
        make_drive(Path(folder) / "drive")
        return messages_of(Path(folder) / "drive", mounted=mountings())


def _bag(name: str, says: str, change: Callable[[object], object], topic: str) -> Case:
    """A bag whose last message of a topic is changed."""

    def prepare(root: Path) -> None:
        messages = replace(_messages(), rows=list(_messages().rows))
        number = max(n for n, row in enumerate(messages.rows) if row[1] == topic)
        messages.rows[number] = (*messages.rows[number][:2], change(messages.rows[number][2]))
        _described(root, messages)

    return Case(f"bag: {name}", CHECK, CHECKED, prepare, says, leaves="^work/here/cache(/|$)")


def _described(root: Path, messages: Messages) -> Path:
    write_example(root / "drive")
    bag = write_ros2(root / "bag", messages, StoragePlugin.SQLITE3)
    (root / "drive" / "drive.yaml").write_text(yaml.safe_dump(topics_for(root / "drive", bag)))
    return next(bag.glob("*.db3"))


STAMPS = ("'noon'", "X'ff'")


def _bags() -> Iterator[Case]:
    info, other = "/sensing/front/camera_info", r"message \d+ has another lens than the first"
    for name, change in {
        "another focal length": lambda info: replace(info, k=info.k * [1.5, 1, 1, 1, 1.5, 1, 1, 1, 1]),
        "a focal length that is not finite": lambda info: replace(info, k=info.k * np.nan),
        "another size": lambda info: replace(info, width=2 * info.width),
        "another distortion": lambda info: replace(info, d=info.d + 0.1),
        "no distortion": lambda info: replace(info, d=info.d[:0]),
    }.items():
        yield _bag(f"{name} at the end", other, change, info)
    for at in (0, 7, 35):
        for value in (-0.5, -1e-9, -np.inf):

            def turn(message: object, at: int = at, value: float = value) -> object:
                covariance = message.pose.covariance.copy()  # type: ignore[attr-defined]
                covariance[at] = value
                return replace(message, pose=replace(message.pose, covariance=covariance))  # type: ignore

            yield _bag(f"covariance {value} at {at}", "a negative variance", turn, "/odom")
    for value in STAMPS:

        def prepare(root: Path, value: str = value) -> None:
            with closing(sqlite3.connect(_described(root, _messages()))) as data:
                data.execute(f"UPDATE messages SET timestamp = {value}")
                data.commit()

        says = "not readable as a bag"
        yield Case(f"bag: stamps {value}", CHECK, CHECKED, prepare, says, leaves="^work/here/cache(/|$)")

"""Bad inputs of whose a file is: results of other commands, files of the user's, links, and GeoPackages."""

import os
import shutil
import sqlite3
import struct
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

from tests.calibration.site import INFO, clicked, mounting, write_table
from tests.docs.blocks import ROOT
from tests.drive.example import make_map
from tests.faults.again import list_again
from tests.faults.judge import Case, Prepare
from tests.faults.making import both, write, write_example
from v2hdm.io.calibration.reading import read_provenance
from v2hdm.io.calibration.writing import (
    CALIBRATION_FORMATS,
    write_calibration,
    write_calibration_as,
    write_camera_info,
)
from v2hdm.io.maps.formats import FORMATS, write_map
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.records import Calibration, CameraFrames
from v2hdm.store.results import listed_files, result_folder

COMMANDS = {
    "v2hdm check": "drive --no-ground --workers 1 --output out",
    "v2hdm calibrate ground": "drive --workers 1 --output out",
    "v2hdm calibrate points": "points.csv --intrinsics camera_info.yaml --output out",
    "v2hdm localize": "map.geojson drive --workers 1 --output out",
    "v2hdm map": "drive.path=drive output=. name=out workers=1",
    "v2hdm compare": "map.geojson map.geojson --output out",
    "v2hdm benchmark make": "streets out --workers 1",
}
"""Each makes a result in the folder ``out``."""

MAKERS = {
    "the same of another drive": "{command} of /data/monday",
    "a map": "v2hdm map of /data/monday",
    "a check": "v2hdm check of /data/monday",
    "an experiment": "v2hdm experiment",
    "exports": "v2hdm export of /data/map.geojson",
    "drawings": "v2hdm detect of /data/images",
    "an earlier version": "",
}


def owners() -> Iterator[Case]:
    """Outputs onto what somebody else has made, or the command reads."""
    for command, line in COMMANDS.items():
        for name, maker in MAKERS.items():
            maker_of_command = maker.format(command=command)
            prepare = _site(
                lambda root, maker_of_command=maker_of_command: _result(root / "out", maker_of_command)
            )
            says = "holds a result of .*: move it"
            yield Case(f"{command} over the result of {name}", command, line.split(), prepare, says)
    line = "out/map.geojson drive --workers 1 --output out"
    reads = _site(lambda root: _result(root / "out", "v2hdm map of drive"))
    yield Case("localize over the map that it reads", "v2hdm localize", line.split(), reads, "move it")
    for base in ("out/map.geojson", "out", "linked.geojson"):
        words = (*COMMANDS["v2hdm map"].split(), f"map.base={base}")
        yield Case(f"map over its base {base}", "v2hdm map", words, _site(_own_base), "one of the inputs")
    for folder, way, says in WAYS:
        line = f"road.xodr {folder} --way {way} --workers 1"
        prepare = _site(_layout_beside_a_result)
        yield Case(f"a benchmark: {line}", "v2hdm benchmark make", line.split(), prepare, says)
    for file, prepare, words in _exports():
        for name, harm in HARMS.items():
            harmed = both(prepare, lambda root, file=file, harm=harm: harm(root / file))
            says, case = "move it, or give another --output", f"export onto {name}: {words}"
            yield Case(case, "v2hdm export", words.split(), harmed, says)


WAYS = (
    ("drive", "drive/poses.tum", "holds files that V2HDM did not write"),
    ("out", "out/trajectory.tum", "holds a result of .*: move it"),
    ("way.tum", "way.tum", "is a file"),
)
"""Folders for a benchmark's drive that hold, or are, the way it is made from, and the refusals."""

CIRCLES = (
    "check circle --output out", "check drive --no-ground --workers 1 --output circle",
    "calibrate points circle --intrinsics camera_info.yaml --output out",
    "calibrate points points.csv --intrinsics circle --output out",
    "calibrate points points.csv --intrinsics camera_info.yaml --output circle",
    "calibrate ground circle --output out", "calibrate compare circle calibration_front.yaml",
    "compare circle map.geojson", "compare map.geojson circle",
    "compare map.geojson map.geojson --output circle",
    "benchmark make streets circle", "benchmark make streets made --cache circle",
    "benchmark score circle streets",
    "benchmark make road.xodr made --way circle", "benchmark score map.geojson road.xodr --way circle",
    "benchmark make circle.xodr made --way way.tum", "benchmark score map.geojson circle.xodr --way way.tum",
    "localize circle drive --output out", "localize map.geojson circle --output out",
    "map drive.path=circle output=. name=out", "map drive.path=drive output=circle name=out workers=1",
    "report circle", "view circle", "labels circle", "mosaic circle",
    "export circle --format csv", "export circle/map.geojson --format csv",
    "export map.geojson --format csv --output circle", "export map.geojson --format csv --output circle/x",
    "detect circle", "detect drive/front/images/000000.jpg --output circle",
    "detect drive/front/images/000000.jpg --draw circle", "detect drive --model circle",
    "cache prune --gb 0 --cache circle",
)  # fmt: skip
"""Each is given a link that leads to itself."""


def circles() -> Iterator[Case]:
    """A link in a circle in the place of every input and output."""
    for line in CIRCLES:
        words = line.split()
        door = f"v2hdm {' '.join(words[:2] if words[0] in ('calibrate', 'benchmark') else words[:1])}"
        prepare = _site(_circle)
        yield Case(f"a circle: {line}", door, words[len(door.split()) - 1 :], prepare, "circle|Symlink loop")


def _circle(root: Path) -> None:
    _result(root / "out", "v2hdm map of drive")
    _layout(root)
    for name in ("circle", "circle.xodr"):
        (root / name).symlink_to(name)


def _layout_beside_a_result(root: Path) -> None:
    _layout(root)
    _result(root / "out", "v2hdm map of drive")
    shutil.copy(root / "way.tum", root / "out" / "trajectory.tum")


def _layout(root: Path) -> None:
    """The shipped road, and a way of 30 m along its right lane."""
    shutil.copy(ROOT / "conf" / "benchmark" / "quay.xodr", root / "road.xodr")
    poses = [f"{0.1 * k:.1f} {0.5 * k:.1f} -1.75 0 0 0 0 1" for k in range(60)]
    (root / "way.tum").write_text("\n".join(poses) + "\n")


def _site(more: Callable[[Path], None]) -> Prepare:
    def prepare(root: Path) -> None:
        write_example(root / "drive")
        write_geojson(make_map(), root / "map.geojson")
        write_camera_info(INFO, root / "camera_info.yaml")
        write_table(root, *clicked(seed=1))
        _calibrated(root)
        more(root)

    return prepare


def _calibrated(folder: Path) -> None:
    write_calibration(Calibration(INFO, mounting()), folder / "calibration_front.yaml")


def _result(folder: Path, maker_of_result: str) -> None:
    with result_folder(folder, maker=maker_of_result) as partial:
        write_geojson(make_map(), partial / "map.geojson")
        _calibrated(partial)


def _own_base(root: Path) -> None:
    _result(root / "out", f"v2hdm map of {(root / 'drive').resolve()}")
    (root / "linked.geojson").symlink_to("out/map.geojson")


def _exports() -> Iterator[tuple[str, Prepare, str]]:
    """A file of each format, what writes it as the command does, and the command's line."""
    for name in FORMATS:
        source = "map.gpkg" if name == "geojson" else "map.geojson"

        def put_map(root: Path, name: str = name, source: str = source) -> None:
            write_map(make_map(), root, "map", [source.rpartition(".")[2]])
            with listed_files(root / "there", "--output", f"v2hdm export of ../{source}"):
                write_map(make_map(), root / "there", "map", [name])

        line = f"{source} --format {name} --output there"
        yield f"there/{FORMATS[name].file.format(name='map')}", put_map, line
    for name, (ending, _) in CALIBRATION_FORMATS.items():

        def put(root: Path, name: str = name) -> None:
            frames = CameraFrames("base_link", "front_optical_frame")
            calibration = Calibration(INFO, mounting(), frames=frames)
            write_calibration(calibration, root / "c.yaml")
            with listed_files(root / "there", "--output", "v2hdm export of ../c.yaml"):
                about = read_provenance(root / "c.yaml")
                write_calibration_as(name, calibration, about, root / "there", INFO.name)

        yield f"there/{INFO.name}_{ending}", put, f"c.yaml --format {name} --output there"


def _edited(path: Path) -> None:
    path.write_bytes(path.read_bytes() + b"edited")


def _replaced(path: Path) -> None:
    path.unlink()
    path.write_text("of the user's")


def _linked(path: Path) -> None:
    path.rename(path.with_name("elsewhere"))
    path.symlink_to("elsewhere")


def _dangling(path: Path) -> None:
    path.unlink()
    path.symlink_to("nowhere")


def _linked_folder(path: Path) -> None:
    path.parent.rename(path.parent.with_name("elsewhere"))
    path.parent.symlink_to("elsewhere")
    _edited(path)


def _twin(path: Path) -> None:
    """Another name of a file that was edited since."""
    os.link(path, path.with_name("twin"))
    _edited(path)


def _listless(path: Path) -> None:
    """The folder of an earlier version, or of the user, which no list names."""
    for folder in path.parents:
        (folder / ".v2hdm-results.jsonl").unlink(missing_ok=True)


HARMS: dict[str, Callable[[Path], None]] = {
    "an edited file": _edited,
    "a file of the user's": _replaced,
    "a link": _linked,
    "a link to nowhere": _dangling,
    "an edited file in a linked folder": _linked_folder,
    "a file with two names": _twin,
    "a file on no list": _listless,
}


_VRT = (
    '<OGRVRTDataSource><OGRVRTLayer name="v2hdm"><SrcDataSource>{}</SrcDataSource></OGRVRTLayer>'
    "</OGRVRTDataSource>"
)
OTHERS: dict[str, bytes] = {
    "a VRT of a file": _VRT.format("/etc/hosts").encode(),
    "a VRT of a host": _VRT.format("/vsicurl/http://127.0.0.1:9/a.geojson").encode(),
    "a VRT of itself": _VRT.format("map.gpkg").encode(),
    "a VRT behind SQLite's name": b"SQLite format 3\0" + _VRT.format("/etc/hosts").encode(),
    "a GeoJSON": b'{"type": "FeatureCollection", "features": []}',
    "a CSV": b"WKT,name\n",
    "a zip": b"PK\3\4" + bytes(60),
    "a GDALG pipeline": b'{"type": "gdal_streamed_alg", "command_line": "gdal vector read /etc/hosts"}',
    "nothing": b"",
    "SQLite's name alone": b"SQLite format 3\0",
    "SQLite's name and zeros": b"SQLite format 3\0" + bytes(4080),
}
_ENDLESS = "WITH RECURSIVE n(geom) AS (SELECT 0 UNION ALL SELECT geom + 1 FROM n) SELECT * FROM n"
SQL: dict[str, tuple[str, str]] = {
    "an endless view": (f"DROP TABLE markings; CREATE VIEW markings AS {_ENDLESS}", "no plain table"),
    "an endless view about it": (f"DROP TABLE v2hdm; CREATE VIEW v2hdm AS {_ENDLESS}", "no plain table"),
    "a virtual table": ("DROP TABLE markings; CREATE VIRTUAL TABLE markings USING fts5(a)", "no plain table"),
    "another virtual table": (
        "DROP TABLE markings; CREATE VIRTUAL TABLE markings USING rtree(a, b, c)", "no plain table"
    ),
    "a computed column": ("ALTER TABLE markings ADD x AS (zeroblob(1000000000))", "no plain table"),
    "no table of markings": ("DROP TABLE markings", "no plain table"),
    "no table about it": ("DROP TABLE v2hdm", "no plain table"),
    "a text for a geometry": ("UPDATE markings SET geom = 'a'", "is damaged"),
    "a number for a geometry": ("UPDATE markings SET geom = 7", "is damaged"),
    "a short geometry": ("UPDATE markings SET geom = X'47500001'", "is damaged"),
    "a geometry of zeros": ("UPDATE markings SET geom = zeroblob(200)", "is not one that maps have"),
    "a text for a number": ("UPDATE markings SET sightings = 'many'", "sightings"),
    "a blob for a class": ("UPDATE markings SET class = X'ff00'", "class"),
    "text that is no UTF-8": ("UPDATE markings SET class = CAST(X'ff' AS TEXT)", "UTF-8|class"),
    "coordinates nested 3000 deep": (
        f"UPDATE markings SET corners_map = '{'[' * 3000}{']' * 3000}'", "nested deeper"
    ),
    "a name in its schema that is no UTF-8": (
        "PRAGMA writable_schema = ON; UPDATE sqlite_master SET name = CAST(X'ff' AS TEXT)", "utf-8"
    ),
    "an origin that is a list": ("UPDATE v2hdm SET origin = '[1]'", "origin"),
}  # fmt: skip
_POINT = struct.pack("<BIdd", 1, 1, 0.0, 0.0)
GEOMETRIES: dict[str, tuple[bytes, str]] = {
    "a point": (_POINT, "is not one that maps have"),
    "a Multi within a Multi, 200000 deep": (struct.pack("<BII", 1, 6, 1) * 200_000, "several parts"),
    "collections, 200000 deep": (struct.pack("<BII", 1, 7, 1) * 200_000, "is not one that maps have"),
    "4 billion polygons": (struct.pack("<BII", 1, 6, 2**32 - 1), "several parts"),
    "4 billion rings": (struct.pack("<BII", 1, 3, 2**32 - 1), "holes"),
    "4 billion points": (struct.pack("<BIII", 1, 3, 1, 2**32 - 1), "is damaged"),
    "a line of 4 billion points": (struct.pack("<BII", 1, 2, 2**32 - 1), "is damaged"),
    "an unknown kind": (struct.pack("<BII", 1, 2**32 - 1, 1), "is none|is damaged"),
    "not a number": (
        struct.pack("<BIII", 1, 3, 1, 5) + struct.pack("<10d", *[float("nan")] * 10), "not finite"
    ),
}  # fmt: skip


def geopackages() -> Iterator[Case]:
    """Files that end in .gpkg, and are something else, or compute, or never end."""
    line = ("map.gpkg", "--format", "csv", "--output", "there")
    for name, data in OTHERS.items():
        yield Case(
            f"geopackage: {name}", "v2hdm export", line, write("map.gpkg", data), "not a map written by v2hdm"
        )
    for name, (sql, says) in SQL.items():
        yield Case(f"geopackage: {name}", "v2hdm export", line, _executed(sql), says)
    many = "geopackage: one row many times"
    yield Case(many, "v2hdm export", line, _one_row_many_times, "more rows than bytes")
    again = both(_executed(""), lambda root: list_again(root / "map.gpkg", "markings"))
    yield Case("geopackage: all rows many times", "v2hdm export", line, again, "more rows than bytes")
    for name, (wkb, says) in GEOMETRIES.items():
        blob = b"GP\0\1" + bytes(4) + wkb
        prepare = _executed(f"UPDATE markings SET geom = X'{blob.hex()}'")
        yield Case(f"geopackage: {name}", "v2hdm export", line, prepare, says)


def _one_row_many_times(root: Path) -> None:
    """One row of 3000 bytes, to which all pointers of its page lead."""
    blob = "zeroblob(3000)"
    _executed(f"DELETE FROM markings WHERE rowid > 1; UPDATE markings SET class = {blob}; VACUUM")(root)
    path = root / "map.gpkg"
    with closing(sqlite3.connect(path)) as data:
        ((number,),) = data.execute("SELECT rootpage FROM sqlite_master WHERE name = 'markings'")
        ((size,),) = data.execute("PRAGMA page_size")
    content, at = bytearray(path.read_bytes()), (number - 1) * size
    kind, _, cells, begin, _ = struct.unpack_from(">BHHHB", content, at)
    assert (kind, cells) == (13, 1)  # a leaf of one cell
    struct.pack_into(">H", content, at + 3, 500)
    struct.pack_into(">500H", content, at + 8, *[begin] * 500)
    path.write_bytes(content)


def _executed(sql: str) -> Prepare:
    def prepare(root: Path) -> None:
        write_map(make_map(), root, "map", ["gpkg"])
        with closing(sqlite3.connect(root / "map.gpkg")) as data:
            triggers = data.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall()
            for (name,) in triggers:  # they call functions of GDAL's
                data.execute(f'DROP TRIGGER "{name}"')
            data.executescript(sql)
            data.commit()

    return prepare

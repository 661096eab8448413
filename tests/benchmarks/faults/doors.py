"""Every door that writes, on a small drive."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.benchmarks.faults.situations import Situation, calibrating
from tests.faults.judge import Case, Prepare
from tests.ports import short_port
from v2hdm.errors import DriveError
from v2hdm.executor import HERE
from v2hdm.io.image_lists import read_image_list, write_image_list
from v2hdm.simulate.port.drive import render_drive
from v2hdm.store.cache import DRIVES, LEFT, checked, code_key, items_of
from v2hdm.store.files import dump_yaml, load_yaml, replace_text
from v2hdm.store.folders import IN_USE, STAGES

IMAGES = 16
"""Images of the drive's one camera: enough for a map, few enough for a second or two a run."""

_FORMATS = "geojson,csv,gpkg,lanelet2,dxf"


def small_drive(scratch: Path, cameras: Sequence[str] = ("front",), images: int = IMAGES) -> Path:
    """A drive with so many images of each camera, rendered where it is not there yet."""
    rendered, folder = scratch / "rendered", scratch / f"drive-{'-'.join(cameras)}-{images}"
    if not (rendered / "drive.yaml").is_file():
        render_drive(short_port(), rendered, HERE, lambda finished, total: None)
    if not (folder / "drive.yaml").is_file():
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(rendered, folder, ignore=shutil.ignore_patterns("front", "rear", "drive.yaml"))
        for camera in cameras:
            (folder / camera / "images").mkdir(parents=True)
            shutil.copy(rendered / camera / "camera_info.yaml", folder / camera)
            stamp_s, names = read_image_list(rendered / camera / "images.txt")
            write_image_list(stamp_s[:images], names[:images], folder / camera / "images.txt")
            for path in sorted((rendered / camera / "images").iterdir())[:images]:
                shutil.copy(path, folder / camera / "images")
        content = load_yaml(rendered / "drive.yaml", DriveError)
        content["cameras"] = {name: content["cameras"][name] for name in cameras}
        replace_text(folder / "drive.yaml", dump_yaml(content))
    return folder


def map_arguments(drive: Path | str, *more: str) -> tuple[str, ...]:
    """Arguments of the mapping door, for that drive."""
    places = ("name=run", "workers=1", "output=out", "cache=cache")
    return (f"drive.path={drive}", *places, *more)


class Doors:
    """The situations.

    ``drive`` is what most of them are given, ``longer_drive`` has two cameras.

    Args:
        scratch: folder that keeps the drive and what was made of it.
    """

    def __init__(self, scratch: Path) -> None:
        self.drive = small_drive(scratch)
        self.longer_drive = small_drive(scratch, ("front", "rear"), 30)
        # Of other code, nothing in its cache would be taken.
        self._made = scratch / f"made-{code_key()[:12]}"

    def mapped(self) -> Path:
        """A folder with the result of the mapping door, ``out/run``, and its cache."""
        if not (self._made / "out" / "run" / "map.geojson").is_file():
            shutil.rmtree(self._made, ignore_errors=True)
            self._made.parent.mkdir(parents=True, exist_ok=True)
            folder = self._made.with_name("making")
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            # Through a process of its own, which may take as long as numba needs to compile.
            command = [sys.executable, "-m", "v2hdm", "map", *map_arguments(self.drive)]
            ended = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
            assert ended.returncode in (0, 3), ended.stderr
            folder.replace(self._made)
        return self._made

    def all(self) -> list[Situation]:
        """Every door that writes."""
        return [*self._maps(), *self._of_drives(), *self._of_results(), *self._of_files()]

    def given(self, *names: str) -> Prepare:
        """Copies folders of :meth:`mapped`."""
        return _Given(self.mapped(), names)

    def _maps(self) -> Iterator[Situation]:
        files = self.given("cache", "out/run")
        arguments = map_arguments(self.drive, "all_maps=true", f"export=[{_FORMATS}]")
        yield Situation(Case("map again, all files", "v2hdm map", arguments, files, ""))
        yield Situation(
            Case("map with a mosaic", "v2hdm map", (*map_arguments(self.drive), "mosaic=true"), files, "")
        )
        yield Situation(Case("map", "v2hdm map", map_arguments(self.drive), self.given(), ""))
        update = (*map_arguments(self.drive), "map.base=base/out/run", "name=update")
        update_files = _Given(self.mapped(), ("cache", "out/run"), ("out/run", "base/out/run"))
        yield Situation(Case("update", "v2hdm map", update, update_files, ""))

    def _of_drives(self) -> Iterator[Situation]:
        common = (str(self.drive), "--workers", "1", "--output", "out")
        yield Situation(Case("check", "v2hdm check", common, self.given(), ""))
        yield Situation(Case("extrinsic", "v2hdm calibrate ground", common, self.given(), ""))
        localised = ("out/run", str(self.drive), "--workers", "1", "--output", "where")
        yield Situation(Case("localize", "v2hdm localize", localised, self.given("out/run"), ""))
        port = f"+ports={{small: {{drive: {{path: {self.drive}}}}}}}"
        only = ("~run@ports.port1", "~run@ports.port2", "recipes=[ours]")
        experiment = (port, *only, "workers=1", "output=out", "cache=cache")
        yield Situation(
            Case("experiment", "v2hdm experiment", experiment, self.given("cache"), ""), grows=True
        )

    def _of_results(self) -> Iterator[Situation]:
        files = self.given("out/run")
        yield Situation(Case("mosaic", "v2hdm mosaic", ("out/run",), files, ""), grows=True)
        yield Situation(Case("report", "v2hdm report", ("out/run",), files, ""), grows=True)
        formats = [word for name in _FORMATS.split(",") for word in ("--format", name)]
        words = ("out/run/map.geojson", *formats, "--output", "there")
        yield Situation(Case("export", "v2hdm export", words, files, ""), grows=True)
        forms = ("camera_info", "static_transform", "urdf", "kalibr", "opencv")
        formats = [word for name in forms for word in ("--format", name)]
        words = ("out/run/calibration_front.yaml", *formats, "--output", "there")
        yield Situation(Case("export a calibration", "v2hdm export", words, files, ""), grows=True)

    def _of_files(self) -> Iterator[Situation]:
        detect = ("images", "--limit", "3", "--output", "found.jsonl", "--draw", "drawn")
        yield Situation(Case("detect", "v2hdm detect", detect, self.images, ""), grows=True)
        yield calibrating()
        tiny = ("net.widths=[16,16,16,16]", "net.dilations=[1]", "net.separable=true", "net.wide_kinds=false")
        data = (
            "width=64",
            "height=32",
            "render_width=80",
            "render_height=48",
            "views_per_render=2",
            "reservoir=4",
        )
        settings = ("steps=2", "batch=2", "data.workers=0", "validation.images=1", "output=out", "device=cpu")
        train = (*tiny, *(f"data.{setting}" for setting in data), *settings)
        yield Situation(Case("train", "train.__main__", train, lambda root: None, ""), grows=True)

    def images(self, root: Path) -> None:
        """Makes a folder of three images."""
        (root / "images").mkdir()
        for path in sorted(self.drive.rglob("*.jpg"))[:3]:
            shutil.copy(path, root / "images")


@dataclass(frozen=True)
class _Given:
    """Copies what was made: folders by their names, or from one place to another."""

    made: Path
    names: Sequence[str]
    moved: tuple[str, str] | None = None

    def __call__(self, root: Path) -> None:
        pairs = [(name, name) for name in self.names] + ([self.moved] if self.moved else [])
        for source, target in pairs:
            shutil.copytree(self.made / source, root / target)


def cache_defects(cache: Path) -> list[str]:
    """Defects of a cache after a run: damaged entries, and entries that were never finished."""
    items = items_of(cache)
    listed_paths = {item.path for item in items}
    strange = [
        path.name
        for path in (cache / STAGES).rglob("*")
        if path.is_file() and path not in listed_paths and IN_USE not in path.as_posix()
    ]
    left = [item.path.name for item in items if item.kind == LEFT]
    entries = [item.path for item in items if item.kind not in (DRIVES, LEFT)]
    damaged = [path.name for path in entries if checked(path.read_bytes()) is None]
    return [
        f"{what} in the cache: {names[:3]}"
        for what, names in (("half", left), ("damaged", damaged), ("strange", strange))
        if names
    ]

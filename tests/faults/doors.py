"""Every door that writes, on a small drive: what it is given, and what it has made when nothing fails."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from tests.calibration.site import INFO, clicked, write_table
from tests.faults.judge import Case, Outcome, Prepare
from tests.ports import short_port
from v2hdm.errors import DriveError
from v2hdm.io.calibration import write_camera_info
from v2hdm.io.trajectory import read_image_list, write_image_list
from v2hdm.simulate import render_drive
from v2hdm.store.cache import checked, code_key
from v2hdm.store.files import dump_yaml, load_yaml, replace_text
from v2hdm.store.inputs import LIST
from v2hdm.store.lock import IN_USE, STAGES
from v2hdm.store.pruning import DRIVES, LEFT, items_of

IMAGES = 16
"""Of the drive's one camera: enough for a map, few enough for a second or two a run."""

HERE = "work/here/"
_FORMATS = "geojson,csv,gpkg,lanelet2,dxf"


@dataclass(frozen=True)
class Situation:
    """A door and its inputs.

    Attributes:
        case: of the judge.
        grows: whether its files appear one by one; otherwise all of them do at once.
        cache: of the inputs' folder, what is a cache.
    """

    case: Case
    grows: bool = False
    cache: str = "cache"

    @property
    def name(self) -> str:
        """Of the case."""
        return self.case.name


def small_drive(scratch: Path, cameras: Sequence[str] = ("front",), images: int = IMAGES) -> Path:
    """A drive with so many images of each camera, rendered where it is not there yet."""
    rendered, folder = scratch / "rendered", scratch / f"drive-{'-'.join(cameras)}-{images}"
    if not (rendered / "drive.yaml").is_file():
        render_drive(short_port(), rendered, 1, lambda done, total: None)
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
    """Of the mapping door, for that drive."""
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
            command = [sys.executable, "-m", "v2hdm map", *map_arguments(self.drive)]
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
        done = self.given("cache", "out/run")
        arguments = map_arguments(self.drive, "all_maps=true", f"export=[{_FORMATS}]")
        yield Situation(Case("map again, all files", "v2hdm map", arguments, done, ""))
        yield Situation(
            Case("map with a mosaic", "v2hdm map", (*map_arguments(self.drive), "mosaic=true"), done, "")
        )
        yield Situation(Case("map", "v2hdm map", map_arguments(self.drive), self.given(), ""))
        update = (*map_arguments(self.drive), "map.base=base/out/run", "name=update")
        given = _Given(self.mapped(), ("cache", "out/run"), ("out/run", "base/out/run"))
        yield Situation(Case("update", "v2hdm map", update, given, ""))

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
        done = self.given("out/run")
        yield Situation(Case("mosaic", "v2hdm mosaic", ("out/run",), done, ""), grows=True)
        yield Situation(Case("report", "v2hdm report", ("out/run",), done, ""), grows=True)
        formats = [word for name in _FORMATS.split(",") for word in ("--format", name)]
        given = ("out/run/map.geojson", *formats, "--output", "there")
        yield Situation(Case("export", "v2hdm export", given, done, ""), grows=True)
        forms = ("camera_info", "static_transform", "urdf", "kalibr", "opencv")
        formats = [word for name in forms for word in ("--format", name)]
        given = ("out/run/calibration_front.yaml", *formats, "--output", "there")
        yield Situation(Case("export a calibration", "v2hdm export", given, done, ""), grows=True)

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
        rest = ("steps=2", "batch=2", "data.workers=0", "validation.images=1", "output=out", "device=cpu")
        train = (*tiny, *(f"data.{one}" for one in data), *rest)
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


def calibrating() -> Situation:
    """The door to a pre-calibration."""
    words = ("points.csv", "--intrinsics", "camera_info.yaml", "--output", "out")
    return Situation(Case("calibrate", "v2hdm calibrate points", words, _points, ""))


def _points(root: Path) -> None:
    write_camera_info(INFO, root / "camera_info.yaml")
    write_table(root, *clicked(seed=1))


@dataclass(frozen=True)
class Expected:
    """What a door leaves where nothing fails: its exit code, files, and which differ from run to run."""

    code: int | str
    files: dict[str, str]
    loose: frozenset[str]

    @classmethod
    def of(cls, situation: Situation, first: Outcome, second: Outcome) -> Expected:
        """As two runs show."""
        assert first.code in (0, 3), (situation.name, first.code, first.error)
        assert first.code == second.code, (situation.name, second.code, second.error)
        files = _without(situation, first.after)
        loose = {name for name, digest in files.items() if second.after.get(name) != digest}
        return cls(first.code, files, frozenset(loose))

    def defects(self, situation: Situation, outcome: Outcome, again: Outcome | None = None) -> list[str]:
        """What a door may not have done on a disk that fails, and ``again`` on one that does not any more."""
        if outcome.code != 2:
            found = self._wrong(situation, outcome, "is")
        else:
            before, after = _without(situation, outcome.before), _without(situation, outcome.after)
            made = {
                name for name, digest in after.items() if situation.grows and self._is_whole(name, digest)
            }
            before = {name: one for name, one in before.items() if name not in made}
            leaves = "|".join(f"^{re.escape(name)}$" for name in made) or r"(?!)"
            told = replace(situation.case, says=r"\S", code=2, leaves=leaves)
            found = replace(outcome, before=before, after=after).faults(told)
        return found + ([] if again is None else self._wrong(situation, again, "is afterwards"))

    def _is_whole(self, name: str, digest: str) -> bool:
        """Whether a file is there as it must be in the end."""
        return digest == self.files.get(name) or name in self.loose

    def _wrong(self, situation: Situation, outcome: Outcome, when: str) -> list[str]:
        """Whether what there is, is what there must be."""
        found = [] if outcome.code == self.code else [f"exit code {when} {outcome.code}, not {self.code}"]
        if "Traceback" in outcome.error:
            found.append(f"a traceback {when} there")
        there = _without(situation, outcome.after)
        # Of a file that a damaged list no longer names the door says under which name it keeps it.
        said = outcome.error + outcome.output
        kept = {name for name in there if ".kept." in name and Path(name).name in said}
        changed = [
            name
            for name in (self.files.keys() | there.keys()) - kept
            if name not in there or not self._is_whole(name, there[name])
        ]
        return [*found, *([f"{when} wrong or missing: {sorted(changed)[:4]}"] if changed else [])]


def cache_defects(cache: Path) -> list[str]:
    """What is wrong in a cache after a run: damaged entries, and what was never finished."""
    items = items_of(cache)
    known = {item.path for item in items}
    strange = [
        path.name
        for path in (cache / STAGES).rglob("*")
        if path.is_file() and path not in known and IN_USE not in path.as_posix()
    ]
    left = [item.path.name for item in items if item.kind == LEFT]
    entries = [item.path for item in items if item.kind not in (DRIVES, LEFT)]
    damaged = [path.name for path in entries if checked(path.read_bytes()) is None]
    return [
        f"{what} in the cache: {names[:3]}"
        for what, names in (("half", left), ("damaged", damaged), ("strange", strange))
        if names
    ]


def _without(situation: Situation, state: dict[str, str]) -> dict[str, str]:
    """A state without the cache; where files come one by one without their list, too."""
    cache = f"{HERE}{situation.cache}"
    return {
        name: one
        for name, one in state.items()
        if name != cache
        and not name.startswith(f"{cache}/")
        and not (situation.grows and name.rpartition("/")[2].startswith((LIST, "events.out.")))
    }

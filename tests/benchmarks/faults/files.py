"""Files that were damaged, each by chance: images, texts of a drive, networks, caches and earlier results."""

from __future__ import annotations

import re
import shutil
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from tests.benchmarks.faults.damage import damage
from tests.benchmarks.faults.disks import expected_of
from tests.benchmarks.faults.doors import cache_defects, map_arguments
from tests.benchmarks.faults.forked import Forked
from tests.benchmarks.faults.running import Order, Row, folder_in, in_fork, row_of
from tests.benchmarks.faults.situations import HERE, Situation
from tests.benchmarks.wrong.cameras import camera_faults
from tests.benchmarks.wrong.fault import Fault, copy_of
from tests.benchmarks.wrong.frames import frame_faults
from tests.benchmarks.wrong_inputs import Outcome as Mapped
from tests.benchmarks.wrong_inputs import judge as judge_map
from tests.benchmarks.wrong_inputs import map_drive
from tests.faults.judge import Case, Outcome, judge
from v2hdm.detection.weights import NETWORK_FILE
from v2hdm.mapping.options import MappingOptions

_TEXTS = ("poses.tum", "drive.yaml", "front/camera_info.yaml", "front/images.txt")
_TELLS = (
    r"damaged|has changed since we wrote it|was changed after|not fitted to|verdict: (WARN|FAIL)|^error: "
)
"""Sentences by which a door says that it does not take a file for whole."""


def damaged_texts(order: Order) -> Iterator[Row]:
    """The texts of a drive: the map is as good as that of the drive as it was, or the user is told."""
    for name in _TEXTS:
        if re.search(order.only, name):
            yield from _maps(order, name, lambda folder, name=name: damage(folder / name, order.rng))


def damaged_images(order: Order) -> Iterator[Row]:
    """Images of a drive, one at a time."""

    def spoil(folder: Path) -> str:
        images = folder / "front" / "images"
        source = images.resolve()
        images.unlink()
        shutil.copytree(source, images)
        return damage(_any(order, sorted(images.iterdir())), order.rng)

    if re.search(order.only, "image of a drive"):
        yield from _maps(order, "image of a drive", spoil)


def faulty_frames(order: Order) -> Iterator[Row]:
    """Images that are frozen, exchanged, dropped, doubled or mixed up, and drop-outs of RTK."""
    good = order.doors.longer_drive
    clean = _mapped(order, good, lambda folder: None)
    of_cameras = [
        fault for fault in camera_faults() if re.search("frozen|swapped|twice|off by one|missing", fault.name)
    ]
    for fault in [*of_cameras, *frame_faults()]:
        if re.search(order.only, fault.name):
            yield _row(fault.name, _mapped(order, good, fault.spoil), clean)


def _maps(order: Order, name: str, spoil: Callable[[Path], str]) -> Iterator[Row]:
    good = order.doors.drive
    clean = _mapped(order, good, lambda folder: None)
    for _ in range(order.each):
        how: list[str] = []
        mapped = _mapped(order, good, lambda folder, how=how: how.append(spoil(folder)))
        yield _row(f"{name}: {how[0]}", mapped, clean)


def _row(name: str, mapped: Mapped, clean: Mapped) -> Row:
    row = judge_map(name, Fault(name, None), mapped, clean)
    crashed = mapped.status == "CRASHED"
    end = "DEFECT" if row.silently_wrong or crashed else "right" if row.right else "told"
    first = mapped.message or "; ".join(
        f"{finding['check']}: {finding['says']}" for finding in mapped.findings[:1]
    )
    error = f"{100 * mapped.rmse_m:.1f} cm, {mapped.false} false of {mapped.markings}, {mapped.status}"
    return Row(name, end, f"{error}: {first}"[:300])


def _mapped(order: Order, good: Path, spoil: Callable[[Path], object]) -> Mapped:
    """A drive spoilt and mapped in a fork of this process."""
    with folder_in(order.scratch) as folder:
        drive = copy_of(good, folder / "drive")
        spoil(drive)

        def work() -> Mapped:
            signal.alarm(_LONGEST_S)
            return map_drive(drive, folder / "out", MappingOptions(), good, order.scratch / "cache")

        return in_fork(work) or Mapped("CRASHED", "the process died, or did not end")


_LONGEST_S = 600
"""Numba may have to compile within it."""


def damaged_networks(order: Order) -> Iterator[Row]:
    """The detector's network, given as a file of one's own."""

    def prepare(root: Path) -> None:
        order.doors.images(root)
        shutil.copy(NETWORK_FILE, root / "mine.onnx")

    arguments = ("images", "--limit", "1", "--model", "mine.onnx", "--output", "found.jsonl")
    yield from _told(order, Situation(Case("network", "v2hdm detect", arguments, prepare, "")), "mine.onnx")


def damaged_caches(order: Order) -> Iterator[Row]:
    """Entries of the cache: they are made anew, and the map is the same to the byte."""
    cached = order.doors.given("cache")
    case = Case("cache", "v2hdm map", map_arguments(order.doors.drive), cached, "")
    yield from _told(order, Situation(case), "cache/stages/[!f]*/*.v2hdm", remade=True)


def damaged_results(order: Order) -> Iterator[Row]:
    """Files of a result, before the same run again, and before the doors that read results."""
    doors, files = order.doors, order.doors.given("out/run")
    again = Case("run again", "v2hdm map", map_arguments(doors.drive), doors.given("cache", "out/run"), "")
    yield from _told(order, Situation(again), "out/run/*")
    for situation in doors.all():
        if situation.name == "update":
            yield from _told(order, situation, "base/out/run/*.[gt][eu]*")  # map, exclusions and poses
        elif situation.name in ("localize", "mosaic", "report"):
            yield from _told(order, situation, "out/run/*.[gjty][esua]*")
    for source, form in (("map.geojson", "csv"), ("calibration_front.yaml", "kalibr")):
        words = (f"out/run/{source}", "--format", form, "--output", "there")
        case = Case(f"export {source}", "v2hdm export", words, files, "")
        yield from _told(order, Situation(case, grows=True), f"out/run/{source}")
    words = ("out/run/calibration_front.yaml", "out/run")
    compare = Case("compare calibrations", "v2hdm calibrate compare", words, files, "")
    yield from _told(order, Situation(compare), "out/run/calibration_front.yaml")


def _told(order: Order, situation: Situation, files: str, remade: bool = False) -> Iterator[Row]:
    """A door with one of some files damaged: its result is that of the whole file, or it tells.

    Where what was damaged is ``remade`` it is that of the whole file, told or not.
    """
    if not re.search(order.only, situation.name):
        return
    expected, _ = expected_of(situation, order.scratch)
    for _ in range(order.each):
        how: list[str] = []

        def prepare(root: Path, how: list[str] = how) -> None:
            situation.case.prepare(root)
            path = _any(order, sorted(path for path in root.glob(files) if path.is_file()))
            how[:] = [path.relative_to(root).as_posix(), damage(path, order.rng)]

        with folder_in(order.scratch) as folder:
            case = situation.case
            spoilt = Case(case.name, case.door, case.arguments, prepare, "")
            outcome = judge(spoilt, folder, Forked(folder))
            defects = cache_defects(folder / HERE / situation.cache)
        # What was damaged and is not read is damaged afterwards, too.
        spoilt_too = replace(expected, loose=expected.loose | {HERE + how[0]})
        took = spoilt_too.defects(situation, outcome)
        defects += took if remade else _untold(outcome, took)
        row = row_of(f"{situation.name}: {': '.join(how)}", outcome, defects)
        is_told = row.end == "right" and re.search(_TELLS, f"{outcome.error}\n{outcome.output}", re.MULTILINE)
        yield Row(row.name, "told" if is_told else row.end, row.said)


def _untold(outcome: Outcome, defects: list[str]) -> list[str]:
    """Defects of an outcome of which the user was not told."""
    says = re.search(_TELLS, f"{outcome.error}\n{outcome.output}", re.MULTILINE)
    if outcome.code == 2 or not says or "Traceback" in outcome.error:
        return defects
    return [] if outcome.code in (0, 3) else [f"exit code {outcome.code}"]


def _any(order: Order, paths: list[Path]) -> Path:
    return paths[int(order.rng.integers(len(paths)))]

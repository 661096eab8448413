"""Doors on a disk that fails at some calls: a small edition of `python -m tests.benchmarks.faults`."""

import errno
import os

import numpy as np
import pytest

from tests.benchmarks.faults.failing_calls import Failure, watch, why_not
from tests.benchmarks.faults.forked import Forked
from tests.benchmarks.faults.situations import Expected, Situation, calibrating
from tests.drive.example import make_map
from tests.faults.judge import DATE, Case, judge, judge_again
from tests.faults.pictures import picture
from v2hdm.errors import MapFileError
from v2hdm.io.maps.geopackage import write_geopackage
from v2hdm.mosaic.blend import Sheet
from v2hdm.mosaic.result import geotiff
from v2hdm.mosaic.views import Canvas

pytestmark = pytest.mark.skipif(why_not() is not None, reason=str(why_not()))


def detecting():
    def prepare(root):
        (root / "images").mkdir()
        for name in ("a.jpg", "b.jpg"):
            (root / "images" / name).write_bytes(picture(height=96, width=128))

    words = ("images", "--output", "found.jsonl", "--draw", "drawn")
    return Situation(Case("detect", "v2hdm detect", words, prepare, ""), grows=True)


@pytest.mark.parametrize(("situation", "places"), [(detecting(), 5), (calibrating(), 1)])
def test_a_door_on_a_failing_disk_does_all_or_tells_and_works_afterwards(situation, places, tmp_path):
    outcomes, calls = [], []
    for number in range(2):
        runner = Forked(tmp_path / f"good{number}")
        outcomes.append(judge(situation.case, tmp_path / f"good{number}", runner))
        calls = runner.calls
    expected = Expected.of(situation, *outcomes)
    assert len(calls) > 10
    for at in np.linspace(0, len(calls) - 1, places + 2).astype(int)[1:-1].tolist():
        for failure in (Failure(at, errno.ENOSPC, True), Failure(at, errno.EIO, False)):
            folder = tmp_path / f"{at}-{failure.number}"
            outcome = judge(situation.case, folder, Forked(folder, failure))
            again = judge_again(situation.case, folder, Forked(folder))
            defects = expected.defects(situation, outcome, again)
            assert not defects, (calls[at], failure, outcome.error)


def test_a_mosaic_on_a_failing_disk_is_whole_or_not_there(tmp_path):
    pytest.importorskip("rasterio", reason="no rasterio: pip install 'v2hdm[gis]'")
    canvas = Canvas(np.zeros(2), 0.02, 512, 512)
    pixels = np.random.default_rng(0).integers(0, 255, (512, 512, 4), dtype=np.uint8)

    def write():
        try:
            with geotiff(tmp_path / "a.tif", canvas, None) as put:
                put(Sheet(0, 0, pixels))
        except OSError:
            return 2
        return 0

    good = watch(write, tmp_path, None, 30)
    assert good.code == 0
    whole = (tmp_path / "a.tif").read_bytes()
    for at in range(len(good.calls)):
        (tmp_path / "a.tif").unlink(missing_ok=True)
        ended = watch(write, tmp_path, Failure(at, errno.EIO, False), 30)
        assert ended.code in (0, 2)
        left = [path.read_bytes() for path in tmp_path.iterdir()]
        assert left == ([whole] if ended.code == 0 else [])


def test_a_geopackage_on_a_failing_disk_is_whole_or_not_there(tmp_path):
    pytest.importorskip("pyogrio", reason="no pyogrio: pip install 'v2hdm[gis]'")
    hd_map = make_map()

    def write():
        try:
            write_geopackage(hd_map, tmp_path / "a.gpkg")
        except (OSError, MapFileError):
            return 2
        return 0

    def left():
        return [DATE.sub(b"", path.read_bytes()) for path in tmp_path.iterdir()]

    good = watch(write, tmp_path, None, 30)
    whole = left()
    for at in range(0, len(good.calls), 13):
        (tmp_path / "a.gpkg").unlink(missing_ok=True)
        ended = watch(write, tmp_path, Failure(at, errno.EIO, False), 30)
        assert left() == (whole if ended.code == 0 else [])


def test_calls_below_a_folder_are_counted_and_no_others(tmp_path):
    def work():
        (tmp_path / "here").mkdir()
        os.write(os.open(tmp_path / "here" / "a", os.O_WRONLY | os.O_CREAT), b"a")
        (tmp_path / "here" / "a").rename(tmp_path / "here" / "b")
        (tmp_path / "there").write_text("not counted")
        return 7

    watched = watch(work, tmp_path / "here", None, 30)
    assert watched.code == 7
    assert watched.calls == ["openat a", "write a", "rename b"]

"""The on-vehicle door: every source, what it writes, and what it refuses."""

import errno
import io
import json
import os
import queue
import re
import shutil
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from tests.detection.pictures import HEIGHT, WIDTH, brightness_model, diamond, extrinsic, make_camera, picture
from tests.drive.example import make_drive
from v2hdm.cli.main import run
from v2hdm.detection import frames
from v2hdm.detection.detector import Detector, Looked
from v2hdm.detection.frames import Frame
from v2hdm.detection.road import RoadDetector, draw_detections
from v2hdm.detection.stopwatch import TOTAL, Stopwatch, lap
from v2hdm.io.calibration.reading import Provenance
from v2hdm.io.calibration.writing import write_calibration, write_calibration_as
from v2hdm.records import Calibration, LaneDetection, MarkingDetection

DIAMONDS = [diamond(8.0, 0.5), diamond(11.0, -0.5)]
COVARIANCE = np.diag([1e-4, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6])


@dataclass(frozen=True)
class Bench:
    """Two pictures of two diamonds, their camera's calibration and a model that sees them."""

    folder: Path
    calibration: Path
    model: Path

    def run(self, source, *arguments, calibrated=True):
        camera = ["--camera", str(self.calibration)] if calibrated else []
        return run(["detect", str(source), "--model", str(self.model), *camera, *map(str, arguments)])


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    root = tmp_path_factory.mktemp("door")
    folder = root / "images"
    folder.mkdir()
    for n in range(2):
        cv2.imwrite(str(folder / f"{n}.png"), picture(make_camera(), DIAMONDS, seed=n))
    write_calibration(Calibration(make_camera().info, extrinsic(), COVARIANCE), root / "front.yaml")
    return Bench(folder, root / "front.yaml", brightness_model(root))


def lines(output):
    return [json.loads(line, parse_constant=lambda name: pytest.fail(name)) for line in output.splitlines()]


def near(record):
    """The marking at 8 m."""
    return min(record["markings"], key=lambda marking: marking["corners_vehicle"][0][0])


def test_a_folder_gives_a_line_an_image_in_pixels_and_metres_and_pictures(bench, tmp_path, capsys):
    output, drawn = tmp_path / "deep" / "found.jsonl", tmp_path / "drawn"
    assert bench.run(bench.folder, "--output", output, "--draw", drawn) == 0
    records = lines(output.read_text())
    assert [record["source"] for record in records] == [str(bench.folder / f"{n}.png") for n in range(2)]
    assert sorted(path.name for path in drawn.iterdir() if path.suffix == ".jpg") == ["0.jpg", "1.jpg"]
    marking = near(records[0])
    assert marking["class"] == "diamond"
    np.testing.assert_allclose(np.mean(marking["corners_vehicle"], axis=0), [8.0, 0.5], atol=0.02)
    assert np.shape(marking["covariance_px"]) == np.shape(marking["covariance_m2"]) == (8, 8)
    assert np.linalg.eigvalsh(marking["covariance_m2"])[0] > -1e-7
    report = capsys.readouterr().err
    assert report.startswith("2 images, peak memory")
    for stage in ("read", "all"):
        assert re.search(rf"^{stage}( +\d+\.\d){{3}}$", report, re.MULTILINE)
    assert report.count("scores come from the judge of the shipped network") == 1


def test_an_uncertain_calibration_shows_in_metres_and_not_in_pixels(bench, tmp_path, capsys):
    exact = tmp_path / "exact.yaml"
    write_calibration(Calibration(make_camera().info, extrinsic()), exact)
    bench.run(bench.folder / "0.png")
    bench.run(bench.folder / "0.png", "--camera", exact)
    unsure, sure = (near(record) for record in lines(capsys.readouterr().out))
    assert unsure["covariance_px"] == sure["covariance_px"]
    gap = np.diag(unsure["covariance_m2"]) - np.diag(sure["covariance_m2"])
    assert (gap > 1e-4).all()


def test_without_a_calibration_there_are_pixels_only_and_a_word_about_it(bench, capsys):
    assert bench.run(bench.folder / "0.png", calibrated=False) == 0
    out, err = capsys.readouterr()
    assert all("corners_vehicle" not in marking for marking in lines(out)[0]["markings"])
    assert "no --camera: taking it to be 1.6 m up" in err
    assert bench.run(bench.folder / "0.png", "--mounting", 2.2, 14, 63, calibrated=False) == 0
    out, err = capsys.readouterr()
    assert ["corners_px" in marking for marking in lines(out)[0]["markings"]] == [True, True]
    assert "no --camera" not in err


def test_intrinsics_of_another_tool_give_the_lens_and_pixels(bench, tmp_path, capsys):
    info = make_camera().info
    write_calibration_as("kalibr", Calibration(info, extrinsic()), Provenance(), tmp_path, "front")
    file = tmp_path / "front_kalibr.yaml"
    assert bench.run(bench.folder / "0.png", "--camera", file) == 0
    out, err = capsys.readouterr()
    assert all("corners_px" in marking for marking in lines(out)[0]["markings"])
    assert all("corners_vehicle" not in marking for marking in lines(out)[0]["markings"])
    wide = 2 * np.degrees(np.arctan(info.width / 2 / info.intrinsic[0, 0]))
    assert f"no mounting in {file}: taking it to be 1.6 m up, 5 deg down, {wide:.3g} deg wide" in err
    assert bench.run(bench.folder / "0.png", "--camera", file, "--mounting", 2.2, 14, 63) == 0
    assert "no mounting" not in capsys.readouterr().err
    assert bench.run(bench.folder / "0.png", "--camera", file, "--camera-name", "cam1") == 2
    assert "no camera 'cam1' in this file; it holds: cam0" in capsys.readouterr().err
    assert bench.run(bench.folder / "0.png", "--camera-name", "cam0") == 2
    assert "is the calibration of one camera" in capsys.readouterr().err


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # FFmpeg takes it at its first use: here
    path = tmp_path_factory.mktemp("video") / "drive.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (WIDTH, HEIGHT))
    for n in range(4):
        writer.write(picture(make_camera(), DIAMONDS, seed=n))
    writer.release()
    return path


def test_images_of_one_name_are_drawn_one_by_one(bench, tmp_path):
    source, drawn = tmp_path / "source", tmp_path / "drawn"
    source.mkdir()
    for name in ("a.png", "a.b.png", "a_b.png", "a.tif", "A.png"):
        (source / name).symlink_to(bench.folder / "0.png")
    for _ in range(2):
        assert bench.run(source, "--draw", drawn) == 0
        assert len(list(drawn.glob("*.jpg"))) == 5


def test_the_images_of_a_drive_are_numbered_by_camera(tmp_path, capsys):
    make_drive(tmp_path / "drive")
    assert run(["detect", str(tmp_path / "drive")]) == 0
    images = [(line["camera"], line["frame"]) for line in lines(capsys.readouterr().out)]
    assert sorted(images) == [(name, number) for name in ("front", "rear") for number in range(3)]


def test_a_video_gives_a_line_a_frame_with_its_time(bench, video, tmp_path, capsys):
    assert bench.run(video, "--draw", tmp_path) == 0
    records = lines(capsys.readouterr().out)
    assert [(record["frame"], record["stamp_s"]) for record in records] == [
        (n, pytest.approx(n / 10)) for n in range(4)
    ]
    np.testing.assert_allclose(np.mean(near(records[3])["corners_vehicle"], axis=0), [8.0, 0.5], atol=0.03)
    assert len(list(tmp_path.glob("drive_00000*.jpg"))) == 4


def test_a_video_that_is_cut_off_is_told(bench, video, tmp_path, caplog):
    cut = tmp_path / "cut.avi"
    cut.write_bytes(video.read_bytes()[: int(video.stat().st_size * 0.7)])
    assert bench.run(cut) == 0
    assert re.search(r"the video ends after [12] of \d frames", caplog.text)


def test_the_number_of_images_can_be_limited(bench, video, capsys):
    assert bench.run(video, "--limit", 2) == 0
    assert len(lines(capsys.readouterr().out)) == 2


class FakeCapture:
    """A camera that is unplugged, or interrupted, after three frames."""

    end: type[BaseException] | None = None

    def __init__(self, source):
        self.left = 3

    def isOpened(self):
        return True

    def read(self):
        self.left -= 1
        if self.left < 0 and self.end:
            raise self.end
        return self.left >= 0, picture(make_camera(), DIAMONDS)

    def set(self, key, value):
        assert value in (WIDTH, HEIGHT)

    def release(self): ...


def test_a_live_camera_runs_until_it_is_interrupted(bench, tmp_path, monkeypatch):
    monkeypatch.setattr(frames.cv2, "VideoCapture", FakeCapture)
    monkeypatch.setattr(FakeCapture, "end", KeyboardInterrupt)
    output = tmp_path / "found.jsonl"
    assert bench.run(0, "--output", output) == 0
    assert [record["source"] for record in lines(output.read_text())] == ["camera 0"] * 3


def test_what_an_unplugged_camera_saw_is_kept(bench, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(frames.cv2, "VideoCapture", FakeCapture)
    output = tmp_path / "found.jsonl"
    assert bench.run(0, "--output", output) == 2
    assert "camera 0: no image after 3 frames" in capsys.readouterr().err
    assert len(lines(output.read_text())) == 3


def test_a_slow_detector_gets_the_newest_frame_and_the_number_of_those_dropped():
    arriving, read = queue.Queue(), queue.Queue()

    def camera():
        for index in iter(arriving.get, None):
            yield Frame("camera 0", f"{index}", index, time.time(), np.zeros((2, 2, 3), np.uint8))
            read.put(index)

    newest, taken_frames, total = frames.NewestFrames(camera()), [], 0
    for burst in (1, 5, 2, 10):
        for _ in range(burst):  # while the detector is busy
            arriving.put(total)
            total += 1
            read.get(timeout=10)
        taken_frames.append(next(newest))
    assert [frame.index for frame in taken_frames] == [0, 5, 7, 17]
    assert [frame.dropped for frame in taken_frames] == [0, 4, 1, 9]
    arriving.put(None)
    with pytest.raises(StopIteration):
        next(newest)


def test_images_of_a_camera_grow_no_older_when_the_detector_is_slow(bench, tmp_path, monkeypatch, capsys):
    image = picture(make_camera(), DIAMONDS)

    class Fast(FakeCapture):
        def read(self):
            time.sleep(0.002)
            return True, image

    monkeypatch.setattr(frames.cv2, "VideoCapture", Fast)
    output = tmp_path / "found.jsonl"
    assert bench.run(0, "--live", "--output", output, "--limit", 12) == 0
    records = lines(output.read_text())
    assert len(records) == 12
    assert [record["frame"] for record in records] == (
        np.cumsum([record["dropped"] + 1 for record in records]) - 1
    ).tolist()
    said = capsys.readouterr().err
    assert f"{sum(record['dropped'] for record in records)} images dropped" in said
    assert sum(record["dropped"] for record in records) > 12
    age_ms, total_ms = (float(re.search(rf"^{row} +([0-9.]+)", said, re.M)[1]) for row in ("age", "all"))
    assert age_ms < total_ms + 50


def test_of_a_folder_that_grows_the_newest_whole_image_is_taken(bench, tmp_path, caplog):
    image = (bench.folder / "0.png").read_bytes()

    def write(name, content=image, old_s=0.0):
        (tmp_path / name).write_bytes(content)
        stamp_s = time.time() - old_s
        os.utime(tmp_path / name, (stamp_s, stamp_s))

    write("9.png", old_s=20)
    write("1.png", old_s=10)
    arriving = frames.arriving_frames(tmp_path)
    first = next(arriving)
    assert (first.name, first.dropped) == ("9", 0)
    for k, name in enumerate(("b", "a", "c")):
        write(f"{name}.png", old_s=9 - k)
    frame = next(arriving)
    assert (frame.name, frame.index) == ("c", 1)
    assert frame.stamp_s == pytest.approx(time.time() - 7, abs=5)
    write("d.png", image[:200])
    threading.Timer(0.1, write, ["d.png"]).start()
    assert next(arriving).name == "d"
    write("e.png", image[:200], old_s=60)
    threading.Timer(0.1, write, ["f.png"]).start()
    assert next(arriving).name == "f"
    assert "e.png" in caplog.text


def test_a_folder_that_rests_is_not_listed_again_and_what_comes_then_is_seen(bench, tmp_path, monkeypatch):
    (tmp_path / "0.png").write_bytes((bench.folder / "0.png").read_bytes())
    os.utime(tmp_path, (1.0, 1.0))
    listings, list_images = [], frames.list_images
    monkeypatch.setattr(
        frames, "list_images", lambda *arguments: listings.append(time.time()) or list_images(*arguments)
    )
    arriving = frames.arriving_frames(tmp_path)
    assert next(arriving).name == "0"
    threading.Timer(0.5, (tmp_path / "1.png").write_bytes, [(bench.folder / "0.png").read_bytes()]).start()
    listings.clear()
    assert next(arriving).name == "1"
    assert len(listings) < 20, "a hundred looks fit into half a second"


def not_finite(model, path):
    """A copy of the model with one weight that is not a number."""
    content = onnx.load(model)
    weight = next(w for w in content.graph.initializer if w.name == "slope")
    weight.CopyFrom(numpy_helper.from_array(np.full((1, 1, 1, 1), np.nan, dtype=np.float32), "slope"))
    onnx.save(content, path)
    return path


def bad_source(name, bench, folder):
    """The arguments of one mistake."""
    if name == "small":
        image = cv2.imread(str(bench.folder / "0.png"))
        cv2.imwrite(str(folder / "small.png"), image[::2, ::2])
        return [folder / "small.png"]
    if name == "nan":
        return [bench.folder, "--model", not_finite(bench.model, folder / "nan.onnx")]
    return [folder]


def test_a_grey_image_in_a_folder_is_looked_at_like_the_others(bench, tmp_path):
    image = cv2.imread(str(bench.folder / "0.png"))
    for name, pixels in (("0", image), ("1", cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)), ("2", image)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), pixels)
    assert bench.run(tmp_path, "--output", tmp_path / "found.jsonl") == 0
    assert len((tmp_path / "found.jsonl").read_text().splitlines()) == 3


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        ("small", "the image is 320x180, but the calibration of camera 'front' is for 640x360"),
        ("empty", "no images (.jpg"),
        ("nan", "nan.onnx: the network's outputs are not finite"),
    ],
)
def test_a_mistake_is_one_line_exit_code_2_and_nothing_half_written(bench, tmp_path, capfd, mistake, words):
    output = tmp_path / "found.jsonl"
    assert bench.run(*bad_source(mistake, bench, tmp_path), "--output", output) == 2
    error = capfd.readouterr().err
    assert words in error
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert not list(tmp_path.glob("*found*"))
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("index", [97, 99999999999])
def test_a_camera_that_does_not_open_is_one_line(bench, capfd, index):
    assert bench.run(index) == 2
    assert capfd.readouterr().err.startswith(f"error: camera {index}: cannot be opened")


def test_a_number_that_is_a_folder_as_well_as_a_cameras_index_is_asked_about(
    bench, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(bench.folder, tmp_path / "0007")
    assert bench.run("0007") == 2
    assert "write ./0007" in capsys.readouterr().err
    assert bench.run("./0007") == 0


class FullDevice(io.StringIO):
    def write(self, text):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_standard_output_is_one_line(bench, monkeypatch, capsys):
    monkeypatch.setattr("sys.stdout", FullDevice())
    assert bench.run(bench.folder) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: standard output: cannot be written (No space left")
    assert error.count("\n") == 1


@pytest.mark.parametrize("when", ["load", "steps"])
def test_an_interruption_before_the_last_image_is_one_line_and_no_half_a_file(
    bench, tmp_path, monkeypatch, capsys, when
):
    calls = []

    def interrupted(*arguments, **keywords):
        calls.append(None)
        if when == "load" or len(calls) == 2:
            raise KeyboardInterrupt
        return original(*arguments, **keywords)

    original = getattr(Detector, when)
    monkeypatch.setattr(Detector, when, interrupted)
    assert bench.run(bench.folder, "--output", tmp_path / "out" / "found.jsonl") == 2
    line = "error: interrupted before the last image; no --output was written\n"
    assert capsys.readouterr().err == line
    assert not list((tmp_path / "out").glob("*"))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--mounting", 1, 0, 60], "exclude each other"),
        (["--live"], "--live"),
        (["--regions"], "add --live"),
    ],
)
def test_arguments_that_exclude_one_another_are_refused(bench, capsys, arguments, words):
    assert bench.run(bench.folder / "0.png", *arguments) == 2
    assert words in capsys.readouterr().err


def test_the_class_for_a_robots_loop_gives_what_the_door_writes(bench, capsys):
    bench.run(bench.folder / "0.png")
    (record,) = lines(capsys.readouterr().out)
    road = RoadDetector.load(bench.calibration, bench.model)
    detections = road.detect(cv2.imread(str(bench.folder / "0.png")))
    assert [marking.kind for marking in detections.markings] == [m["class"] for m in record["markings"]]
    for marking, written in zip(detections.markings, record["markings"], strict=True):
        np.testing.assert_allclose(marking.corners_vehicle, written["corners_vehicle"], atol=1e-4)
        digits = [[float(f"{value:.4g}") for value in row] for row in marking.covariance_m2]
        assert written["covariance_m2"] == digits


def test_arrows_and_whole_lines_are_written_and_drawn_without_corners(bench, monkeypatch, capsys, tmp_path):
    nothing = np.full((4, 2), np.nan), np.full((8, 8), np.nan), np.zeros(4, dtype=bool)
    outline = np.array([[300.0, 200.0], [340.0, 200.0], [320.0, 300.0]])
    arrow = MarkingDetection("arrow", 0.9, *nothing, outline)
    line = LaneDetection("lane_boundary", 0.8, np.array([[100.0, 350.0], [200.0, 200.0]]), -1)

    def looked(*_):
        yield
        return Looked((arrow,), (line,), ())

    monkeypatch.setattr(Detector, "steps", looked)
    assert bench.run(bench.folder / "0.png", "--draw", tmp_path) == 0
    (record,) = lines(capsys.readouterr().out)
    assert set(record["markings"][0]) == {"class", "score", "outline_px", "outline_seen", "outline_vehicle"}
    (lane,) = record["lanes"]
    assert (lane["identity"], np.shape(lane["covariance_m2"])) == (-1, (2, 2, 2))
    image = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
    drawn = draw_detections(image, [arrow], [line])
    assert (drawn[198:203, 310:330] > 0).any()
    assert not image.any()


def test_a_process_that_runs_for_days_keeps_the_times_of_its_last_images_only(monkeypatch):
    monkeypatch.setattr("v2hdm.detection.stopwatch.KEPT", 3)
    stopwatch = Stopwatch()
    for number in range(5):
        with stopwatch.image(), lap("read" if number < 2 else "fit"):
            pass
    assert (stopwatch.images, stopwatch.stages) == (5, ("fit",))
    assert len(stopwatch.times_s(TOTAL)) == 3


def test_the_stopwatch_adds_up_laps_of_an_image_and_forgets_failed_ones():
    stopwatch = Stopwatch()
    for stages in (["net"], ["net", "lanes", "lanes"]):
        with stopwatch.image():
            for stage in stages:
                with lap(stage):
                    pass
    with pytest.raises(ValueError, match="spoilt"), stopwatch.image():
        raise ValueError("spoilt")
    with stopwatch.image():
        stopwatch.discard()
    with lap("net"):
        pass  # nobody asks
    assert (stopwatch.images, stopwatch.stages) == (2, ("net", "lanes"))
    assert stopwatch.times_s("lanes")[0] == 0.0 < stopwatch.times_s("lanes")[1]
    assert (stopwatch.times_s(TOTAL) >= stopwatch.times_s("net") + stopwatch.times_s("lanes")).all()


def started(bench, *arguments):
    command = [sys.executable, "-m", "v2hdm", "detect", *map(str, arguments)]
    command += ["--camera", str(bench.calibration), "--model", str(bench.model)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def wait_until(is_so):
    end_s = time.monotonic() + 60
    while not is_so():
        assert time.monotonic() < end_s
        time.sleep(0.02)


def test_lines_of_a_live_source_are_in_the_file_as_they_come_and_a_kill_loses_none(bench, tmp_path):
    growing, output = tmp_path / "images", tmp_path / "out" / "found.jsonl"
    growing.mkdir()
    for run_number in (1, 2):
        process = started(bench, growing, "--live", "--output", output)
        number = 0

        def another_line(run_number=run_number):
            nonlocal number
            number += 1
            shutil.copyfile(bench.folder / "0.png", growing / f"{run_number}_{number:04d}.png")
            time.sleep(0.1)
            return output.is_file() and output.read_text().count("\n") >= 2 * run_number

        wait_until(another_line)
        process.kill()
        process.wait()
        assert [path.name for path in output.parent.iterdir()] == ["found.jsonl"]
        text = output.read_text()
        assert len(lines(text)) >= 2 * run_number
        if run_number == 1:
            output.write_text(text + '{"source": "half')
    assert output.read_text().startswith(text[: text.index("\n")])
    assert "half" not in output.read_text()


def test_a_line_says_where_to_look_in_the_image_of_its_time(bench, tmp_path, monkeypatch, capsys):
    bench.run(bench.folder / "0.png")
    (whole,) = lines(capsys.readouterr().out)
    corners_px = np.array(near(whole)["corners_px"])
    box = [*(corners_px.min(axis=0) - 20).tolist(), *(corners_px.max(axis=0) + 20).tolist()]
    (tmp_path / "images").mkdir()
    image = tmp_path / "images" / "0.png"
    shutil.copyfile(bench.folder / "0.png", image)
    for stamp_s, count in ((1000.0, 1), (1001.0, 2)):
        os.utime(image, (stamp_s, stamp_s))
        line = json.dumps({"stamp_s": 1000.02, "regions_px": [box]})
        monkeypatch.setattr("sys.stdin", io.StringIO(line + "\n"))
        assert bench.run(tmp_path / "images", "--live", "--regions", "--limit", 1) == 0
        (record,) = lines(capsys.readouterr().out)
        assert len(record["markings"]) == count
        assert record.get("whole", True) == (count == 2)
        apart_px = [np.abs(np.array(m["corners_px"]) - corners_px).max() for m in record["markings"]]
        assert min(apart_px) < 0.05
        assert not any("corners_vehicle" in marking for marking in record["markings"])


def test_an_image_of_which_all_is_to_be_searched_later_comes_a_second_time(
    bench, tmp_path, monkeypatch, capsys
):
    bench.run(bench.folder / "0.png")
    (whole,) = lines(capsys.readouterr().out)
    corners_px = np.array(near(whole)["corners_px"])
    box = [*(corners_px.min(axis=0) - 20).tolist(), *(corners_px.max(axis=0) + 20).tolist()]
    images = tmp_path / "images"
    images.mkdir()
    shutil.copyfile(bench.folder / "0.png", images / "0.png")
    os.utime(images / "0.png", (1000.0, 1000.0))

    def write_next():
        wait_until(lambda: len(lines(output.read_text())) == 2)
        shutil.copyfile(bench.folder / "0.png", images / "1.png")

    line = json.dumps({"stamp_s": 1000.0, "regions_px": [box], "all_later": True})
    monkeypatch.setattr("sys.stdin", io.StringIO(line + "\n"))
    output = tmp_path / "found.jsonl"
    writer = threading.Thread(target=write_next)
    output.touch()
    writer.start()
    assert bench.run(images, "--live", "--regions", "--limit", 2, "--output", output) == 0
    writer.join()
    first, second, third = lines(output.read_text())
    assert first["stamp_s"] == second["stamp_s"] == 1000.0
    assert not first["whole"]
    assert "second" not in first
    assert second["second"]
    assert "whole" not in second
    assert len(second["markings"]) == len(whole["markings"]) > len(first["markings"])
    assert "second" not in third


def test_a_kill_leaves_nothing_hidden_beside_the_output_and_the_earlier_file(bench, tmp_path):
    many = tmp_path / "images"
    many.mkdir()
    for n in range(400):
        shutil.copyfile(bench.folder / "0.png", many / f"{n:04d}.png")
    (tmp_path / "out").mkdir()
    output = tmp_path / "out" / "found.jsonl"
    output.write_text('{"source": "earlier"}\n')
    drawn = tmp_path / "drawn"
    process = started(bench, many, "--output", output, "--draw", drawn)
    wait_until(lambda: drawn.is_dir() and len([*drawn.glob("*.jpg")]) > 2)
    process.kill()
    process.wait()
    assert [path.name for path in output.parent.iterdir()] == ["found.jsonl"]
    assert output.read_text() == '{"source": "earlier"}\n'


def test_a_url_as_output_makes_no_folder_of_that_name(bench, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert bench.run(bench.folder, "--output", "s3://bucket/found.jsonl") == 2
    assert "URLs are allowed only as output=" in capsys.readouterr().err
    assert not [*tmp_path.iterdir()]

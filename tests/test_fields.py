"""Cameras, images and classes that files describe: which of them can be."""

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest

from train.checkpoint import own_entries
from v2hdm.catalogue import CORNERED_CLASSES, PAINT_CLASSES, SHIPPED, load_catalogue
from v2hdm.errors import ConfigError, DriveError, MapFileError
from v2hdm.geometry.lens import distort_points, undistort_points
from v2hdm.records import CameraInfo
from v2hdm.safe.fields import check_camera, lens_reach
from v2hdm.safe.pixels import read_header, read_pixels

INTRINSIC = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
KITTI = np.array([[984.2, 0.0, 690.0], [0.0, 980.8, 233.2], [0.0, 0.0, 1.0]])


def camera(model, distortion):
    return CameraInfo("front", 640, 480, INTRINSIC, model, distortion)


GOOD = [
    camera("plumb_bob", (0.0, 0.0, 0.0, 0.0, 0.0)),
    camera("plumb_bob", (-0.3, 0.1, 0.001, 0.001, 0.0)),
    CameraInfo(
        "kitti", 1392, 512, KITTI, "plumb_bob", (-0.3728755, 0.2037299, 0.0022190, 0.0013836, -0.0723)
    ),
    camera("rational_polynomial", (0.5, 0.1, 0.0, 0.0, 0.0, 0.6, 0.1, 0.0)),
    camera("equidistant", (0.05, -0.01, 0.002, 0.0)),
]
FOLDED = [
    camera("plumb_bob", (-0.6, 0.0, 0.0, 0.0, 0.0)),
    camera("plumb_bob", (0.0, 0.0, 0.0, 0.0, -5.0)),
    camera("rational_polynomial", (-0.9, 0.0, 0.0, 0.0, 0.0, -0.2, 0.0, 0.0)),
    camera("equidistant", (-0.9, 0.0, 0.0, 0.0)),
]


@pytest.mark.parametrize("info", GOOD, ids=lambda info: info.distortion_model)
def test_a_lens_that_is_taken_can_be_undone_up_to_the_corners(info):
    check_camera(info, "front.yaml", MapFileError)
    u, v = np.meshgrid(np.linspace(0, info.width - 1, 9), np.linspace(0, info.height - 1, 9))
    points = np.column_stack([u.ravel(), v.ravel()])
    np.testing.assert_allclose(distort_points(info, undistort_points(info, points)), points, atol=0.01)


@pytest.mark.parametrize("info", FOLDED, ids=lambda info: f"{info.distortion_model} {info.distortion[0]:g}")
def test_a_lens_that_folds_over_itself_within_the_image_is_refused(info):
    message = r"front\.yaml: distortion_coefficients: this lens folds over itself \d+ px .* reaches 40\d px"
    with pytest.raises(MapFileError, match=message):
        check_camera(info, "front.yaml", MapFileError)


def test_a_lens_that_folds_in_the_corners_only_is_warned_of(caplog):
    check_camera(camera("plumb_bob", (-0.35, 0.0, 0.0, 0.0, 0.0)), "front.yaml", MapFileError)
    (record,) = caplog.records
    assert "front.yaml: distortion_coefficients: this lens folds over itself 325 px" in record.getMessage()


def test_the_reach_of_a_lens_is_where_it_turns():
    # r - 0.6 r^3 is greatest at r = 1 / sqrt(1.8).
    turn = 1 / np.sqrt(1.8)
    assert lens_reach(FOLDED[0]) == pytest.approx(turn - 0.6 * turn**3, rel=1e-5)
    assert lens_reach(GOOD[0]) == np.inf


FORMS = [".png", ".tiff", ".bmp", ".webp", ".jpg"]


@pytest.fixture(scope="module")
def noise():
    """Pixels that no coder makes small."""
    return np.random.default_rng(1).integers(0, 256, (480, 640, 3), dtype=np.uint8)


@pytest.mark.parametrize("form", FORMS)
def test_a_large_image_has_the_size_that_its_header_says(form, noise, tmp_path):
    path = tmp_path / f"image{form}"
    cv2.imwrite(str(path), noise)
    assert path.stat().st_size > 1 << 18
    header = read_header(path)
    assert (header.height, header.width) == noise.shape[:2] == read_pixels(path, cv2.IMREAD_COLOR).shape[:2]


def test_a_jpeg_whose_frame_stands_after_much_else_is_read(noise, tmp_path):
    data = cv2.imencode(".jpg", noise)[1].tobytes()
    colours = b"\xff\xe2" + (60_002).to_bytes(2, "big") + bytes(60_000)
    path = tmp_path / "image.jpg"
    path.write_bytes(data[:2] + 8 * colours + data[2:])
    assert read_header(path).width == 640


def test_a_large_png_with_a_flipped_bit_is_refused_before_it_is_worked_on(noise, tmp_path):
    data = bytearray(cv2.imencode(".png", noise)[1].tobytes())
    data[len(data) // 2] ^= 1
    path = tmp_path / "image.png"
    path.write_bytes(data)
    with pytest.raises(DriveError, match="damaged"):
        read_pixels(path, cv2.IMREAD_COLOR)


def test_threads_that_read_images_leave_stderr_alone_and_blame_the_damaged_one(noise, tmp_path):
    whole = cv2.imencode(".jpg", noise)[1].tobytes()
    for number in range(40):
        cut = number == 20
        content = whole[: len(whole) // 2] + whole[-2:] if cut else whole
        (tmp_path / f"{number}.jpg").write_bytes(content)

    def is_read(number):
        try:
            return read_pixels(tmp_path / f"{number}.jpg", cv2.IMREAD_COLOR).shape == noise.shape
        except DriveError:
            return False

    before = os.fstat(2)
    with ThreadPoolExecutor(8) as readers:
        for _ in range(5):
            assert [k for k, read in enumerate(readers.map(is_read, range(40))) if not read] == [20]
    assert (os.fstat(2).st_dev, os.fstat(2).st_ino) == (before.st_dev, before.st_ino)


ROOT = Path(__file__).resolve().parents[1]
SIZES = "length_m: [0.8, 1.4], width_m: [0.4, 1.2]"


def written(folder, text):
    path = folder / "classes.yaml"
    path.write_text(text)
    return path


def test_own_classes_come_after_the_shipped_ones(tmp_path):
    text = f"classes:\n  parking_t: {{family: symbol, {SIZES}}}\n  pad: {{family: quadrilateral, {SIZES}}}\n"
    catalogue = load_catalogue(written(tmp_path, text))
    assert catalogue.names == (*PAINT_CLASSES, "parking_t", "pad")
    assert catalogue.cornered == (*CORNERED_CLASSES, "pad")
    assert catalogue.classes["pad"].group == "pad"
    assert catalogue.lane_paint == SHIPPED.lane_paint


def test_own_classes_survive_as_plain_data(tmp_path):
    text = f"classes:\n  pad: {{family: stripe, {SIZES}, softness: 0.1, group: stop_line}}\n"
    catalogue = load_catalogue(written(tmp_path, text))
    assert SHIPPED.with_own(own_entries(catalogue), "a file") == catalogue
    assert own_entries(SHIPPED) == {}


def test_the_catalogue_of_the_documentation_is_read():
    assert load_catalogue(ROOT / "docs" / "own-class" / "classes.yaml").names[-2:] == ("parking_t", "pad")


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        (
            f"pad: {{family: quadrilateral, {SIZES}}}\n  pad: {{family: stripe, {SIZES}}}",
            "'pad' appears twice",
        ),
        (
            f"pad: {{family: other, {SIZES}}}\n  Pad: {{family: other, {SIZES}}}",
            "'Pad' is already the name of 'pad'",
        ),
        (f"diamond: {{family: quadrilateral, {SIZES}}}", "'diamond' is already the name of 'diamond'"),
        (f"Stop_Line: {{family: stripe, {SIZES}}}", "'Stop_Line' is already the name of 'stop_line'"),
        (f"none: {{family: other, {SIZES}}}", "'none' is already the name of 'none'"),
        (f"lane_boundary: {{family: other, {SIZES}}}", "'lane_boundary'"),
        (f"../pad: {{family: other, {SIZES}}}", "letters, digits and underscores"),
        (f'"a pad": {{family: other, {SIZES}}}', "letters, digits and underscores"),
        (f"{'x' * 65}: {{family: other, {SIZES}}}", "at most 64"),
        (f"pad: {{family: circle, {SIZES}}}", "family of 'pad' is 'circle'"),
        (f"pad: {{family: line, {SIZES}}}", "'pad' would be lane paint"),
        (f"pad: {{family: stripe, {SIZES}, group: lane}}", "'pad' would be lane paint"),
        (f"pad: {{family: stripe, {SIZES}, group: pads}}", "group of 'pad' is 'pads'"),
        (f"pad: {{family: stripe, {SIZES}, group: [pad]}}", "give the name of a group"),
        (f"pad: {{family: stripe, {SIZES}, colour: red}}", "may have only family"),
        ("pad: {family: stripe, width_m: [1, 2]}", "length_m of 'pad' is nothing"),
        ("pad: {family: stripe, length_m: [2, 1], width_m: [1, 2]}", r"length_m of 'pad' is \[2, 1\]"),
        ("pad: {family: stripe, length_m: [a, b], width_m: [1, 2]}", "length_m of 'pad'"),
        ("pad: {family: stripe, length_m: [.nan, 1], width_m: [1, 2]}", "length_m of 'pad'"),
        ("pad: {family: stripe, length_m: 1.2, width_m: [1, 2]}", "length_m of 'pad'"),
        (f"pad: {{family: stripe, {SIZES}, softness: soft}}", "softness of 'pad'"),
        (f"pad: {{family: stripe, {SIZES}, softness: .inf}}", "softness of 'pad'"),
        (f"pad: {{family: stripe, {SIZES}, softness: 0}}", "softness of 'pad'"),
        ("pad: stripe", "'pad' may have"),
    ],
)
def test_a_wrong_entry_is_refused_in_one_line(tmp_path, entry, words):
    path = written(tmp_path, f"classes:\n  {entry}\n")
    with pytest.raises(ConfigError, match=words) as failure:
        load_catalogue(path)
    assert str(path) in str(failure.value)
    assert "\n" not in str(failure.value)


@pytest.mark.parametrize("text", ["", "classes:", "classes: [pad]", "- pad", "classes: {", "\x00"])
def test_a_file_that_is_no_catalogue_is_refused(tmp_path, text):
    with pytest.raises(ConfigError, match=r"classes\.yaml") as failure:
        load_catalogue(written(tmp_path, text))
    assert "\n" not in str(failure.value)
    with pytest.raises(ConfigError, match="no such file"):
        load_catalogue(tmp_path / "none.yaml")


def test_labels_have_room_for_all_classes(tmp_path):
    many = "".join(f"  c{n}: {{family: other, {SIZES}}}\n" for n in range(255))
    with pytest.raises(ConfigError, match="more than 254"):
        load_catalogue(written(tmp_path, "classes:\n" + many))


STANDARD_M = {
    "arrow": [(2.9, 0.6), (2.44, 0.9), (5.0, 0.75), (7.5, 0.9), (1.2, 0.5)],  # MUTCD, RMS-1, a car park's
    "diamond": [(0.54, 0.27), (1.2, 0.6), (3.7, 1.0)],  # yards, MUTCD
    "text": [(1.8, 1.2), (4.0, 2.6), (9.0, 5.0), (0.5, 0.3)],  # MUTCD, RMS-1, ICAO Annex 14, a bay's number
    "box": [(3.0, 3.0), (12.0, 8.0), (40.0, 20.0)],
    "bicycle": [(1.8, 1.0), (2.8, 1.0), (1.2, 0.75)],  # MUTCD's cycle and shared lane, a small one
}


@pytest.mark.parametrize("kind", STANDARD_M)
def test_markings_of_the_sizes_of_standards_are_of_likely_size(kind):
    length_m, width_m = np.array(STANDARD_M[kind]).T
    assert (SHIPPED.classes[kind].size_log_likelihood(length_m, width_m, whole=True) == 0).all()


def test_a_stub_of_a_double_line_is_of_no_size_of_a_diamond():
    assert SHIPPED.classes["diamond"].size_log_likelihood(0.5, 0.12, whole=True) < -1


def test_the_channels_of_older_networks_keep_their_classes():
    oldest = "diamond lane_dash lane_line arrow stop_line crosswalk_bar chevron other_paint"
    assert list(PAINT_CLASSES) == [*oldest.split(), "text", "box", "bicycle"]

"""Names of images and lists of times are read exactly, or refused."""

from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from v2hdm.errors import DriveError
from v2hdm.io.image_lists import image_order, read_image_list, read_stamps
from v2hdm.io.stamps import number_order, times_of_names

START_NS = 1_715_934_611_031_491_007
STEP_NS = 33_300_217
NS = [START_NS + STEP_NS * n for n in range(60)]


def padded(ns, digits, point="."):
    return f"{ns // 10**9}{point}{ns % 10**9:09d}"[: 10 + len(point) + digits]


def dated(ns, form, digits):
    return datetime.fromtimestamp(ns // 10**9, tz=UTC).strftime(form) + f"{ns % 10**9:09d}"[:digits]


@pytest.mark.parametrize(
    ("name", "unit", "resolution_s"),
    [
        (lambda ns: padded(ns, 9), None, 1e-9),
        (lambda ns: padded(ns, 6), "s", 1e-6),
        (lambda ns: padded(ns, 3), None, 1e-3),
        (lambda ns: repr(ns / 1e9), None, 1e-6),
        (lambda ns: padded(ns, 9, "_"), None, 1e-9),
        (lambda ns: f"left-{padded(ns, 6, '_')}", None, 1e-6),
        (lambda ns: padded(ns, 9, "-"), None, 1e-9),
        (lambda ns: padded(ns, 6, ","), None, 1e-6),
        (lambda ns: f"{ns // 10**9}.{ns % 10**9}", None, 1e-9),  # ROS's secs and nsecs without zeros
        (lambda ns: f"frame_{ns // 10**9}_{ns % 10**9}", None, 1e-9),
        (lambda ns: f"{ns}", None, 1e-9),
        (lambda ns: f"cam0_{ns}", None, 1e-9),
        (lambda ns: f"{NS.index(ns)}_{ns // 1000}", None, 1e-6),
        (lambda ns: f"{ns // 10**6}", "ms", 1e-3),
        (lambda ns: f"{ns // 10**6}", None, 1e-3),
        (lambda ns: dated(ns, "%Y%m%d_%H%M%S_", 3), "utc", 1e-3),
        (lambda ns: dated(ns, "IMG_%Y%m%d_%H%M%S", 3), "utc", 1e-3),
        (lambda ns: dated(ns, "%Y-%m-%dT%H-%M-%S.", 6) + "Z", None, 1e-6),
        (lambda ns: dated(ns, "%Y-%m-%d_%H_%M_%S.", 2), "utc", 1e-2),
        (lambda ns: dated(ns + 2 * 3600 * 10**9, "%Y-%m-%d %H.%M.%S.", 9) + "+0200", None, 1e-9),
        (lambda ns: dated(ns - 5400 * 10**9, "%Y-%m-%dT%H%M%S.", 6) + "-0130", None, 1e-6),
        (lambda ns: dated(ns + 9 * 3600 * 10**9, "%Y%m%d%H%M%S", 6), "utc+09:00", 1e-6),
    ],
)
def test_a_time_in_a_name_is_read_to_its_last_digit(name, unit, resolution_s):
    got = times_of_names([name(ns) for ns in NS], unit, "the images of f")
    # Doubles are 0.24 us apart at this time.
    np.testing.assert_array_less(np.abs(got - np.array(NS) / 1e9), resolution_s + 2.4e-7)


@pytest.mark.parametrize(
    ("names", "unit", "message"),
    [
        (["12.5", "12.75", "13.5"], None, "may be decimal"),
        (["12.9", "12.10", "12.11"], None, "may be decimal"),
        (["1e9", "1.1e9"], None, "not named by their times"),
        (["nan", "inf"], None, "not named by their times"),
        (["1_000", "1_001"], None, "not named by their times"),
        (["1715934611_1", "1715934611_2"], None, "may count images"),
        (["1715934611_001", "1715934611_002", "1715934612_001"], None, "may count images"),
        (["20240131_101530_001", "20240131_101530_002", "20240131_101531_001"], "utc", "may count images"),
        (["drive_20240131_101530_000010", "drive_20240131_101530_000020", "drive_20240131_101530_000030"],
         "utc", "may count images"),
        (["000000", "000001", "000002"], None, "may count them"),
        (["1715934611", "1715934612", "1715934614"], None, "may count them"),
        (["20240131_101530", "20240131_101531"], "utc", "whole seconds"),
        (["20240131_101530.25", "20240131_101530.75"], None, "state dates without a zone; add unit: utc"),
        (["20240131_101530.25", "20240131_101530.75"], "ms", "state dates without a zone"),
        (["2024-01-31T10-15-30.25Z", "2024-01-31T10-15-30.75"], None, "state their zone, some or all"),
        (["20240230_101530.25", "20240230_101530.75"], "utc", "not named by their times"),
        (["235958.200", "235959.900", "000000.100"], None, "times of day"),
        (["cam0_1715934611031491000", "cam1_1715934611031492000", "cam0_1715934611131491000"], None,
         "not named by their times"),
        (["left_1715934611.031491", "right_1715934611.131491"], None, "not named by their times"),
        (["1715934611031", "1715934611131"], "us", "since 1970 in ms"),
        (["1715934611031491007", "1715934611131"], None, "may count them|not named by"),
        (["65f0a3b2c1d4e5f6", "65f0a3b2c1d4e5f7"], None, "not named by their times"),
        (["１２.500", "１３.500"], None, "not named by their times"),
    ],
)  # fmt: skip
def test_a_name_that_may_mean_another_time_is_refused(names, unit, message):
    if unit == "us":
        names = [f"a{name}" for name in names]
    with pytest.raises(DriveError, match=message) as refused:
        times_of_names(names, unit, "the images of f")
    assert "\n" not in str(refused.value)


@given(st.permutations(range(1, 121)), st.sampled_from(["frame{}", "img_{}", "a1-{}.final", "{:02d}", "{}"]))
def test_numbers_in_names_are_sorted_as_numbers(numbers, form):
    names = [form.format(number) for number in numbers]
    assert [numbers[place] for place in number_order(names, "here")] == sorted(numbers)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["left_1", "left_2", "right_1", "right_2"], "differ in more than numbers"),
        (["cam0_1", "cam0_2", "cam1_1", "cam1_2"], "two cameras"),
        (["1_cam0", "1_cam1", "2_cam0", "2_cam1"], "two cameras"),
        (["t-2", "t-1", "t0", "t1"], "differ in more than numbers"),
        (["f8", "f9", "fa", "fb", "f10"], "differ in more than numbers"),
        (["img_0.5", "img_0.25"], "may be decimals"),
        (["DSC_9998", "DSC_9999", "DSC_0001"], "may begin again"),
        (["img_01", "img_1"], "have the same numbers"),
        (["a", "b"], "differ in more than numbers"),
        (["1 (1)", "1"], "differ in more than numbers"),
    ],
)
def test_names_that_leave_another_order_possible_are_refused(names, message):
    with pytest.raises(DriveError, match=message) as refused:
        number_order(names, "the images of f")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "names",
    [
        [f"20240131_1015{number}" for number in ("29_1", "30_1", "30_2", "30_10", "31_1")],
        ["1715934611_8", "1715934611_9", "1715934611_10"],
        ["G0019998", "G0019999", "G0020000"],
        ["1715934611.9", "1715934612.1", "1715934613.0"],
        ["rgb"],
    ],
)  # fmt: skip
def test_an_order_that_all_readings_of_names_agree_on_is_taken(names):
    assert [names[::-1][place] for place in number_order(names[::-1], "here")] == names


def test_times_that_are_late_repeat_or_are_none_are_sorted_dropped_and_counted(tmp_path, caplog):
    lines = ["0 z.jpg", "0.0 y.jpg", "100.0 a.jpg", "100.2 c.jpg", "100.1 b.jpg", "100.2 d.jpg"]
    lines += [f"{100.3 + 0.1 * n:.1f} e{n}.jpg" for n in range(9)]
    (tmp_path / "list.txt").write_text("\n".join(lines))
    listed = read_image_list(tmp_path / "list.txt")
    assert listed.names == ["a.jpg", "b.jpg", "c.jpg", *(f"e{n}.jpg" for n in range(9))]
    np.testing.assert_allclose(listed.stamp_s, 100 + 0.1 * np.arange(12))
    assert (
        "sorted lines that were late: 1, dropped lines whose time repeats: 1, dropped lines without a time: 2"
        in caplog.text
    )


def test_a_clock_that_begins_at_zero_keeps_its_first_image():
    assert image_order(np.array([0.0, 0.1, 0.2]), "here").tolist() == [0, 1, 2]
    assert image_order(np.array([0.0, 1e9, 1e9 + 0.1]), "here").tolist() == [1, 2]
    with pytest.raises(DriveError, match="2 of 3 images have no time"):
        image_order(np.array([0.0, 0.0, 1e9]), "here")


def test_images_of_two_cameras_or_of_two_clocks_in_one_are_refused():
    with pytest.raises(DriveError, match="the times of 5 of 10 images repeat; are they of two cameras"):
        image_order(np.repeat(np.arange(100.0, 105.0), 2), "here")
    with pytest.raises(
        DriveError, match=r"image 3: its time 7\.000000 s is 94\.000 s before that of image 2"
    ):
        image_order(np.array([100.0, 101.0, 7.0]), "here")


def test_a_list_of_seconds_and_nanoseconds_without_zeros_has_these_times(tmp_path):
    (tmp_path / "list.txt").write_text("".join(f"{ns // 10**9}.{ns % 10**9} {ns}.jpg\n" for ns in NS))
    listed = read_image_list(tmp_path / "list.txt")
    np.testing.assert_allclose(listed.stamp_s, np.array(NS) / 1e9, rtol=0, atol=1e-6)
    assert listed.names == [f"{ns}.jpg" for ns in NS]


def test_a_list_of_decimals_without_zeros_at_their_end_has_these_times(tmp_path):
    (tmp_path / "times.txt").write_text("100.133\n100.167\n100.2\n100.233\n100.267\n100.3\n")
    got = read_stamps(tmp_path / "times.txt", 6, "images")
    np.testing.assert_allclose(got, [100.133, 100.167, 100.2, 100.233, 100.267, 100.3], rtol=0, atol=1e-12)
    (tmp_path / "times.txt").write_text("1_0\n")
    with pytest.raises(DriveError, match="'1_0' is not a number"):
        read_stamps(tmp_path / "times.txt", 1, "images")


def test_timecodes_of_matroska_are_in_milliseconds(tmp_path):
    (tmp_path / "times.txt").write_text("# timecode format v2\n0.000\n33.333\n66.667\n")
    np.testing.assert_allclose(read_stamps(tmp_path / "times.txt", 3, "frames"), [0, 0.033333, 0.066667])


LISTS = {
    "EuRoC": "#timestamp [ns],filename\n{ns[0]},a b.png\n{ns[1]},c.png\n",
    "columns named": "timestamp,filename\r\n{s[0]},a b.png\r\n{s[1]},c.png\r\n",
    "semicolons, quotes": '{s[0]}; "a b.png"\n"{s[1]}";"c.png"\n',
    "blanks": "{s[0]} a b.png\n{s[1]}  c.png\n",
}


@pytest.mark.parametrize("form", LISTS)
def test_a_list_of_images_as_tools_write_it_has_its_times_and_names(form, tmp_path):
    stamps = ["1715934630.25", "1715934630.75"]
    whole = [text.replace(".", "").ljust(19, "0") for text in stamps]
    (tmp_path / "images.txt").write_text(LISTS[form].format(s=stamps, ns=whole), newline="")
    listed = read_image_list(tmp_path / "images.txt")
    np.testing.assert_allclose(listed.stamp_s, [float(text) for text in stamps], rtol=0, atol=5e-7)
    assert listed.names == ["a b.png", "c.png"]


def test_a_list_from_windows_names_its_folders_by_backslashes(tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.png").touch()
    (tmp_path / "b\\c.png").touch()  # a name that has a backslash itself
    (tmp_path / "images.txt").write_text("1.0 images\\a.png\n2.0 b\\c.png\n")
    assert read_image_list(tmp_path / "images.txt").names == ["images/a.png", "b\\c.png"]


def test_a_decimal_comma_in_a_list_is_named_and_no_separator(tmp_path):
    (tmp_path / "images.txt").write_text("100,05 a.png\n100,15 b.png\n")
    with pytest.raises(DriveError, match=r"line 1: '100,05' is not a number; write a decimal point"):
        read_image_list(tmp_path / "images.txt")


def test_times_in_a_file_may_count_nanoseconds_since_1970(tmp_path):
    (tmp_path / "times.txt").write_text("1715934630250000000\n1715934630750000000\n")
    np.testing.assert_allclose(
        read_stamps(tmp_path / "times.txt", 2, "images"), [1715934630.25, 1715934630.75], rtol=0, atol=5e-7
    )

"""The catalogue of classes: the shipped ones, a user's after them, and every mistake by name."""

from pathlib import Path

import pytest

from v2hdm.catalogue import CORNERED_CLASSES, PAINT_CLASSES, SHIPPED, load_catalogue
from v2hdm.errors import ConfigError

ROOT = Path(__file__).resolve().parents[1]
SIZES = "length_m: [0.8, 1.4], width_m: [0.4, 1.2]"


def written(folder: Path, text: str) -> Path:
    path = folder / "classes.yaml"
    path.write_text(text)
    return path


def test_own_classes_come_after_the_shipped_ones(tmp_path: Path) -> None:
    text = f"classes:\n  parking_t: {{family: symbol, {SIZES}}}\n  pad: {{family: quadrilateral, {SIZES}}}\n"
    catalogue = load_catalogue(written(tmp_path, text))
    assert catalogue.names == (*PAINT_CLASSES, "parking_t", "pad")
    assert catalogue.cornered == (*CORNERED_CLASSES, "pad")
    assert catalogue.classes["pad"].group == "pad"
    assert catalogue.lane_paint == SHIPPED.lane_paint


def test_own_classes_survive_as_plain_data(tmp_path: Path) -> None:
    text = f"classes:\n  pad: {{family: stripe, {SIZES}, softness: 0.1, group: stop_line}}\n"
    catalogue = load_catalogue(written(tmp_path, text))
    assert SHIPPED.with_own(catalogue.own_entries(), "a file") == catalogue
    assert SHIPPED.own_entries() == {}


def test_the_catalogue_of_the_documentation_is_read() -> None:
    assert load_catalogue(ROOT / "docs" / "own-class" / "classes.yaml").names[-2:] == ("parking_t", "pad")


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        (f"pad: {{family: quadrilateral, {SIZES}}}\n  pad: {{family: stripe, {SIZES}}}", "'pad' is there"),
        (f"pad: {{family: other, {SIZES}}}\n  Pad: {{family: other, {SIZES}}}", "'Pad' is the name of 'pad'"),
        (f"diamond: {{family: quadrilateral, {SIZES}}}", "'diamond' is the name of 'diamond' already"),
        (f"Stop_Line: {{family: stripe, {SIZES}}}", "'Stop_Line' is the name of 'stop_line' already"),
        (f"none: {{family: other, {SIZES}}}", "'none' is the name of 'none' already"),
        (f"lane_boundary: {{family: other, {SIZES}}}", "'lane_boundary'"),
        (f"../pad: {{family: other, {SIZES}}}", "letters, digits and underscores"),
        (f'"a pad": {{family: other, {SIZES}}}', "letters, digits and underscores"),
        (f"{'x' * 65}: {{family: other, {SIZES}}}", "64 at most"),
        (f"pad: {{family: circle, {SIZES}}}", "family of 'pad' is 'circle'"),
        (f"pad: {{family: line, {SIZES}}}", "'pad' would be paint of lanes"),
        (f"pad: {{family: stripe, {SIZES}, group: lane}}", "'pad' would be paint of lanes"),
        (f"pad: {{family: stripe, {SIZES}, group: pads}}", "group of 'pad' is 'pads'"),
        (f"pad: {{family: stripe, {SIZES}, group: [pad]}}", "give the name of a group"),
        (f"pad: {{family: stripe, {SIZES}, colour: red}}", "nothing else"),
        ("pad: {family: stripe, width_m: [1, 2]}", "length_m of 'pad' is nothing"),
        ("pad: {family: stripe, length_m: [2, 1], width_m: [1, 2]}", r"length_m of 'pad' is \[2, 1\]"),
        ("pad: {family: stripe, length_m: [a, b], width_m: [1, 2]}", "length_m of 'pad'"),
        ("pad: {family: stripe, length_m: [.nan, 1], width_m: [1, 2]}", "length_m of 'pad'"),
        ("pad: {family: stripe, length_m: 1.2, width_m: [1, 2]}", "length_m of 'pad'"),
        (f"pad: {{family: stripe, {SIZES}, softness: soft}}", "softness of 'pad'"),
        (f"pad: {{family: stripe, {SIZES}, softness: .inf}}", "softness of 'pad'"),
        ("pad: stripe", "'pad' may have"),
    ],
)
def test_a_wrong_entry_is_refused_in_one_line(tmp_path: Path, entry: str, words: str) -> None:
    path = written(tmp_path, f"classes:\n  {entry}\n")
    with pytest.raises(ConfigError, match=words) as failure:
        load_catalogue(path)
    assert str(path) in str(failure.value)
    assert "\n" not in str(failure.value)


@pytest.mark.parametrize("text", ["", "classes:", "classes: [pad]", "- pad", "classes: {", "\x00"])
def test_a_file_that_is_no_catalogue_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(ConfigError, match=r"classes\.yaml") as failure:
        load_catalogue(written(tmp_path, text))
    assert "\n" not in str(failure.value)
    with pytest.raises(ConfigError, match="no such file"):
        load_catalogue(tmp_path / "none.yaml")


def test_labels_have_room_for_all_classes(tmp_path: Path) -> None:
    many = "".join(f"  c{n}: {{family: other, {SIZES}}}\n" for n in range(255))
    with pytest.raises(ConfigError, match="more than 254"):
        load_catalogue(written(tmp_path, "classes:\n" + many))

"""Paint against its design: what is off is found, what all share is named, and nothing sure is wrong."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.asbuilt.site import DASH, layout, mapped, moved, turned
from v2hdm.asbuilt.comparison import compare_with_design
from v2hdm.asbuilt.decisions import Fate, Tolerances, decided
from v2hdm.asbuilt.design import Design, DesignShape
from v2hdm.asbuilt.ground import Mosaic, read_mosaic
from v2hdm.errors import MapFileError
from v2hdm.records import HDMap
from v2hdm.store.files import write_json
from v2hdm.store.names import MOSAIC_EXTENT, MOSAIC_PICTURE

TOLERANCE = Tolerances(0.05, 0.05)


def fates(comparison):
    return {finding.name: finding.fate for finding in comparison.findings}


def test_paint_as_designed_conforms():
    design = layout()
    comparison = compare_with_design(mapped(design.shapes, 1), design, TOLERANCE)
    assert comparison.conforms
    assert comparison.count(Fate.RIGHT) >= 0.98 * len(design.shapes)
    assert not comparison.misfit.is_significant


@pytest.mark.parametrize("seed", range(5))
def test_decisions_outside_the_guard_band_are_right_for_paint_that_is_off_by_known_amounts(seed):
    design = layout(8, 25)
    rng = np.random.default_rng(seed)
    painted = []
    conforms = {}
    clear = set()
    for shape in design.shapes:
        east_m, north_m = rng.uniform(-0.1, 0.1, 2) if rng.random() < 0.4 else (0.0, 0.0)
        painted.append(moved(shape, east_m, north_m))
        off_m = max(abs(east_m), abs(north_m))
        conforms[shape.name] = off_m <= TOLERANCE.place_m
        if abs(off_m - TOLERANCE.place_m) > 0.035:  # by four sigmas of the map
            clear.add(shape.name)
    comparison = compare_with_design(mapped(painted, seed), design, TOLERANCE)
    decided_ones = [finding for finding in comparison.findings if finding.fate in (Fate.RIGHT, Fate.OFF)]
    wrong = [
        finding.name for finding in decided_ones if (finding.fate is Fate.RIGHT) != conforms[finding.name]
    ]
    assert not wrong
    assert clear <= {finding.name for finding in decided_ones}


@pytest.mark.parametrize("seed", range(5))
def test_a_shift_of_the_whole_design_is_named_and_no_marking_is_blamed_for_it(seed):
    design = layout()
    rng = np.random.default_rng(100 + seed)
    shift = rng.uniform(-8, 8, 2)
    turn_deg = rng.uniform(-0.4, 0.4)
    shapes = [
        replace(shape, outline_map=turned(shape.outline_map, turn_deg) + shift) for shape in design.shapes
    ]
    middle = np.mean([shape.outline_map.mean(axis=0) for shape in shapes], axis=0)
    comparison = compare_with_design(mapped(design.shapes, seed), Design(tuple(shapes)), TOLERANCE)
    misfit = comparison.misfit
    assert misfit.is_significant
    assert comparison.count(Fate.OFF) == comparison.count(Fate.EXTRA) == 0
    assert np.rad2deg(misfit.motion.turn_rad) == pytest.approx(-turn_deg, abs=0.03)
    back = turned((middle - shift)[None], -turn_deg)[0]
    assert misfit.motion.apply(middle) == pytest.approx(back, abs=0.03)


def test_a_row_that_is_painted_aside_is_off_and_its_neighbours_are_not():
    design = layout()
    painted = [
        moved(shape, 0.0, 0.09) if shape.name.startswith("lane_dash 2/") else shape for shape in design.shapes
    ]
    comparison = compare_with_design(mapped(painted, 3), design, TOLERANCE)
    off = {name for name, fate in fates(comparison).items() if fate is Fate.OFF}
    assert off == {shape.name for shape in design.shapes if shape.name.startswith("lane_dash 2/")}
    (finding,) = [finding for finding in comparison.findings if finding.name == "lane_dash 2/7"]
    across = next(quantity for quantity in finding.quantities if quantity.name == "across")
    assert abs(across.value) == pytest.approx(0.09, abs=3 * across.sigma + 0.002)


def test_a_dash_that_is_too_short_is_named_by_its_length_unless_one_end_may_be_misread():
    design = layout()
    shorter = DASH * [0.9, 1.0]  # both ends 15 cm short
    one_end = DASH - np.where(DASH > 1, [0.3, 0.0], 0.0)
    names = {"lane_dash 0/3": shorter, "lane_dash 4/9": one_end}
    painted = [
        replace(shape, outline_map=names[shape.name] + shape.outline_map.mean(axis=0))
        if shape.name in names
        else shape
        for shape in design.shapes
    ]
    comparison = compare_with_design(mapped(painted, 4), design, TOLERANCE)
    finding_of = {finding.name: finding for finding in comparison.findings}
    assert finding_of["lane_dash 0/3"].fate is Fate.OFF
    length = next(
        quantity for quantity in finding_of["lane_dash 0/3"].quantities if quantity.name == "length"
    )
    assert length.fate is Fate.OFF
    assert length.value == pytest.approx(-0.3, abs=0.03)
    assert finding_of["lane_dash 4/9"].fate is Fate.UNSURE


def test_markings_that_the_design_does_not_have_are_extra():
    design = layout()
    comparison = compare_with_design(mapped(design.shapes, 5), Design(design.shapes[1:]), TOLERANCE)
    extra = [finding for finding in comparison.findings if finding.fate is Fate.EXTRA]
    assert [finding.id for finding in extra] == [1]
    assert not comparison.conforms


def ground(shapes, hidden=()):
    """A mosaic of bright paint on grey ground, without what is hidden."""
    rng = np.random.default_rng(0)
    grey = rng.normal(90, 3, (800, 4200)).astype(np.uint8)
    is_seen = np.ones(grey.shape, dtype=np.bool_)
    for shape in shapes:
        px = ((shape.outline_map - [-10, 30]) / [0.05, -0.05]).astype(np.int32)
        cv2.fillPoly(grey, [px], 190)
    for shape in hidden:
        column, row = ((shape.outline_map.mean(axis=0) - [-10, 30]) / [0.05, -0.05]).astype(int)
        is_seen[row - 60 : row + 60, column - 60 : column + 60] = False
    return Mosaic(grey, is_seen, -10.0, 30.0, 0.05)


def test_a_shape_is_missing_where_the_ground_is_bare_and_not_inspected_where_nothing_shows_it():
    design = layout()
    gone, hidden, unmapped = (design.shapes[k] for k in (7, 30, 45))
    painted = [shape for shape in design.shapes if shape not in (gone, hidden, unmapped)]
    mosaic = ground([*painted, unmapped], hidden=[hidden])
    comparison = compare_with_design(mapped(painted, 6), design, TOLERANCE, mosaic)
    fate_of = fates(comparison)
    assert fate_of[gone.name] is Fate.MISSING
    assert fate_of[hidden.name] is fate_of[unmapped.name] is Fate.NOT_INSPECTED
    assert comparison.count(Fate.MISSING) == 1


def test_without_a_picture_of_the_ground_nothing_counts_as_missing():
    design = layout()
    comparison = compare_with_design(mapped(design.shapes[1:], 6), design, TOLERANCE)
    assert fates(comparison)[design.shapes[0].name] is Fate.NOT_INSPECTED


def test_a_design_of_another_place_is_refused_and_swapped_axes_are_named():
    design = layout()
    hd_map = mapped([moved(shape, 4000.0, 9000.0) for shape in design.shapes], 1)
    with pytest.raises(MapFileError, match="from the map's markings; check its system and its units"):
        compare_with_design(hd_map, design, TOLERANCE)
    swapped = [
        replace(moved(shape, 4000.0, 9000.0), outline_map=moved(shape, 4000.0, 9000.0).outline_map[:, ::-1])
        for shape in design.shapes
    ]
    with pytest.raises(MapFileError, match="its axes are swapped"):
        compare_with_design(hd_map, Design(tuple(swapped)), TOLERANCE)


def test_a_design_in_feet_is_refused():
    design = layout()
    feet = Design(tuple(replace(shape, outline_map=shape.outline_map / 0.3048) for shape in design.shapes))
    with pytest.raises(MapFileError, match=r"shapes .* lie on markings of the map; check .* units"):
        compare_with_design(mapped(design.shapes, 1), feet, TOLERANCE)


@pytest.mark.parametrize(
    ("outline", "says"),
    [
        ([[0, 0], [1, 1], [1, 0], [0, 1]], "encloses nothing"),
        ([[0, 0], [3, 3], [3, 0], [0, 1]], "crosses itself"),
        ([[0, 0], [1, 0], [2, 0]], "encloses nothing"),
    ],
)
def test_a_shape_that_is_none_is_refused_by_its_name(outline, says):
    design = layout()
    broken = Design((*design.shapes, DesignShape("K7", "diamond", np.array(outline, dtype=float))))
    with pytest.raises(MapFileError, match=f"K7.* {says}|K7 {says}"):
        compare_with_design(mapped(design.shapes, 1), broken, TOLERANCE)


def test_an_empty_map_and_an_empty_design_are_refused():
    design = layout()
    with pytest.raises(MapFileError, match="no closed shapes"):
        compare_with_design(mapped(design.shapes, 1), Design(()), TOLERANCE)
    with pytest.raises(MapFileError, match="the map has no marking"):
        compare_with_design(HDMap(()), design, TOLERANCE)


def test_a_decision_has_a_guard_band():
    assert decided(0.995) is Fate.RIGHT
    assert decided(0.005) is Fate.OFF
    assert decided(0.9) is decided(0.1) is Fate.UNSURE


def test_the_mosaic_of_a_folder_is_read_with_what_it_does_not_show(tmp_path):
    assert read_mosaic(tmp_path) is None
    picture = np.full((20, 40, 4), 200, np.uint8)
    picture[:, :10, 3] = 0
    cv2.imwrite(str(tmp_path / MOSAIC_PICTURE), picture)
    write_json(tmp_path / MOSAIC_EXTENT, {"bounds_m": [0, 0, 4, 2], "resolution_m": 0.1})
    mosaic = read_mosaic(tmp_path)
    assert mosaic.grey.shape == mosaic.is_seen.shape == (20, 40)
    assert not mosaic.is_seen[:, :10].any()
    write_json(tmp_path / MOSAIC_EXTENT, {"bounds_m": [0, 0, 4, 2], "resolution_m": 0})
    with pytest.raises(MapFileError, match="resolution_m is not positive"):
        read_mosaic(tmp_path)

"""Drawings (DXF) as CAD programs make them: every way to draw a dash of paint gives the same outline."""

from dataclasses import replace

import numpy as np
import pytest

from tests.asbuilt.site import layout, mapped
from v2hdm.asbuilt.drawing import UNITS_M, read_drawing, units_per_system
from v2hdm.asbuilt.reading import Source, read_design
from v2hdm.errors import MapFileError
from v2hdm.geometry.geodetic import geodetic_from_enu
from v2hdm.records import GeodeticOrigin

ezdxf = pytest.importorskip("ezdxf", reason="no ezdxf: pip install 'v2hdm[gis]'")
pytest.importorskip("shapely", reason="no shapely: pip install 'v2hdm[gis]'")

DASH = [(10.0, 5.0), (13.0, 5.0), (13.0, 5.12), (10.0, 5.12)]
PAINT = {"layer": "lane_dash"}


def polyline(space):
    space.add_lwpolyline(DASH, close=True, dxfattribs=PAINT)


def polyline_3d(space):
    space.add_polyline3d([(*corner, 7.0) for corner in DASH], close=True, dxfattribs=PAINT)


def closed_by_its_last_vertex(space):
    space.add_lwpolyline([*DASH, DASH[0]], dxfattribs=PAINT)


def wide_line(space):
    space.add_lwpolyline([(10.0, 5.06), (13.0, 5.06)], dxfattribs=PAINT | {"const_width": 0.12})


def hatch(space):
    space.add_hatch(dxfattribs=PAINT).paths.add_polyline_path(DASH, is_closed=True)


def hatch_with_its_border(space):
    hatch(space)
    polyline(space)


def solid(space):
    space.add_solid([DASH[0], DASH[1], DASH[3], DASH[2]], dxfattribs=PAINT)


def face(space):
    space.add_3dface([(*corner, 1.0) for corner in DASH], dxfattribs=PAINT)


def seen_from_below(space):
    mirrored = [(-x, y) for x, y in DASH]
    space.add_lwpolyline(mirrored, close=True, dxfattribs=PAINT | {"extrusion": (0, 0, -1)})


def block(space):
    """Turned by 90 degrees, within another block, on layer 0, so that the insert's layer counts."""
    dash = space.doc.blocks.new("dash")
    dash.add_lwpolyline([(0, 0), (0, -3), (0.12, -3), (0.12, 0)], close=True, dxfattribs={"layer": "0"})
    pair = space.doc.blocks.new("pair")
    pair.add_blockref("dash", (1.0, 0.0), dxfattribs={"layer": "0", "rotation": 90})
    space.add_blockref("pair", (9.0, 5.0), dxfattribs=PAINT)


WAYS = [
    polyline, polyline_3d, closed_by_its_last_vertex, wide_line, hatch, hatch_with_its_border, solid, face,
    seen_from_below, block,
]  # fmt: skip


@pytest.fixture(scope="module")
def hd_map():
    return mapped(layout(1, 3).shapes, 1)


def saved(path, draw, units=6):
    document = ezdxf.new("R2010", units=units)
    draw(document.modelspace())
    document.saveas(path)
    return path


def corners(outline):
    return sorted(map(tuple, (np.round(outline, 6) + 0.0).tolist()))


@pytest.mark.parametrize("draw", WAYS)
def test_a_dash_is_the_same_however_it_is_drawn(draw, tmp_path, hd_map):
    design = read_design(saved(tmp_path / "a.dxf", draw), hd_map, Source(crs="local"))
    (shape,) = design.shapes
    assert shape.kind == "lane_dash"
    assert corners(shape.outline_map) == corners(np.array(DASH))
    assert design.lines == 0


def test_arcs_of_polylines_are_followed_within_a_millimetre(tmp_path):
    """A stadium: a square of 1 m with half a disc on two sides, drawn by bulges of 1."""

    def draw(space):
        space.add_lwpolyline([(0, 0, 0), (1, 0, 1), (1, 1, 0), (0, 1, 1)], format="xyb", close=True)

    (area,) = read_drawing(saved(tmp_path / "a.dxf", draw), None).areas
    right = area.outline[area.outline[:, 0] >= 1.0]
    assert np.linalg.norm(right - [1.0, 0.5], axis=1) == pytest.approx(0.5, abs=1e-3)
    assert np.ptp(area.outline, axis=0) == pytest.approx([2.0, 1.0], abs=1e-3)


def test_holes_of_a_hatch_are_no_shapes_and_its_islands_are(tmp_path):
    """A diagonal stripe within the extent of another one is an area; a ring's inner border is a hole."""

    def draw(space):
        paths = space.add_hatch(dxfattribs=PAINT).paths
        paths.add_polyline_path([(0, 0), (10, 10), (10, 11), (0, 1)], is_closed=True)
        paths.add_polyline_path([(6, 2), (8, 4), (8, 5), (6, 3)], is_closed=True)
        paths.add_polyline_path([(20, 0), (24, 0), (24, 4), (20, 4)], is_closed=True)
        paths.add_polyline_path([(21, 1), (23, 1), (23, 3), (21, 3)], is_closed=True)

    areas = read_drawing(saved(tmp_path / "a.dxf", draw), None).areas
    assert sorted(area.outline[0].tolist() for area in areas) == [[0, 0], [6, 2], [20, 0]]


def test_what_only_cad_can_read_is_named(tmp_path, hd_map, caplog):
    def draw(space):
        polyline(space)
        with space.add_mesh(dxfattribs=PAINT).edit_data() as data:
            data.vertices = [(*corner, 0.0) for corner in DASH]
            data.faces = [(0, 1, 2, 3)]
        space.add_line((0, 0), (5, 5))

    design = read_design(saved(tmp_path / "a.dxf", draw), hd_map, Source(crs="local"))
    assert (len(design.shapes), design.lines) == (1, 1)
    assert "left out 1 MESH, whose outlines only CAD can read" in caplog.text


def test_blocks_that_multiply_are_refused(tmp_path):
    def draw(space):
        polyline(space.doc.blocks.new("b0"))
        for level in range(1, 9):
            inner = space.doc.blocks.new(f"b{level}")
            for k in range(10):
                inner.add_blockref(f"b{level - 1}", (20.0 * k, 0.0))
        space.add_blockref("b8", (0.0, 0.0))

    from v2hdm.asbuilt import drawing

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drawing, "_MOST_ENTITIES", 500)
        with pytest.raises(MapFileError, match="has more than 500 entities with its blocks"):
            read_drawing(saved(tmp_path / "a.dxf", draw), None)


@pytest.mark.parametrize("units", [2, 21])
def test_a_drawing_in_feet_lies_right_in_a_grid_of_feet(units, tmp_path, hd_map):
    """EPSG:2263 counts US survey feet from 300 km west; programs state either foot for them."""
    pyproj = pytest.importorskip("pyproj", reason="no pyproj: pip install 'v2hdm[map]'")
    origin = GeodeticOrigin(40.7, -73.9, 10.0, "NAD83")
    meant = np.array(DASH)
    places = geodetic_from_enu(origin, np.column_stack([meant, np.zeros(4)]))
    grid = pyproj.Transformer.from_crs("EPSG:4269", "EPSG:2263", always_xy=True)
    feet = np.column_stack(grid.transform(places[:, 1], places[:, 0]))

    def draw(space):
        space.add_lwpolyline(feet.tolist(), close=True, dxfattribs=PAINT)

    path = saved(tmp_path / "a.dxf", draw, units)
    (shape,) = read_design(path, replace(hd_map, origin=origin), Source(crs="EPSG:2263")).shapes
    assert shape.outline_map == pytest.approx(meant, abs=2e-3)


def test_units_of_a_drawing_become_those_of_its_system():
    assert units_per_system("mm", 1.0) == 1e-3
    assert units_per_system("m", UNITS_M["us-ft"]) == pytest.approx(3937 / 1200)
    assert units_per_system("in", UNITS_M["ft"]) == pytest.approx(1 / 12)

"""Designs of other programs: every format gives the same shapes, and what a file does not say is asked."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.asbuilt.site import layout, mapped
from v2hdm.asbuilt.opendrive import outlines_of
from v2hdm.asbuilt.reading import Source, read_design
from v2hdm.errors import ConfigError, MapFileError, V2hdmError
from v2hdm.geometry.datums import utm_of
from v2hdm.io.maps.formats import write_map
from v2hdm.records import GeodeticOrigin

ORIGIN = GeodeticOrigin(53.54, 9.93, 12.0)


@pytest.fixture(scope="module")
def hd_map():
    return replace(mapped(layout(3, 6).shapes, 1), origin=ORIGIN)


@pytest.fixture(scope="module")
def folder(hd_map, tmp_path_factory):
    """The map's paint as files of a design."""
    pytest.importorskip("ezdxf", reason="no ezdxf: pip install 'v2hdm[gis]'")
    pytest.importorskip("pyogrio", reason="no pyogrio: pip install 'v2hdm[gis]'")
    out = tmp_path_factory.mktemp("designs")
    formats = ["geojson", "gpkg", "dxf", "opendrive"]
    write_map(hd_map, out, "site", formats, None, None, utm_of(ORIGIN), [])
    return out


def foreign(path, hd_map, crs=None, **properties):
    """The map's markings as GeoJSON of another program."""
    from v2hdm.geometry.geodetic import geodetic_from_enu

    features = []
    for marking in hd_map.markings:
        raised = np.column_stack([marking.corners_map, np.zeros(4)])
        positions = geodetic_from_enu(ORIGIN, raised)[:, [1, 0]] if crs is None else marking.corners_map
        ring = [*positions.tolist(), positions[0].tolist()]
        stated = {"Class": marking.kind, **properties}
        geometry = {"type": "Polygon", "coordinates": [ring]}
        features.append({"type": "Feature", "geometry": geometry, "properties": stated})
    content = {"type": "FeatureCollection", "features": features}
    if crs is not None:
        content["crs"] = {"type": "name", "properties": {"name": crs}}
    path.write_text(json.dumps(content))
    return path


def outlines(design):
    return sorted((shape.kind, *np.round(shape.outline_map.mean(axis=0), 3)) for shape in design.shapes)


def of_map(hd_map):
    return sorted(
        (marking.kind, *np.round(marking.corners_map.mean(axis=0), 3)) for marking in hd_map.markings
    )


@pytest.mark.parametrize("name", ["site.geojson", "site.gpkg", "site.dxf", "site.xodr"])
def test_a_design_in_any_format_lies_where_it_was_drawn(name, folder, hd_map):
    design = read_design(folder / name, hd_map)
    for read, drawn in zip(outlines(design), of_map(hd_map), strict=True):
        assert read[0] == drawn[0]
        assert read[1:] == pytest.approx(drawn[1:], abs=2e-3)


def test_geojson_of_other_programs_is_in_longitude_and_latitude(tmp_path, hd_map):
    design = read_design(foreign(tmp_path / "a.geojson", hd_map), hd_map)
    for read, drawn in zip(outlines(design), of_map(hd_map), strict=True):
        assert read[1:] == pytest.approx(drawn[1:], abs=2e-3)


@pytest.mark.parametrize("name", ["urn:ogc:def:crs:OGC:1.3:CRS84", "OGC:CRS84", "urn:ogc:def:crs:EPSG::4326"])
def test_geojson_of_qgis_and_gdal_names_its_system_and_is_on_wgs84(name, tmp_path, hd_map):
    path = foreign(tmp_path / "a.geojson", hd_map)
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | {"crs": {"type": "name", "properties": {"name": name}}}))
    design = read_design(path, hd_map)
    for read, drawn in zip(outlines(design), of_map(hd_map), strict=True):
        assert read[1:] == pytest.approx(drawn[1:], abs=2e-3)


def test_a_geopackage_of_other_programs_is_in_the_system_of_its_layer(tmp_path, hd_map):
    geopandas = pytest.importorskip("geopandas", reason="no geopandas: pip install 'v2hdm[gis]'")
    frame = geopandas.read_file(foreign(tmp_path / "a.geojson", hd_map)).to_crs("EPSG:25832")
    frame.to_file(tmp_path / "a.gpkg", layer="paint", driver="GPKG")
    etrs = replace(hd_map, origin=replace(ORIGIN, datum="ETRS89"))
    design = read_design(tmp_path / "a.gpkg", etrs)
    for read, drawn in zip(outlines(design), of_map(hd_map), strict=True):
        assert read[1:] == pytest.approx(drawn[1:], abs=2e-3)
    with pytest.raises(MapFileError, match=r"is on ETRS89 .*, the map on WGS84, which differ by decimetres"):
        read_design(tmp_path / "a.gpkg", hd_map)


def test_names_that_are_no_classes_are_left_out_unless_they_are_explained(tmp_path, hd_map, caplog):
    path = foreign(tmp_path / "a.geojson", hd_map, Class="MARK 02")
    with pytest.raises(MapFileError, match=r"unknown classes: 'MARK 02' .18.; --class NAME=CLASS"):
        read_design(path, hd_map)
    design = read_design(path, hd_map, Source(kinds={"MARK 02": "diamond"}))
    assert {shape.kind for shape in design.shapes} == {"diamond"}
    with pytest.raises(ConfigError, match="--class MARK 02='diamnd': is not a class; choose from"):
        read_design(path, hd_map, Source(kinds={"MARK 02": "diamnd"}))


def test_shapes_without_a_name_may_be_of_any_class(tmp_path, hd_map):
    path = foreign(tmp_path / "a.geojson", hd_map, Class=None)
    assert {shape.kind for shape in read_design(path, hd_map).shapes} == {None}


def test_a_drawing_that_does_not_state_its_unit_or_system_is_asked_for_them(tmp_path, hd_map):
    ezdxf = pytest.importorskip("ezdxf", reason="no ezdxf: pip install 'v2hdm[gis]'")
    document = ezdxf.new("R2010", units=0)
    document.modelspace().add_lwpolyline(
        [(0, 0), (3000, 0), (3000, 120), (0, 120)], close=True, dxfattribs={"layer": "lane_dash"}
    )
    document.modelspace().add_line((0, 0), (5, 5))
    document.saveas(tmp_path / "site.dxf")
    with pytest.raises(ConfigError, match="does not state its unit; give --unit"):
        read_design(tmp_path / "site.dxf", hd_map)
    with pytest.raises(ConfigError, match="does not say what its coordinates count from; give --crs"):
        read_design(tmp_path / "site.dxf", hd_map, Source(unit="mm"))
    with pytest.raises(ConfigError, match="--unit 'furlong': is not a unit"):
        read_design(tmp_path / "site.dxf", hd_map, Source(unit="furlong"))
    design = read_design(tmp_path / "site.dxf", hd_map, Source(unit="mm", crs="local"))
    (shape,) = design.shapes
    assert np.ptp(shape.outline_map, axis=0) == pytest.approx([3.0, 0.12])


BEND = """<OpenDRIVE><header/><road id="1" length="40"><planView>
<geometry s="0" x="0" y="0" hdg="0" length="10"><line/></geometry>
<geometry s="10" x="10" y="0" hdg="0" length="15.707963267948966"><arc curvature="0.1"/></geometry>
<geometry s="25.707963267948966" x="20" y="10" hdg="1.5707963267948966" length="5">
<paramPoly3 pRange="normalized" aU="0" bU="5" cU="0" dU="0" aV="0" bV="0" cV="1" dV="0"/></geometry>
</planView><objects>
<object id="7" name="diamond" s="5" t="2" hdg="0.5"><outline>
<cornerLocal u="1" v="0" z="0"/><cornerLocal u="0" v="1" z="0"/><cornerLocal u="-1" v="0" z="0"/>
</outline></object>
<object id="8" name="stop_line" s="0" t="0"><outlines><outline>
<cornerRoad s="17.853981633974483" t="0"/><cornerRoad s="25.707963267948966" t="-1"/>
<cornerRoad s="30.707963267948966" t="0"/>
</outline></outlines></object></objects></road></OpenDRIVE>"""


def test_outlines_of_opendrive_follow_lines_arcs_and_polynomials(tmp_path):
    path = tmp_path / "bend.xodr"
    path.write_text(BEND)
    local, on_road = outlines_of(path).outlines
    cos, sin = np.cos(0.5), np.sin(0.5)
    assert local.positions == pytest.approx(
        np.array([[5 + cos, 2 + sin], [5 - sin, 2 + cos], [5 - cos, 2 - sin]]), abs=1e-9
    )
    root = 10 * np.sqrt(0.5)
    # 45 degrees around the arc; its end, one to the right; and the polynomial's end, one to the left.
    assert on_road.positions == pytest.approx(
        np.array([[10 + root, 10 - root], [21, 10], [19, 15]]), abs=1e-4
    )


def objects(header, *entries):
    road = '<geometry s="0" x="0" y="0" hdg="0" length="100"><line/></geometry>'
    return (
        f"<OpenDRIVE><header>{header}</header><road id='1' length='100'><planView>{road}</planView>"
        f"<objects>{''.join(entries)}</objects></road></OpenDRIVE>"
    )


def middles(outlines):
    return [(outline.called, *np.round(outline.positions.mean(axis=0), 6).tolist()) for outline in outlines]


def test_flat_objects_without_an_outline_are_boxes_and_may_be_repeated(tmp_path):
    """Dashes every 9 m on 20 m, of which the lateral place changes by 2 m; a post and a barrier are none."""
    (tmp_path / "a.xodr").write_text(
        objects(
            "",
            '<object id="1" name="stop_line" s="10" t="-1" hdg="0" length="0.3" width="3"/>',
            '<object id="2" name="lane_dash" s="0" t="0" length="3" width="0.12">'
            '<repeat s="40" length="20" distance="9" tStart="1" tEnd="3"/></object>',
            '<object id="3" name="post" s="0" t="0" length="0.2" width="0.2" height="1.5"/>',
            '<object id="4" name="barrier" s="0" t="0" length="3" width="0.3">'
            '<repeat s="0" length="100" distance="0"/></object>',
        )
    )
    read = outlines_of(tmp_path / "a.xodr").outlines
    assert middles(read) == [
        ("stop_line", 10.0, -1.0),
        ("lane_dash", 40.0, 1.0),
        ("lane_dash", 49.0, 1.9),
        ("lane_dash", 58.0, 2.8),
    ]
    assert np.ptp(read[0].positions, axis=0) == pytest.approx([0.3, 3.0])
    assert np.ptp(read[1].positions, axis=0) == pytest.approx([3.0, 0.12])


def test_inner_outlines_of_an_object_are_holes(tmp_path):
    corners = '<cornerLocal u="0" v="0"/><cornerLocal u="1" v="0"/><cornerLocal u="0" v="1"/>'
    rings = [f"<outline outer='{outer}'>{corners}</outline>" for outer in ("true", "false")]
    box = f"<object id='1' name='box' s='0' t='0'><outlines>{''.join(rings)}</outlines></object>"
    (tmp_path / "a.xodr").write_text(objects("", box))
    assert len(outlines_of(tmp_path / "a.xodr").outlines) == 1


def test_the_offset_of_a_header_leads_from_the_file_to_its_system(tmp_path, hd_map):
    """As SUMO writes it: a UTM zone, and coordinates from a point in it; turned by a right angle."""
    from v2hdm.geometry.geodetic import Grid

    zone = utm_of(ORIGIN)
    east, north, _ = Grid.of(zone, ORIGIN, "test", MapFileError).positions(np.zeros((1, 3)))[0]
    header = (
        "<geoReference>+proj=utm +zone=32 +datum=WGS84 +units=m +no_defs +type=crs</geoReference>"
        f'<offset x="{east}" y="{north}" z="0" hdg="1.5707963267948966"/>'
    )
    box = '<object id="1" name="lane_dash" s="30" t="0" length="3" width="0.12"/>'
    (tmp_path / "a.xodr").write_text(objects(header, box))
    (shape,) = read_design(tmp_path / "a.xodr", hd_map).shapes
    place = Grid.of(zone, ORIGIN, "test", MapFileError).positions(
        np.array([[*shape.outline_map.mean(axis=0), 0]])
    )
    assert place[0, :2] == pytest.approx([east, north + 30], abs=1e-3)
    (shape,) = read_design(tmp_path / "a.xodr", hd_map, Source(crs="local")).shapes
    assert shape.outline_map.mean(axis=0) == pytest.approx([30, 0])


def test_a_system_that_names_no_datum_is_on_the_map_s(tmp_path, hd_map, caplog):
    """As German OpenDRIVE files state ETRS89 by its ellipsoid, and as we write that of a map."""
    etrs = replace(hd_map, origin=replace(ORIGIN, datum="ETRS89"))
    zone = "+proj=utm +zone=32 +ellps=GRS80 +towgs84=0,0,0,0,0,0,0 +units=m +no_defs"
    header = f"<geoReference>{zone}</geoReference><offset x='561640' y='5932800' z='0' hdg='0'/>"
    box = '<object id="1" name="lane_dash" s="30" t="0" length="3" width="0.12"/>'
    (tmp_path / "a.xodr").write_text(objects(header, box))
    (shape,) = read_design(tmp_path / "a.xodr", etrs).shapes
    assert "a.xodr: its system names no datum: taken to be on the map's, ETRS89" in caplog.text
    named = read_design(tmp_path / "a.xodr", etrs, Source(crs="EPSG:25832")).shapes[0]
    assert shape.outline_map == pytest.approx(named.outline_map, abs=1e-6)
    write_map(etrs, tmp_path, "site", ["opendrive"], None, None, None, [])
    assert "+datum" not in (tmp_path / "site.xodr").read_text()
    for read, drawn in zip(outlines(read_design(tmp_path / "site.xodr", etrs)), of_map(etrs), strict=True):
        assert read[1:] == pytest.approx(drawn[1:], abs=2e-3)


def test_a_spiral_ends_where_fresnel_says(tmp_path):
    from scipy.special import fresnel

    text = BEND.replace('<arc curvature="0.1"/>', '<spiral curvStart="0" curvEnd="0.1"/>')
    (tmp_path / "s.xodr").write_text(text.replace('s="25.707963267948966" t="-1"', 's="25.7079632" t="0"'))
    end = outlines_of(tmp_path / "s.xodr").outlines[1].positions[1]
    length = 15.707963267948966
    scale = np.sqrt(np.pi * length / 0.1)
    sine, cosine = fresnel(length / scale)
    assert end == pytest.approx([10 + scale * cosine, scale * sine], abs=1e-4)


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("a.geojson", "{}", "is not a collection of features"),
        ("a.geojson", "[1]", "expected a JSON object"),
        ("a.xodr", "<OpenDRIVE>", "is not readable XML"),
        ("a.xodr", "<kml/>", "is not an OpenDRIVE file"),
        ("a.xodr", "<!DOCTYPE a><OpenDRIVE/>", "declares a document type"),
        ("a.xodr", BEND.replace('curvature="0.1"', 'curvature="x"'), "road 1: could not convert"),
        ("a.xodr", BEND.replace('hdg="0"', 'hdg="nan"'), "road 1: hdg of a geometry is not finite"),
        ("a.gpkg", "nothing", "not a GeoPackage"),
        ("a.dxf", "nothing", "is not a readable drawing"),
        ("a.pdf", "", "is not a readable design; give a file that ends in .geojson"),
    ],
)
def test_files_that_are_no_designs_are_refused_in_one_line(name, text, says, tmp_path, hd_map):
    (tmp_path / name).write_text(text)
    with pytest.raises(V2hdmError, match=says):
        read_design(tmp_path / name, hd_map)


def test_coordinates_that_are_no_degrees_are_refused(tmp_path, hd_map):
    path = foreign(tmp_path / "a.geojson", hd_map, crs="EPSG:4326")
    text = path.read_text().replace('"coordinates": [[[', '"coordinates": [[[500000.0, 5900000.0], [')
    path.write_text(text)
    with pytest.raises(MapFileError, match="is not a longitude and latitude; are its axes swapped"):
        read_design(path, hd_map)


def test_a_map_without_an_origin_takes_designs_in_its_own_frame_only(tmp_path, hd_map):
    path = foreign(tmp_path / "a.geojson", hd_map)
    with pytest.raises(
        MapFileError, match="the map has no origin on the earth; give a design in the map's frame"
    ):
        read_design(path, replace(hd_map, origin=None))

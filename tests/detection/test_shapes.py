"""Quadrilaterals, their coverage, blobs, patches and views: what fits and judge stand on."""

import cv2
import numpy as np
import pytest

from tests.detection.pictures import LENSES, bar, diamond, make_camera, output_of, picture, to_image, view_of
from v2hdm.catalogue import PAINT_CLASSES, SHIPPED
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.evidence import CHANNELS, SIZE
from v2hdm.detection.network import NetworkOutput
from v2hdm.detection.quads.blobs import Blob, find_blobs
from v2hdm.detection.quads.coverage import blurred_coverage
from v2hdm.detection.quads.outline import on_edges, outline_polygon
from v2hdm.detection.quads.patch import ImageQuads, LensFrames
from v2hdm.detection.quads.propose import Proposal
from v2hdm.geometry.planar import Quad, order_corners, side_frames, signed_area
from v2hdm.records import DIAMOND, LANE_DASH

KITE = order_corners(np.array([[20.3, 10.2], [40.1, 14.9], [19.4, 19.3], [3.2, 15.5]]))


def output_of_labels(labels, top=0):
    """The output of a confident network for a label picture (h, w) at the resolution of its paint."""
    paint = np.where(labels > 0, 5.0, -5.0).astype(np.float32)
    kinds = np.stack([np.where(labels == 1 + c, 5.0, -5.0) for c in range(len(PAINT_CLASSES))])
    coarse = kinds.reshape(len(kinds), labels.shape[0] // 2, 2, labels.shape[1] // 2, 2).mean(axis=(2, 4))
    return NetworkOutput.of(paint, coarse.astype(np.float32), [], tuple(PAINT_CLASSES), 2, top)


def lattice(columns, rows):
    """Pixel centres (1, 3, N) as the coverage takes them."""
    u, v = np.meshgrid(np.arange(columns), np.arange(rows))
    return np.stack([u.ravel(), v.ravel(), np.ones(u.size)])[None].astype(np.float32)


def test_blurred_coverage_is_that_of_a_finely_drawn_and_blurred_shape():
    blur_px, fine = 0.7, 15
    u, v = np.meshgrid((np.arange(45 * fine) + 0.5) / fine - 0.5, (np.arange(28 * fine) + 0.5) / fine - 0.5)
    normal = side_frames(KITE).normal
    offset = np.stack([u, v], axis=-1)[:, :, None] - KITE
    drawn = ((offset * normal).sum(axis=-1) < 0).all(axis=-1).astype(np.float32)
    drawn = cv2.GaussianBlur(drawn, (0, 0), blur_px * fine)[fine // 2 :: fine, fine // 2 :: fine]
    coverage, _ = blurred_coverage(Quad(KITE[None]), lattice(45, 28), blur_px)
    np.testing.assert_allclose(coverage.reshape(28, 45), drawn, atol=4e-3)
    assert coverage.sum() == pytest.approx(-signed_area(KITE), rel=1e-4)


def test_the_derivative_of_coverage_is_its_slope():
    """Corner c is the start of side c and the end of side c - 1, and moves each along its normal."""
    points, step = lattice(45, 28), 0.15
    _, by_side = blurred_coverage(Quad(KITE[None]), points, 0.7)
    normal = side_frames(KITE).normal
    for corner, axis in np.ndindex(4, 2):
        shift = np.zeros((1, 4, 2))
        shift[0, corner, axis] = step
        moved = [blurred_coverage(Quad(KITE + k * shift), points, 0.7)[0] for k in (-2, -1, 1, 2)]
        difference = (moved[0] - 8 * moved[1] + 8 * moved[2] - moved[3]) / (12 * step)
        before = (corner - 1) % 4
        slope = normal[corner, axis] * by_side[:, corner] + normal[before, axis] * by_side[:, 4 + before]
        np.testing.assert_allclose(slope, difference, atol=2e-3)


def test_the_outline_polygon_of_an_arrow_encloses_its_cells():
    labels = np.zeros((40, 60), dtype=int)
    labels[10:30, 20:24] = labels[10:16, 14:30] = 1 + PAINT_CLASSES.index("arrow")
    blobs, _ = find_blobs(output_of_labels(labels, 50))
    (arrow,) = blobs
    assert arrow.kind == "arrow"
    polygon = outline_polygon(arrow)
    area_px = cv2.contourArea(polygon.astype(np.float32))
    assert area_px == pytest.approx(4 * np.count_nonzero(labels), rel=0.06)
    np.testing.assert_allclose(polygon.min(axis=0), [2 * 13.5 + 0.5, 50 + 2 * 9.5 + 0.5], atol=0.6)


def test_paint_that_is_hardly_any_has_an_outline_too():
    level = np.full((5, 9), -6.0, dtype=np.float32)
    level[2, 2:7] = 1e-3
    polygon = outline_polygon(Blob({"arrow": 0.6}, level, np.array([10.0, 20.0]), 2, np.zeros((0, 2))))
    np.testing.assert_allclose(np.ptp(polygon, axis=0), [10.0, 2.0], atol=0.6)
    np.testing.assert_allclose((polygon.min(axis=0) + polygon.max(axis=0)) / 2, [18.0, 24.0], atol=0.3)


@pytest.mark.parametrize("turned", [1, -1])
def test_an_outline_moves_to_the_edges_of_bright_paint_and_stays_where_there_are_none(turned):
    true = np.array([[30.4, 20.3], [90.4, 20.3], [90.4, 50.3], [30.4, 50.3]])
    columns, rows = (
        np.clip(shape, 0.0, 1.0)
        for shape in (
            np.minimum(np.arange(120) + 0.5 - 30.4, 90.9 - np.arange(120)),
            np.minimum(np.arange(80) + 0.5 - 20.3, 50.8 - np.arange(80)),
        )
    )
    picture = np.repeat((70 + 110 * rows[:, None] * columns)[..., None], 3, axis=2).astype(np.uint8)
    drawn = (true + np.array([[-2.0, 1.5], [1.5, -2.0], [2.0, 2.0], [1.0, -1.5]]))[::turned]
    outline_px, has_edge = on_edges(drawn, picture)
    assert has_edge.all()
    middles = (true + np.roll(true, -1, axis=0)) / 2
    off_px = [cv2.pointPolygonTest(outline_px.astype(np.float32), point, True) for point in middles.tolist()]
    np.testing.assert_allclose(off_px, 0.0, atol=0.4)
    plain, has_edge = on_edges(drawn, np.full_like(picture, 70))
    assert not has_edge.any()
    assert abs(signed_area(plain) - signed_area(drawn)) < 0.02 * abs(signed_area(drawn))


def test_an_outline_has_no_edge_where_paint_runs_on_beyond_it():
    picture = np.full((80, 120, 3), 60, dtype=np.uint8)
    picture[20:50, 30:] = 180
    picture[40:] //= 3  # a shadow
    outline_px, has_edge = on_edges(
        np.array([[30.0, 20.0], [80.0, 20.0], [80.0, 50.0], [30.0, 50.0]]), picture
    )
    middles = (outline_px + np.roll(outline_px, -1, axis=0)) / 2
    length = np.linalg.norm(outline_px - np.roll(outline_px, -1, axis=0), axis=1)
    cut = np.abs(middles[:, 0] - 80.0) < 3
    assert length[has_edge & cut].sum() < 0.2 * length[cut].sum()
    assert length[has_edge & ~cut].sum() > 0.9 * length[~cut].sum()


@pytest.mark.parametrize(("other", "is_one"), [("stop_line", False), ("diamond", True), ("lane_dash", True)])
def test_an_arrow_and_a_stop_line_are_two_markings_but_a_shaft_is_part_of_its_arrow(other, is_one):
    labels = np.zeros((60, 60), dtype=int)
    labels[5:25, 20:40] = 1 + PAINT_CLASSES.index("arrow")
    labels[25:50, 25:45] = 1 + PAINT_CLASSES.index(other)
    blobs, _ = find_blobs(output_of_labels(labels))
    pieces = [Proposal(blob, k, {}, np.zeros((0, 2)), None, 0.0) for k, blob in enumerate(blobs)]
    assert pieces[0].blob.parts == 2
    assert pieces[0].is_one_symbol(pieces[1:], SHIPPED) == is_one


def test_a_diamond_that_touches_a_line_is_split_from_it():
    labels = np.zeros((40, 60), dtype=int)
    labels[10:30, 20:40] = 1 + PAINT_CLASSES.index("diamond")
    labels[:, 40:44] = 1 + PAINT_CLASSES.index("lane_line")
    blobs, owner = find_blobs(output_of_labels(labels))
    assert blobs[0].parts == 2
    assert sorted(blob.kind for blob in blobs[1:]) == ["diamond", "lane_line"]
    square = next(blob for blob in blobs[1:] if blob.kind == "diamond")
    assert square.outline_px[:, 0].max() == pytest.approx(2 * 39.5 + 0.5, abs=0.1)
    assert owner[20, 30] != owner[20, 42]


def test_a_dash_that_looks_like_a_line_here_and_there_stays_one_blob():
    labels = np.zeros((40, 60), dtype=int)
    labels[5:35, 20:24] = 1 + PAINT_CLASSES.index("lane_dash")
    labels[5:14, 20:24] = 1 + PAINT_CLASSES.index("lane_line")
    blobs, _ = find_blobs(output_of_labels(labels))
    assert [blob.kind for blob in blobs] == ["lane_dash"]


def test_worn_holes_do_not_add_to_the_outline():
    labels = np.zeros((40, 60), dtype=int)
    labels[10:30, 20:40] = 1
    labels[18:22, 28:32] = 0
    blobs, _ = find_blobs(output_of_labels(labels, 100))
    inner = np.abs(blobs[0].outline_px - [2 * 29.5 + 0.5, 100 + 2 * 19.5 + 0.5]).max(axis=1)
    assert inner.min() > 15


def test_a_piece_of_two_classes_comes_whole_and_in_its_parts():
    labels = np.zeros((60, 60), dtype=int)
    labels[20:50, 28:32] = 1 + PAINT_CLASSES.index("lane_dash")
    labels[8:20, 20:40] = 1 + PAINT_CLASSES.index("arrow")
    blobs, owner = find_blobs(output_of_labels(labels))
    assert [blob.parts for blob in blobs] == [2, 0, 0]
    assert sorted(blob.kind for blob in blobs[1:]) == ["arrow", "lane_dash"]
    assert all(blob.touches_symbol for blob in blobs[1:])
    assert {owner[40, 30], owner[12, 30]} == {2, 3}, "the parts own their paint"


def test_blobs_in_each_others_boxes_keep_to_themselves():
    labels = np.zeros((60, 60), dtype=int)
    for k in range(10, 50):
        labels[k, k : k + 4] = 1
    labels[15:20, 40:46] = labels[40:45, 12:18] = 1
    blobs, owner = find_blobs(output_of_labels(labels))
    assert len(blobs) == 3
    for index, blob in enumerate(blobs):
        mine = np.argwhere(owner == index + 1)
        outline = (blob.outline_px - 0.5) / 2
        assert np.count_nonzero(blob.level > 0) == len(mine)
        np.testing.assert_allclose(outline.min(axis=0), mine[:, ::-1].min(axis=0) - 0.5, atol=0.01)
        np.testing.assert_allclose(outline.max(axis=0), mine[:, ::-1].max(axis=0) + 0.5, atol=0.01)


SHAPES = [bar(5.0, 0.3, 0.15, 4.0), bar(9.0, -2.0, 3.0, 0.15), diamond(7.0, 1.0)]
SHARES = np.linspace(0.0, 1.0, 9)[:, None]


def seen(lens):
    """A view, recorded corners (3, 4, 2) of shapes, and points (3, 9, 2) along one side of each."""
    camera = make_camera(lens)
    ground = np.stack(SHAPES)
    corners_px = np.stack([order_corners(to_image(camera, shape)) for shape in ground])
    along = ground[:, [0]] + SHARES * (ground[:, [1]] - ground[:, [0]])
    return RoadCamera(camera, 16), corners_px, np.stack([to_image(camera, line) for line in along])


@pytest.mark.parametrize("lens", sorted(LENSES))
def test_what_is_straight_on_the_ground_is_straight_in_the_frames_and_as_large_as_in_the_image(lens):
    view, corners_px, lines_px = seen(lens)
    frames = LensFrames.about(view, corners_px)
    lines = frames.from_image(lines_px)
    np.testing.assert_allclose(frames.to_px(lines), lines_px, atol=0.02)
    for line, line_px in zip(lines, lines_px, strict=True):
        bent = np.linalg.svd(line - line.mean(axis=0), compute_uv=False)[1]
        assert bent < 0.05
        assert np.linalg.norm(line[-1] - line[0]) == pytest.approx(
            np.linalg.norm(line_px[-1] - line_px[0]), rel=0.12
        )


@pytest.mark.parametrize("lens", ["plumb_bob", "equidistant"])
def test_covariances_in_the_image_are_those_of_scattered_corners(lens):
    view, corners_px, _ = seen(lens)
    frames = LensFrames.about(view, corners_px)
    corners = frames.from_image(corners_px)
    root = np.tril(np.random.default_rng(0).normal(0, 0.05, (3, 8, 8))) + 0.1 * np.eye(8)
    np.testing.assert_allclose(frames.to_px(corners), corners_px, atol=0.02)
    moves = frames.jacobian(corners) @ root
    covariance = moves @ moves.swapaxes(1, 2)
    noise = np.random.default_rng(1).normal(size=(4000, 3, 8, 1))
    moved = corners + (root @ noise).reshape(4000, 3, 4, 2)
    scattered = np.stack([frames.to_px(sample) for sample in moved]).reshape(4000, 3, 8)
    for m in range(3):
        drawn = np.cov(scattered[:, m].T)
        np.testing.assert_allclose(covariance[m], drawn, atol=0.06 * np.diag(drawn).max())


def test_only_what_the_lens_bows_notably_is_looked_at_along_the_bow():
    assert not ImageQuads.of(*seen("pinhole")[:2]).bowed.any()
    view, corners_px, lines_px = seen("equidistant")
    quads = ImageQuads.of(view, corners_px)
    assert quads.bowed.tolist() == [True, True, False]
    middles = (quads.corners + np.roll(quads.corners, -1, axis=1)) / 2
    sides_px = quads.px(middles)
    nearest = np.linalg.norm(sides_px[0][:, None] - lines_px[0], axis=2).min()
    assert nearest < 0.3, "the middle of one of its sides lies on the side as the lens shows it"
    some = quads.take(np.array([2, 1, 0, 0]))
    assert some.bowed.tolist() == [False, True, True, True]
    np.testing.assert_allclose(some.px(middles[[2, 1, 0, 0]]), sides_px[[2, 1, 0, 0]])
    np.testing.assert_array_equal(quads.px(middles)[2], middles[2])


CAMERA = make_camera("plumb_bob")
VIEW = RoadCamera(CAMERA, 16)
GREY, OUTSIDE = CHANNELS.index("log_grey"), CHANNELS.index("outside")


def seen_in_frame(image, corners_px, kind):
    """The view (C, 20, 20) of a quadrilateral in an image of which the network says nothing."""
    blank = output_of(np.zeros((CAMERA.info.height // 2, CAMERA.info.width // 2), np.float32))
    return view_of(image, VIEW, blank, corners_px, kind)


def corners_of(shape):
    return order_corners(to_image(CAMERA, shape))


def elements(kind):
    """Elements (20, 20) well within the marking and those well outside, as the module's margins put it."""
    step = np.abs((np.arange(SIZE) + 0.5) / SIZE - 0.5)
    along, across = ((1 + 2 * margin) * step for margin in ((0.6, 0.6) if kind == DIAMOND else (0.3, 1.0)))
    return (across < 0.4)[:, None] & (along < 0.4), (across > 0.65)[:, None] | (along > 0.65)


@pytest.mark.parametrize(
    ("shape", "kind"),
    [
        (diamond(6.0, 0.4, 1.4, 0.9), DIAMOND),
        (diamond(8.0, -1.0, 1.4, 0.9, 20.0), DIAMOND),
        (bar(7.5, 0.5, 2.5, 0.4), LANE_DASH),
        (bar(7.5, 0.5, 2.5, 0.4, 90.0), LANE_DASH),
    ],
)
def test_paint_fills_the_middle_wherever_a_marking_lies(shape, kind):
    corners = corners_of(shape)
    image, (inside, outside) = picture(CAMERA, [shape], ground=0.1, paint=0.5), elements(kind)
    for first in range(4):
        view = seen_in_frame(image, np.roll(corners, first, axis=0), kind)
        assert view[GREY][inside].min() > view[GREY][outside].max() + np.log(2)
        assert not view[OUTSIDE].any()


def test_light_changes_nothing():
    shape = diamond(6.0, 0.0, 1.4, 0.9)
    bright, dim = (
        seen_in_frame(
            picture(CAMERA, [shape], ground=0.3 * light, paint=0.9 * light), corners_of(shape), DIAMOND
        )
        for light in (1.0, 0.5)
    )
    assert np.abs(bright[GREY] - dim[GREY]).mean() < 0.1


def test_what_lies_beyond_the_image_is_told_and_all_is_finite():
    shape = diamond(5.0, 3.2, 1.6, 1.2)
    corners = corners_of(shape)
    image = picture(CAMERA, [shape])
    assert seen_in_frame(image, corners, DIAMOND)[OUTSIDE].any()
    above = np.array([[300.0, 2.0], [310.0, 1.0], [312.0, 9.0], [301.0, 10.0]])
    assert np.isfinite(seen_in_frame(image, order_corners(above), DIAMOND)).all()

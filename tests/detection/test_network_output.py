"""Looking at near ground at half the resolution moves nothing, looking to the side turns stripes."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.detection.pictures import bar, brightness_model, diamond, extrinsic, make_camera, picture
from v2hdm.detection import network as network_module
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.detector import Detector
from v2hdm.detection.network import Network, NetworkOutput, RawOutput, run_on_road
from v2hdm.detection.options import DetectorOptions
from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.records import LANE_DASH, STOP_LINE, Camera, CameraInfo


def large_camera(width: int = 1280, height: int = 720) -> Camera:
    """A camera with much near ground in it."""
    intrinsic = np.array([[900.0, 0.0, width / 2], [0.0, 900.0, height / 2], [0.0, 0.0, 1.0]])
    info = CameraInfo("front", width, height, intrinsic)
    roi = np.array([[3.0, -2.0], [9.0, -2.0], [9.0, 2.0], [3.0, 2.0]])
    return Camera(info, {"calibrated": ipm_from_extrinsic(info, extrinsic(pitch_deg=18))}, "calibrated", roi)


class LineNetwork(Network):
    """Finds, on every row anchor, the columns where an image's red channel turns from 0 to 255."""

    def run(self, image_bgr: np.ndarray) -> RawOutput:
        output = super().run(image_bgr)
        stride = self.info.lane_stride
        lanes = output.lanes.copy()
        red = image_bgr[..., 2].astype(float)
        for row in range(lanes.shape[1]):
            above, below = stride * row + stride // 2 - 1, stride * row + stride // 2
            edge = 0.5 * sum(float((255 - red[line]).sum() / 255) for line in (above, below))
            cell = edge / stride
            if 0 < cell < lanes.shape[2]:
                lanes[:, row, int(cell)] = 5.0, cell - int(cell) - 0.5
        return RawOutput(output.paint, output.kinds, lanes)


def test_both_resolutions_say_the_same_of_the_same_place(tmp_path):
    camera = large_camera()
    view = RoadCamera(camera)
    network = Network(brightness_model(tmp_path))
    image = picture(camera, [diamond(5.0, 0.0)])
    twice = run_on_road(network, image, view)
    assert network_module._seam_row(network, view) is not None
    view.fine_row = None
    assert network_module._seam_row(network, view) is None
    once = run_on_road(network, image, view)
    assert twice.paint.shape == once.paint.shape
    assert twice.kinds.shape == once.kinds.shape
    both, either = ((once.paint > 0) & (twice.paint > 0)).sum(), ((once.paint > 0) | (twice.paint > 0)).sum()
    assert both / either > 0.97
    centres = [np.argwhere(sight.paint > 0).mean(axis=0) for sight in (once, twice)]
    np.testing.assert_allclose(*centres, atol=0.1)


def test_row_anchors_of_the_two_resolutions_lie_on_one_line(tmp_path):
    camera = large_camera()
    image = np.zeros((camera.info.height, camera.info.width, 3), dtype=np.uint8)
    for v in range(camera.info.height):
        image[v, int(200 + 0.5 * v) :, 2] = 255
    rows = run_on_road(LineNetwork(brightness_model(tmp_path)), image, RoadCamera(camera)).anchors
    v = np.array([row.v_px for row in rows])
    u = np.array([row.u_px[0] for row in rows])
    assert (np.diff(v) < 0).all()
    assert set(np.round(-np.diff(v))) >= {8, 16}, "both resolutions took part"
    assert np.abs(u - (199.5 + 0.5 * v)).max() < 1.2


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (1242, 375), (1288, 722), (640, 480)])
def test_the_parts_cover_the_band_whatever_the_image_size(tmp_path, width, height):
    camera = large_camera(width, height)
    view = RoadCamera(camera)
    sight = run_on_road(
        Network(brightness_model(tmp_path)), np.zeros((height, width, 3), dtype=np.uint8), view
    )
    rows = height - view.far_row
    assert sight.paint.shape == (-(-rows // 2), -(-width // 2))
    assert sight.kinds.shape[1:] == (-(-rows // 4), -(-width // 4))


def looked_at(image: np.ndarray, mirrored: bool) -> NetworkOutput:
    """What the shipped network says of an image, looked at whole."""
    view = RoadCamera(large_camera(image.shape[1], image.shape[0]))
    view.fine_row = None
    return run_on_road(Network(), image, view, mirrored)


def test_with_its_mirror_image_the_network_says_the_same_of_both_sides():
    """A law that no network has by itself: the answer to a mirror image is the mirrored answer."""
    image = picture(large_camera(), [diamond(6.0, 1.0), diamond(8.0, -1.5)])
    direct, mirrored = looked_at(image, True), looked_at(image[:, ::-1].copy(), True)
    np.testing.assert_allclose(mirrored.paint[:, ::-1], direct.paint, atol=1e-4)
    np.testing.assert_allclose(mirrored.kinds[..., ::-1], direct.kinds, atol=1e-4)
    columns = [[np.sort(row.u_px) for row in sight.anchors] for sight in (direct, mirrored)]
    for there, here in zip(*columns, strict=True):
        np.testing.assert_allclose(np.sort(image.shape[1] - 1 - here), there, atol=1e-3)
    once = looked_at(image, False)
    assert np.abs(looked_at(image[:, ::-1].copy(), False).paint[:, ::-1] - once.paint).max() > 0.1


@pytest.mark.parametrize("width", [1280, 1242, 1271])
def test_the_mirror_image_moves_nothing_whatever_the_width(width):
    image = picture(large_camera(width, 720), [diamond(6.0, 1.0), diamond(8.0, -1.5)])
    once, twice = looked_at(image, False), looked_at(image, True)
    assert (twice.paint.shape, twice.kinds.shape) == (once.paint.shape, once.kinds.shape)
    both, either = ((once.paint > 0) & (twice.paint > 0)).sum(), ((once.paint > 0) | (twice.paint > 0)).sum()
    assert both / either > 0.93
    # Each marking's own centre: that of both together would also move with how large each comes out.
    centres = [
        cv2.connectedComponentsWithStats((sight.paint > 0).astype(np.uint8))[3][1:] for sight in (once, twice)
    ]
    assert len(centres[0]) == 2
    np.testing.assert_allclose(*centres, atol=0.25)


def turned(camera: Camera, yaw_deg: float) -> Camera:
    """The same camera on a vehicle that drives in another direction."""
    c, s = np.cos(np.deg2rad(yaw_deg)), np.sin(np.deg2rad(yaw_deg))
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    ipm = {name: turn @ homography for name, homography in camera.ipm.items()}
    return replace(camera, ipm=ipm, roi_vehicle=camera.roi_vehicle @ turn[:2, :2].T)


@pytest.mark.parametrize(
    ("yaw_deg", "kind"),
    [(0.0, STOP_LINE), (180.0, STOP_LINE), (50.0, STOP_LINE), (90.0, LANE_DASH), (-80.0, LANE_DASH)],
)
def test_a_stripe_across_the_view_of_a_camera_that_looks_to_the_side_is_a_dash(tmp_path, yaw_deg, kind):
    camera = make_camera("pinhole")
    image = picture(camera, [bar(6.0, 0.0, 0.3, 2.4)], ground=0.2, paint=0.6)
    detector = Detector.load(brightness_model(tmp_path, STOP_LINE), DetectorOptions(min_confidence=0.0))
    (seen,) = detector.detect(image, turned(camera, yaw_deg))[0]
    assert seen.kind == kind
    assert seen.score > DetectorOptions().min_confidence

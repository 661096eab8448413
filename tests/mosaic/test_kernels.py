"""The compiled kernels do with images on the ground what numpy does."""

import numpy as np
import pytest

from tests.mosaic import scene
from v2hdm import native
from v2hdm.mosaic.blend import whole
from v2hdm.mosaic.consensus import _Comparison
from v2hdm.mosaic.views import Canvas, adjusted_shots, lens_of, recorded_shots
from v2hdm.mosaic.warp import Nodes, plan_sheets
from v2hdm.records import Calibration

pytestmark = pytest.mark.skipif(native.kernels() is None, reason=native.which_runs())

CANVAS = Canvas(np.array([-5.0, 8.0]), 0.02, 800, 1500)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return scene.drive_of(tmp_path_factory.mktemp("drive"), scene.squares)


@pytest.fixture(scope="module")
def lenses(drive):
    return {"front": lens_of(drive.cameras["front"], scene.cam_from_vehicle())}


def twice(function):
    """The results of a function with the kernels, and with numpy alone."""
    by_kernels = function()
    with native.numpy_alone():
        return by_kernels, function()


def test_images_are_blended_as_by_numpy(drive, lenses):
    by_kernels, by_numpy = twice(lambda: whole(CANVAS, recorded_shots(drive), lenses))
    off = np.abs(by_kernels.astype(int) - by_numpy)
    assert (by_numpy[..., 3] > 0).mean() > 0.05
    assert off.max() <= 1
    # OpenCV 4 knows 32 places between two pixels.
    assert (off > 0).mean() < 0.01


def test_patches_are_cut_as_by_numpy(drive, lenses):
    shots = adjusted_shots(
        drive,
        {"front": Calibration(scene.INFO, scene.cam_from_vehicle())},
        {"front": 0.0},
        drive.trajectory,
    )
    canvas = Canvas(CANVAS.corner_map, 0.04, 400, 750)
    comparison = _Comparison(shots, lenses, canvas)
    (sheet,) = plan_sheets(canvas, shots, lenses, None, 1024)
    by_kernels, by_numpy = twice(lambda: comparison(sheet, lambda done, total: None))
    assert len(by_kernels) == len(by_numpy) > 10
    for by_kernel, by_array in zip(by_kernels, by_numpy, strict=True):
        assert by_kernel[:2] == by_array[:2]
        assert by_kernel.indices == by_array.indices
        np.testing.assert_array_equal(by_kernel.kinds, by_array.kinds)
        np.testing.assert_array_equal(by_kernel.shows, by_array.shows)


@pytest.mark.parametrize("shape", [(4, 2, 4096), (5, 2, 100)])
def test_sums_of_another_shape_are_refused(shape):
    with pytest.raises(ValueError, match="another shape"):
        native.kernels().ground.mean(np.zeros(shape, dtype=np.float32))


def test_a_slot_beyond_the_sums_is_refused():
    """Else an image would be added to what lies behind them in memory."""
    node = np.zeros((1, 2, 2))
    image = np.zeros((4, 4, 3), dtype=np.uint8)
    sums = np.zeros((5, 1, 4096), dtype=np.float32)
    with pytest.raises(ValueError, match="beyond the sums"):
        native.kernels().ground.add(
            sums, np.array([1]), Nodes(node, node, node, 1.0), node, image, image[..., 0], 1.0, 1.0
        )

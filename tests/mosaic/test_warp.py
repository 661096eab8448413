"""Images are read between their pixels as torch's grid_sample reads them, and as nothing outside."""

import numpy as np
import torch
from kornia.geometry.transform import remap

from v2hdm.mosaic.warp import sample


def test_images_are_read_as_by_grid_sample():
    rng = np.random.default_rng(1)
    image = rng.uniform(0, 255, (40, 60, 3)).astype(np.float32)
    x_px, y_px = rng.uniform(-5, 65, (2, 3, 8, 8)).astype(np.float32)
    expected = remap(
        torch.from_numpy(image).permute(2, 0, 1).expand(3, -1, -1, -1),
        torch.from_numpy(x_px),
        torch.from_numpy(y_px),
        align_corners=True,
    )
    read = sample(image, x_px, y_px)
    # OpenCV 4 knows 32 places between two pixels.
    np.testing.assert_allclose(read, expected.permute(0, 2, 3, 1), atol=255 / 32)
    assert np.abs(read - expected.permute(0, 2, 3, 1).numpy()).mean() < 2


def test_nothing_is_read_far_outside():
    image = np.full((4, 4), 9, dtype=np.uint8)
    assert not sample(image, np.full((1, 2, 2), 1e5, np.float32), np.zeros((1, 2, 2), np.float32)).any()

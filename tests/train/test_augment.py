"""Augmentation keeps image and labels together, and edges where they are."""

import numpy as np

from train.augment import random_crop, random_photometry
from train.scenes.scenes import TrainingSample


def test_crops_keep_image_labels_hidden_and_lanes_together() -> None:
    labels = np.random.default_rng(0).integers(0, 5, (40, 60)).astype(np.uint8)
    image = np.repeat(labels[..., None], 3, axis=2)
    image[20, 30] = 250
    whole = TrainingSample(image, labels, labels > 2, (np.array([[30.0, 20.0], [31.0, 10.0]]),))
    rng = np.random.default_rng(1)
    seen = 0
    for _ in range(40):
        crop = random_crop(rng, whole, 32, 16)
        assert crop.image.shape == (16, 32, 3)
        bright = crop.image[..., 1] == 250
        np.testing.assert_array_equal(crop.image[..., 1][~bright], crop.labels[~bright])
        np.testing.assert_array_equal(crop.hidden, crop.labels > 2)
        for row, column in np.argwhere(bright):
            np.testing.assert_array_equal(crop.lanes_px[0][0], [column, row])
            seen += 1
    assert seen > 3


def test_photometry_changes_values_but_not_shape_or_type_or_its_input() -> None:
    image = np.random.default_rng(0).integers(0, 256, (32, 48, 3)).astype(np.uint8)
    before = image.copy()
    rng = np.random.default_rng(2)
    for _ in range(30):
        out = random_photometry(rng, image)
        assert out.shape == image.shape
        assert out.dtype == np.uint8
    np.testing.assert_array_equal(image, before)

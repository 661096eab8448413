"""Augmentation keeps image and labels together, and edges where they are."""

import numpy as np

from train.augment import half_resolution, random_crop, random_photometry
from train.losses import IGNORE


def test_a_block_takes_the_class_of_most_of_its_pixels_and_a_tie_is_ignored() -> None:
    labels = np.array([[1, 1, 0, 2], [1, 0, 2, 0], [0, 0, 3, 3], [0, 4, 3, 3]], dtype=np.uint8)
    assert half_resolution(labels).tolist() == [[1, IGNORE], [0, 3]]


def test_half_resolution_moves_no_edge() -> None:
    labels = np.zeros((64, 64), dtype=np.uint8)
    labels[:, 21:] = 1
    row = half_resolution(labels)[0]
    assert row[9] == 0
    assert row[10] == IGNORE
    assert row[11] == 1


def test_crops_show_the_labels_of_their_own_pixels() -> None:
    labels = np.random.default_rng(0).integers(0, 5, (40, 60)).astype(np.uint8)
    image = np.repeat(labels[..., None], 3, axis=2)
    rng = np.random.default_rng(1)
    for _ in range(20):
        cropped, cropped_labels = random_crop(rng, image, labels, 32, 16)
        assert cropped.shape == (16, 32, 3)
        np.testing.assert_array_equal(cropped[..., 1], cropped_labels)


def test_photometry_changes_values_but_not_shape_or_type_or_its_input() -> None:
    image = np.random.default_rng(0).integers(0, 256, (32, 48, 3)).astype(np.uint8)
    before = image.copy()
    rng = np.random.default_rng(2)
    for _ in range(30):
        out = random_photometry(rng, image)
        assert out.shape == image.shape
        assert out.dtype == np.uint8
    np.testing.assert_array_equal(image, before)

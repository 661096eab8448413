"""The fit of what words of one image say of each other."""

import numpy as np
import pytest

from train.fit_writing import Word, _is_written, fitted
from v2hdm.detection.writing import writing_probability


def words(weight, count=5000, seed=6):
    """Words whose company says as much as ``weight`` claims."""
    rng = np.random.default_rng(seed)
    score = rng.uniform(0.1, 0.9, count)
    company = np.maximum(rng.uniform(-1.0, 1.0, count), 0.0)
    is_word = rng.random(count) < writing_probability(score, company, weight)
    return [Word(*word) for word in zip(score.tolist(), company.tolist(), is_word.tolist(), strict=True)]


@pytest.mark.parametrize("weight", [0.0, 1.5, 3.0])
def test_the_weight_that_made_words_is_fitted_to_them(weight):
    assert fitted(words(weight)) == pytest.approx(weight, abs=0.3)


def test_an_area_is_writing_that_labels_cover_none_that_they_hardly_touch_and_else_unknown():
    is_written = np.zeros((60, 100), dtype=bool)
    is_written[:, :50] = True
    square = np.array([[0.0, 10.0], [20.0, 10.0], [20.0, 30.0], [0.0, 30.0]])
    answers = [_is_written(square + np.array([left, 0]), is_written) for left in (10, 43, 70)]
    assert answers == [True, None, False]

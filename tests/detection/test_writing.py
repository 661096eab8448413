"""Words of one image make each other likelier."""

import numpy as np
import pytest

from tests.detection.pictures import bar
from v2hdm.detection.writing import company_of_words, writing_probability

WORD = bar(9.0, 0.0, 1.6, 3.0)
BELOW = bar(6.5, 0.0, 1.6, 3.0)
FAR = bar(30.0, 0.0, 1.6, 3.0)


def probabilities(score, hulls):
    alone = np.array(score)
    return writing_probability(alone, company_of_words(alone, hulls))


def test_a_doubtful_word_beside_a_sure_one_is_one_and_by_itself_it_is_none():
    assert probabilities([0.42, 0.8], [WORD, BELOW]).min() > 0.5
    assert probabilities([0.42], [WORD])[0] < 0.5
    assert probabilities([0.42, 0.8], [WORD, FAR])[0] < 0.5


@pytest.mark.parametrize("score", [0.3, 0.5, 0.9])
def test_a_word_gains_by_company_the_more_the_surer_that_is(score):
    beside_none, beside_doubtful, beside_sure = (
        probabilities([score, other], [WORD, hull])[0]
        for other, hull in ((0.9, FAR), (0.6, BELOW), (0.9, BELOW))
    )
    assert score == beside_none < beside_doubtful < beside_sure


def test_two_doubtful_words_say_nothing_of_each_other():
    assert probabilities([0.45, 0.4], [WORD, BELOW]).tolist() == [0.45, 0.4]


def test_company_is_mutual_and_does_not_depend_on_the_order():
    company = company_of_words(np.array([0.6, 0.8, 0.9]), [WORD, BELOW, FAR])
    assert company == pytest.approx([0.6, 0.2, 0.0])
    turned = company_of_words(np.array([0.9, 0.8, 0.6]), [FAR, BELOW, WORD])
    np.testing.assert_array_equal(turned[::-1], company)

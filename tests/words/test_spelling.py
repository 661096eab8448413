"""Spelling: strings of the same strokes share their odds by what is painted on the ground."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.words.test_reading import ALONG
from v2hdm.words.reading import reading_of
from v2hdm.words.recogniser import Letters
from v2hdm.words.spelling import alike_strings, log_density, with_look_alikes

ALPHABET = "\0" + "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ"


def named(text: str, sure: float = 0.98) -> Letters:
    """A network's output that names these letters, one after the other."""
    letters = [letter for painted in text for letter in ("\0", painted)]
    probability = np.full((len(letters), len(ALPHABET)), (1.0 - sure) / (len(ALPHABET) - 1))
    probability[range(len(letters)), [ALPHABET.index(letter) for letter in letters]] = sure
    return Letters(np.log(probability), ALPHABET)


@given(st.integers(0, 2**32 - 1))
def test_letters_that_look_alike_share_what_they_had_together(seed):
    probability = np.random.default_rng(seed).dirichlet(np.ones(len(ALPHABET)), size=3)
    shared = with_look_alikes(probability, ALPHABET)
    assert shared.sum(axis=1) == pytest.approx(1.0)
    assert (shared >= 0).all()
    pair = [ALPHABET.index(letter) for letter in "O0"]
    assert shared[:, pair].sum(axis=1) == pytest.approx(probability[:, pair].sum(axis=1))


def test_a_string_stands_with_the_number_the_word_and_the_codes_of_its_strokes():
    assert alike_strings(["BO7", "B07"], ALPHABET) == [["807", "B07", "BO7"]]
    assert alike_strings(["5T0P"], ALPHABET) == [["5T0P", "STOP"]]
    assert alike_strings(["EBH", "347"], ALPHABET) == [["347"], ["EBH"]]


def test_letters_that_the_network_does_not_know_are_in_no_string():
    assert alike_strings(["10"], "\x0010") == [["10"]]


def test_a_number_a_word_and_a_code_are_likelier_than_letters_and_digits_in_any_order():
    assert min(log_density(text) for text in ("507", "STOP", "B07")) > log_density("5T0P")


@pytest.mark.parametrize(
    ("read", "painted"), [("5O7", "507"), ("ST0P", "STOP"), ("BO7", "B07"), ("1O1", "101"), ("EBH", "EBH")]
)
def test_strokes_are_spelled_as_what_stands_on_the_ground(read, painted):
    images = [[named(read), named("1", 0.3), named("1", 0.3), named("1", 0.3)]] * 3
    said = reading_of(images, ALONG).reading
    assert said.text == painted
    assert said.confidence > 0.5


def test_spelling_does_not_change_how_likely_it_is_that_a_word_is_read():
    images = [[named("101"), named("1", 0.3), named("1", 0.3), named("1", 0.3)]] * 3
    others = [[named("747"), named("1", 0.3), named("1", 0.3), named("1", 0.3)]] * 3
    read = reading_of(images, ALONG).reading
    assert read.text == "101"
    assert read.confidence <= reading_of(others, ALONG).reading.confidence

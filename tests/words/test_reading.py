"""Readings of words: probabilities of strings, sides and images, and a painted word read from a drive."""

from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.words.scene import ASPHALT, CAMERA, footage_of, lights, painted, poses, word_map
from v2hdm.errors import ConfigError
from v2hdm.pipeline.context import Context
from v2hdm.pipeline.paint import _with_words
from v2hdm.records import Drive
from v2hdm.words import recogniser as recognising
from v2hdm.words.patches import Word, best_views, patches_of
from v2hdm.words.reading import reading_of, side_prior, with_readings
from v2hdm.words.recogniser import Letters, load_recogniser

ALPHABET = "\0AB"
ALONG = np.array([0.8, 0.04, 0.12, 0.04])


def letters(text: str, sure: float = 0.98) -> Letters:
    """The network's output for a patch that reads so, and else of nothing."""
    alphabet = "\0" + "".join(sorted(set("0123456789EBH" + text)))
    columns = []
    for letter in [letter for character in text for letter in ("\0", character)] or ["\0"]:
        probability = np.full(len(alphabet), (1.0 - sure) / (len(alphabet) - 1))
        probability[alphabet.index(letter)] = sure
        columns.append(np.log(probability))
    return Letters(np.array(columns), alphabet)


def view(up: str, down: str, sure: float = 0.98) -> list[Letters]:
    """An image of a word: its first side above, or the third, say something, the others little."""
    return [letters(up, sure), letters("1", 0.3), letters(down, sure), letters("1", 0.3)]


@pytest.mark.parametrize("text", ["", "A", "AB", "AA", "ABA"])
def test_a_string_is_as_probable_as_all_the_columns_that_spell_it(text):
    probability = np.random.default_rng(3).dirichlet([1.0, 1.0, 1.0], size=5)
    total = 0.0
    for channels in product(range(3), repeat=5):
        letters_left = [k for n, k in enumerate(channels) if n == 0 or k != channels[n - 1]]
        if "".join(ALPHABET[k] for k in letters_left if k) == text:
            total += np.prod(probability[range(5), channels])
    assert np.exp(Letters(np.log(probability), ALPHABET).log_of(text)) == pytest.approx(total)


def test_the_direction_of_driving_decides_between_two_readings_and_the_other_is_kept_as_doubt():
    along = reading_of([view("EBH", "483")] * 3, ALONG)
    against = reading_of([view("EBH", "483")] * 3, np.roll(ALONG, 2))
    assert (along.reading.text, along.reading.alternative, along.side) == ("EBH", "483", 0)
    assert (against.reading.text, against.reading.alternative, against.side) == ("483", "EBH", 2)
    assert along.reading.confidence > 3 * along.reading.alternative_confidence > 0


def test_of_a_yard_that_is_driven_both_ways_both_readings_are_kept_alike():
    word = Word.around(word_map(np.array([2.0, 1.0])).symbols[0].outline_map)
    prior = side_prior(word, [*poses(0.0), *poses(np.pi)])
    assert prior.sum() == pytest.approx(1.0)
    assert np.ptp(np.sort(prior)[2:]) < 1e-9
    said = reading_of([view("806", "908")] * 4, np.array([0.46, 0.04, 0.46, 0.04])).reading
    assert {said.text, said.alternative} == {"806", "908"}
    assert said.confidence == pytest.approx(said.alternative_confidence, rel=0.1)


def test_a_word_against_the_direction_of_driving_is_read_where_only_it_can_be_read():
    said = reading_of([[letters("1", 0.3), letters("1", 0.3), letters("HB3"), letters("1", 0.3)]] * 3, ALONG)
    assert (said.reading.text, said.side) == ("HB3", 2)


def test_agreeing_readings_strengthen_and_contradicting_ones_weaken():
    single, three = (reading_of([view("EBH", "", 0.99)] * count, ALONG).reading for count in (1, 3))
    mixed = reading_of([view("EBH", "", 0.99)] * 2 + [view("EB3", "", 0.99)], ALONG).reading
    assert single.confidence < three.confidence
    assert (mixed.text, mixed.alternative) == ("EBH", "EB3")
    assert mixed.confidence < three.confidence


def test_images_in_which_something_hides_the_word_do_not_outvote_the_others():
    hidden = [letters("1", 0.2)] * 4
    said = reading_of([view("EBH", "1"), view("EBH", "1"), hidden, hidden], ALONG).reading
    assert said.text == "EBH"


def test_what_cannot_be_read_or_was_not_seen_says_nothing():
    assert reading_of([], ALONG) is None
    assert reading_of([[letters("1", 0.2)] * 4] * 3, ALONG) is None


@pytest.mark.parametrize("first", range(4))
def test_a_painted_word_is_read_whichever_corner_its_outline_begins_with(first):
    ground, size_m = painted("EBH")
    footage = footage_of(poses(0.0))
    hd_map = word_map(size_m, first)
    recogniser = load_recogniser(1)
    (symbol,) = with_readings(hd_map, footage, {"front": CAMERA}, lights(ground, footage), recogniser).symbols
    assert symbol.reading.text == "EBH"
    assert symbol.reading.confidence > 0.8
    assert symbol.outline_map[0] == pytest.approx([-size_m[1] / 2, size_m[0] / 2])
    assert np.diag(symbol.covariance_m2) == pytest.approx(np.repeat(np.arange(4) + 1.0, 2))


def test_a_shadow_across_a_word_leaves_its_patch_as_it_is():
    ground, size_m = painted("EBH")
    footage = footage_of(poses(0.0, (6.0,)))
    word = Word.around(word_map(size_m).symbols[0].outline_map)
    shaded = ground.copy()
    shaded[:, 240:] = shaded[:, 240:] // 3
    plain, dark = (
        next(patches_of([word], [[0]], footage, lights(pixels, footage))).upright
        for pixels in (ground, shaded)
    )
    upright = int(np.argmax(word.up_map @ [1.0, 0.0]))
    assert np.corrcoef(plain[upright].ravel(), dark[upright].ravel())[0, 1] > 0.85


@pytest.mark.parametrize(("is_painted", "opened"), [(True, 2), (False, 4)])
def test_more_than_two_images_of_a_word_are_opened_only_where_two_leave_doubt(is_painted, opened):
    ground, size_m = painted("EBH")
    footage = footage_of(poses(0.0, (10.5, 9.0, 7.5, 6.0)))
    light = lights(ground if is_painted else np.full_like(ground, ASPHALT), footage)
    paths = []

    def counted(image):
        paths.append(image.path)
        return light(image)

    with_readings(word_map(size_m), footage, {"front": CAMERA}, counted, load_recogniser(1))
    assert len(paths) == len(set(paths)) == opened


def test_a_letter_that_a_patch_does_not_list_is_as_probable_as_its_likeliest_other():
    listed = np.log([[0.7, 0.2, 0.1], [0.2, 0.7, 0.1]])
    assert np.exp(Letters(listed, "\0A?").log_of("Z")) == pytest.approx(0.7 * 0.1 + 0.1 * 0.2 + 0.1 * 0.1)


def test_a_patch_with_the_opposite_side_above_is_the_same_upside_down():
    ground, size_m = painted("EBH")
    footage = footage_of(poses(0.2, (6.0,)))
    word = Word.around(word_map(size_m).symbols[0].outline_map)
    turned = Word(np.roll(word.corners_map, -2, axis=0))
    light = lights(ground, footage)
    upright, after_a_turn = (
        next(patches_of([rectangle], [[0]], footage, light)).upright for rectangle in (word, turned)
    )
    for side, patch in enumerate(upright):
        grey = after_a_turn[(side + 2) % 4].astype(float)
        assert np.abs(grey - patch).mean() < 1.0


def test_the_best_view_of_a_word_is_the_nearest_that_shows_it_whole():
    _, size_m = painted("EBH")
    footage = footage_of(poses(0.0, (12.0, 6.0, 9.0, 0.0)))
    word = Word.around(word_map(size_m).symbols[0].outline_map)
    assert best_views([word], footage, {"front": CAMERA}) == [[1, 2, 0]]


def test_without_the_extra_there_is_no_recogniser(monkeypatch):
    monkeypatch.setattr(recognising, "find_spec", lambda name: None)
    assert load_recogniser(1) is None
    assert "pip install 'v2hdm[text]'" in recognising.MISSING


def test_a_run_without_the_extra_keeps_its_polygons_and_says_so_in_one_line(monkeypatch, caplog):
    monkeypatch.setattr(recognising, "find_spec", lambda name: None)
    hd_map = word_map(np.array([2.0, 1.0]))
    assert _with_words(hd_map, footage_of([]), Drive("a", Path(), {}, []), Context()) is hd_map
    assert [record.getMessage() for record in caplog.records] == [recognising.MISSING]


def test_a_package_without_its_network_is_named_in_one_line(monkeypatch, tmp_path):
    package = SimpleNamespace(submodule_search_locations=[str(tmp_path)])
    monkeypatch.setattr(recognising, "find_spec", lambda name: package)
    with pytest.raises(ConfigError, match=r"0 networks models/\*rec\*.onnx, not one; install rapidocr"):
        load_recogniser(1)

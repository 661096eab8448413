"""Readings of a word, weighed: which side is above, and which text stands there.

One of four sides is above, or none can be read. Beforehand it is most likely the side along the direction of
driving, for words are painted for those who drive up to them; where a yard is driven both ways, either of the
two. The images say more: the network is sure of letters that are upright, and seldom of others. Given a side,
each string has a probability by all images. Images of one word repeat each other's errors; together they
count as if fewer were independent.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import i0e, logsumexp

from v2hdm.geometry.planar import turned_left
from v2hdm.records import TEXT, Camera, FloatArray, HDMap, Image, Reading, Symbol
from v2hdm.site.living.wear import Footage
from v2hdm.words.patches import DIRECTIONS, Grey, Word, best_views, patches_of
from v2hdm.words.recogniser import Letters, Recogniser
from v2hdm.words.spelling import alike_strings, log_density

_log = logging.getLogger(__name__)

# The direction that is above, by its angle to that of driving: along it, against it, or any.
_ALONG, _AGAINST, _ANY = 0.75, 0.1, 0.15  # probability of each, chosen
_CONCENTRATION = 4.0  # of the first two, von Mises: one sigma is 30 deg, chosen
_READABLE = 0.9  # probability that some side can be read: paint may be worn off, or no text, chosen

_SURENESS = (-4.5, -1.05, 3.15)
"""Parameters a, b, c of the likelihood ratio of upright letters over anything else.

It is exp(a + b log(x + d) + c log n): x is how unsure the network is, minus the log probability of its best
strokes, and n is how many letters they have: what is not upright is seldom taken for three letters. Logistic
regression on 63 words of two rendered ports, by each image and side (1,134 patches that are not blank).
"""

_LEAST_UNSURE = 0.03  # d, fitted with them
_MOST_LETTERS = 4  # more say no more; few words of the ports have as many

_CORRELATION = 0.5  # of the errors of two images of a word
_HIDDEN = 0.2  # probability that an image shows something else, such as a thing before the word, chosen
_FIRST_VIEWS = 2  # images of a word that are read first
_SURE = 0.8
"""Confidence of a reading by the first images from which no others are read.

Of 65 words of two rendered ports the same 60 are read rightly as by all images, by 11 patches instead of 24.
"""

_FEWEST_OF_MEDIAN = 3  # fewest images whose median is read, too
_LEAST_OF_TWO = 0.5  # least probability that one of the two likeliest strings is right
_WORTH_TELLING = 0.05  # least probability of an alternative that is kept

_NEAR_M = 15.0  # distance, m, within which the vehicle's way counts as the direction of driving at a word

_View = list[Letters]  # of one image, by the direction that is above


def with_readings(
    hd_map: HDMap,
    footage: Footage,
    cameras: Mapping[str, Camera],
    light: Callable[[Image], NDArray[np.float32]],
    recogniser: Recogniser,
    threads: int = 1,
) -> HDMap:
    """``hd_map`` with the readings of those of its words that images show.

    ``light`` reads an image as :func:`~v2hdm.words.patches.patches_of` takes it.
    """
    places = [k for k, symbol in enumerate(hd_map.symbols) if symbol.kind == TEXT]
    words = [Word.around(hd_map.symbols[k].outline_map) for k in places]
    symbols = list(hd_map.symbols)
    readings = readings_of(words, footage, cameras, light, recogniser, threads)
    for place, word, read in zip(places, words, readings, strict=True):
        if read is not None:
            symbols[place] = _upright(symbols[place], word.up_map[read.side], read.reading)
    _log.info("read %d of %d words", sum(symbol.reading is not None for symbol in symbols), len(words))
    return replace(hd_map, symbols=tuple(symbols))


def readings_of(
    words: Sequence[Word],
    footage: Footage,
    cameras: Mapping[str, Camera],
    light: Callable[[Image], NDArray[np.float32]],
    recogniser: Recogniser,
    threads: int = 1,
) -> list[Upright | None]:
    """The reading of each word by the images that show it best; all of them where the first leave doubt.

    ``light`` reads an image as :func:`~v2hdm.words.patches.patches_of` takes it.
    """
    views = best_views(words, footage, cameras)
    priors = [side_prior(word, footage.map_from_vehicle) for word in words]
    patches: list[list[list[Grey]]] = [[] for _ in words]
    letters: list[list[_View]] = [[] for _ in words]
    readings: list[Upright | None] = [None] * len(words)
    for ranks in (slice(_FIRST_VIEWS), slice(_FIRST_VIEWS, None)):
        images_to_read = [
            [] if _is_sure(reading) else images[ranks]
            for reading, images in zip(readings, views, strict=True)
        ]
        fresh: list[list[list[Grey]]] = [[] for _ in words]
        for patch in patches_of(words, images_to_read, footage, light, threads):
            fresh[patch.word].append(patch.upright)
        for number in np.flatnonzero([len(patches_of_word) for patches_of_word in fresh]).tolist():
            patches[number] += fresh[number]
            letters[number] += letters_of(fresh[number], recogniser)
            views_of_word = letters[number] + letters_of(medians_of(patches[number]), recogniser)
            readings[number] = reading_of(views_of_word, priors[number])
    return readings


def _is_sure(read: Upright | None) -> bool:
    return read is not None and read.reading.confidence >= _SURE


def medians_of(patches: Sequence[list[Grey]]) -> list[list[Grey]]:
    """The median of a word's patches, from which passing things are gone, where there are enough."""
    if len(patches) < _FEWEST_OF_MEDIAN:
        return []
    by_side = zip(*patches, strict=True)
    return [[np.asarray(np.median(side, axis=0), dtype=np.uint8) for side in by_side]]


def letters_of(patches: Sequence[list[Grey]], recogniser: Recogniser) -> list[_View]:
    """The letters in the patches of a word, by image and side."""
    return [[recogniser.read(upright) for upright in patch] for patch in patches]


def _upright(symbol: Symbol, up_map: FloatArray, reading: Reading) -> Symbol:
    """A text with its reading; its outline begins at the lower left corner where ``up_map`` (2,) is above."""
    right_map = -turned_left(up_map)
    first = int(np.argmin(symbol.outline_map @ (up_map + right_map)))
    order = np.roll(np.arange(len(symbol.outline_map)), -first)
    stacked = (2 * order[:, None] + [0, 1]).ravel()
    heights_m, sigma_m, covariance_m2 = symbol.heights_m, symbol.heights_sigma_m, symbol.covariance_m2
    return replace(
        symbol,
        outline_map=symbol.outline_map[order],
        heights_m=None if heights_m is None else heights_m[order],
        heights_sigma_m=None if sigma_m is None else sigma_m[order],
        covariance_m2=None if covariance_m2 is None else covariance_m2[np.ix_(stacked, stacked)],
        reading=reading,
    )


def side_prior(word: Word, map_from_vehicle: Sequence[FloatArray]) -> FloatArray:
    """The probability (4,) of each side to be above, by the poses (4, 4) that pass the word."""
    poses = np.array(map_from_vehicle)
    is_near = np.linalg.norm(poses[:, :2, 3] - word.middle_map, axis=1) < _NEAR_M
    ahead = poses[is_near][:, :2, 0] if is_near.any() else np.zeros((0, 2))
    if not len(ahead):
        return np.full(DIRECTIONS, 1.0 / DIRECTIONS)
    cosine = ahead @ word.up_map.T
    share = _ALONG * _around(cosine) + _AGAINST * _around(-cosine) + _ANY / (2 * np.pi)
    return np.asarray((share / share.sum(axis=1, keepdims=True)).mean(axis=0))


def _around(cosine: FloatArray) -> FloatArray:
    """The density of von Mises by the cosine of an angle from its middle."""
    return np.asarray(np.exp(_CONCENTRATION * (cosine - 1.0)) / (2 * np.pi * i0e(_CONCENTRATION)))


class Upright(NamedTuple):
    """A reading, and the side that is above in it."""

    reading: Reading
    side: int


def reading_of(views: Sequence[_View], prior: FloatArray) -> Upright | None:
    """The reading of a word by its images and the ``prior`` (4,) of the side that is above.

    None where neither of the two likeliest strings is likelier than not.
    """
    if not views:
        return None
    by_text: dict[str, FloatArray] = {}  # the log odds of a string, over that nothing can be read, by side
    others = []
    for side in range(DIRECTIONS):
        odds = _log_odds([view[side] for view in views])
        prior_odds = np.log(_READABLE / (1.0 - _READABLE) * prior[side])
        others.append(odds.pop("") + prior_odds)
        for text, value in odds.items():
            by_text.setdefault(text, np.full(DIRECTIONS, -np.inf))[side] = value + prior_odds
    total = logsumexp([0.0, *others, *np.ravel(list(by_text.values()))])
    share_of = {text: np.exp(odds_of_sides - total) for text, odds_of_sides in by_text.items()}
    ranked = sorted(share_of.items(), key=lambda item: -item[1].sum())
    if sum(shares_of_sides.sum() for _, shares_of_sides in ranked[:2]) < _LEAST_OF_TWO:
        return None
    (text, shares_of_sides), *alternatives = ranked
    reading = Reading(text, float(shares_of_sides.sum()))
    if alternatives and alternatives[0][1].sum() >= _WORTH_TELLING:
        reading = Reading(*reading[:2], alternatives[0][0], float(alternatives[0][1].sum()))
    return Upright(reading, int(shares_of_sides.argmax()))


def _log_odds(letters: Sequence[Letters]) -> dict[str, float]:
    """The log odds of each string, over that nothing can be read, if this side is above.

    The empty string stands for all strings that no image prefers. Images tell strokes first; strings of the
    same strokes share their odds by what is spelled on the ground.
    """
    weight = 1.0 / (1.0 + _CORRELATION * (len(letters) - 1))
    best = {of_image.best.strip() for of_image in letters} - {""}
    groups = alike_strings(best, "".join(of_image.alphabet for of_image in letters))
    by_group = [[[of_image.log_of(text) for text in texts] for of_image in letters] for texts in groups]
    log_shares = np.array([logsumexp(by_image, axis=1) for by_image in by_group]).reshape(-1, len(letters)).T
    sureness = _sureness(letters, log_shares)
    shares = np.exp(log_shares)
    remainder = np.maximum(1.0 - shares.sum(axis=1), 0.0)
    shares = np.column_stack([shares, remainder])
    log_odds = weight * np.log((1.0 - _HIDDEN) * sureness[:, None] * shares + _HIDDEN).sum(axis=0)
    out = {"": float(log_odds[-1])}
    for texts, value in zip(groups, log_odds[:-1].tolist(), strict=True):
        spelled = _log_spelled(texts, letters, weight)
        out |= dict(zip(texts, (value + spelled).tolist(), strict=True))
    return out


def _sureness(letters: Sequence[Letters], log_shares: FloatArray) -> FloatArray:
    """The likelihood ratios (I,) of upright letters in I images, by the log probability (I, G) of strokes."""
    constant, slope, of_length = _SURENESS
    length = np.array([len(of_image.best.strip()) for of_image in letters])
    unsure = np.maximum(-log_shares.max(axis=1, initial=-np.inf), 0.0)
    log_length = np.log(np.clip(length, 1, _MOST_LETTERS))
    ratio = np.exp(constant + slope * np.log(unsure + _LEAST_UNSURE) + of_length * log_length)
    return np.where(length > 0, ratio, 0.0)


def _log_spelled(texts: Sequence[str], letters: Sequence[Letters], weight: float) -> FloatArray:
    """The log probability (N,) of each of N strings of the same strokes, given that it is one of them."""
    if len(texts) == 1:
        return np.zeros(1)
    log_shares = np.array([[of_image.alike.log_of(text) for text in texts] for of_image in letters])
    shares = np.exp(log_shares - logsumexp(log_shares, axis=1, keepdims=True))
    by_images = weight * np.log((1.0 - _HIDDEN) * shares + _HIDDEN / len(texts)).sum(axis=0)
    log_odds = by_images + [log_density(text) for text in texts]
    return np.asarray(log_odds - logsumexp(log_odds))

"""Spelling on the ground: what kinds of strings are painted, and which letters look alike in paint.

In many hands a painted 0 is an O and a 5 an S, stroke by stroke: only their neighbours tell. Numbers, words,
and codes of letters before digits stand on the ground; letters and digits in any other order are rare.
"""

from __future__ import annotations

import math
import string
from collections.abc import Iterable

from v2hdm.records import FloatArray

_ALIKE = {
    ("O", "0"): 0.4, ("I", "1"): 0.3, ("S", "5"): 0.3, ("Z", "2"): 0.1, ("G", "6"): 0.05, ("B", "8"): 0.03,
}  # fmt: skip
"""Probability that a letter or a digit is named where the other of the two is painted, chosen.

Two of the same strokes would have .5.
"""

_DIGIT_LIKE = dict(_ALIKE.keys())
_LETTER_LIKE = {digit: letter for letter, digit in _ALIKE}
_AS_DIGITS = str.maketrans(_DIGIT_LIKE)

# Probabilities of the kinds of strings on the ground, chosen.
_NUMBER = 0.3  # of digits alone
_WORD = 0.35  # of letters alone
_CODE = 0.3  # of letters before digits
_OTHER = 0.05  # of anything else

_DIGITS = 10  # in the alphabet of the ground
_LETTERS = 26  # in the alphabet of the ground
_ALL = _DIGITS + _LETTERS


def with_look_alikes(probability: FloatArray, alphabet: str) -> FloatArray:
    """Probabilities (T, C) of letters, shared with those that look alike in paint."""
    channel = {letter: alphabet.index(letter) for pair in _ALIKE for letter in pair if letter in alphabet}
    shared = probability.copy()
    for (first, second), share in _ALIKE.items():
        if first in channel and second in channel:
            moved = share * (probability[:, channel[second]] - probability[:, channel[first]])
            shared[:, channel[first]] += moved
            shared[:, channel[second]] -= moved
    return shared


def alike_strings(texts: Iterable[str], alphabet: str) -> list[list[str]]:
    """Strings in groups of the same strokes, each with the number, word and codes that it may also be.

    Only letters of the ``alphabet`` are used.
    """
    groups: dict[str, set[str]] = {}
    usable = set(alphabet)
    for text in sorted(texts):
        spelled = {spelling for spelling in _spellings(text) if set(spelling) <= usable}
        groups.setdefault(text.translate(_AS_DIGITS), set()).update(spelled)
    return [sorted(group) for group in groups.values()]


def _spellings(text: str) -> set[str]:
    out = {text}
    for split in range(len(text) + 1):
        front = "".join(_LETTER_LIKE.get(letter, letter) for letter in text[:split])
        back = "".join(_DIGIT_LIKE.get(letter, letter) for letter in text[split:])
        if _letters_before_digits(front + back) is not None:
            out.add(front + back)
    return out


def log_density(text: str) -> float:
    """The log probability of a string on the ground, over that of any string of as many signs."""
    letters = _letters_before_digits(text)
    if not text or letters is None:
        return math.log(_OTHER)
    digits = len(text) - letters
    density = (_ALL / _LETTERS) ** letters * (_ALL / _DIGITS) ** digits
    if letters == 0:
        kind = _NUMBER
    elif digits == 0:
        kind = _WORD
    else:
        kind = _CODE * 0.5**letters / (1.0 - 0.5 ** (len(text) - 1))  # each letter more is half as likely
    return math.log(_OTHER + kind * density)


def _letters_before_digits(text: str) -> int | None:
    """How many letters a string has before its digits; None if it has anything else."""
    if not text.isascii():
        return None
    digits = text.lstrip(string.ascii_letters)
    return len(text) - len(digits) if not digits or digits.isdigit() else None

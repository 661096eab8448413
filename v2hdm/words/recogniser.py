"""The network of the extra ``text``: probabilities of letters along a patch, and those of whole strings.

The network is PP-OCRv6 (small) from the wheel of ``rapidocr``; its file also lists its letters. It was
trained with connectionist temporal classification (Graves et al., ICML 2006), CTC: each column of the output
is a distribution of letters and of "no new letter", and a string is as probable as all columns that spell it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from v2hdm.errors import ConfigError, one_line
from v2hdm.records import FloatArray, IntArray
from v2hdm.words.spelling import with_look_alikes

HEIGHT_PX = 48  # height of the network's input, px
_GREY_HALF = 127.5  # grey value that the network takes for 0; it takes 255 for 1
_FILES = "models/*rec*.onnx"  # the network's file in the package
_LETTERS = "character"  # key of the file's metadata with its letters, a line each
_NO_LETTER = 0  # channel of "no new letter"

# Weights of letters on roads and in yards before any is seen, relative to those of capitals and digits.
_SMALL_LETTER = 0.2  # chosen: most words are capitals
_OTHER_SIGN = 0.02  # chosen: rare, and the network takes illegible paint for one of its 18,000 Chinese signs

_ANY_OTHER = "\ufffd"  # stands for the likeliest of all letters that a patch does not list
_FAINTEST = 1e-12  # least probability of a letter: none is impossible

MISSING = "words are mapped but not read: install the text extra, pip install 'v2hdm[text]'"


@dataclass(frozen=True)
class Letters:
    """The log probabilities (T, C) of letters along a patch.

    A letter that is not in the ``alphabet`` has the probability of its last.
    """

    log_probability: FloatArray
    alphabet: str

    @cached_property
    def best(self) -> str:
        """The string of the likeliest column after column."""
        channels = self.log_probability.argmax(axis=1)
        is_new = np.append(True, channels[1:] != channels[:-1])
        return "".join(self.alphabet[channel] for channel in channels[is_new] if channel != _NO_LETTER)

    @cached_property
    def alike(self) -> Letters:
        """The same with letters that look alike in paint sharing their probability."""
        probability = with_look_alikes(np.exp(self.log_probability), self.alphabet)
        return Letters(np.log(probability), self.alphabet)

    def log_of(self, text: str) -> float:
        """The log probability of a string, over all ways to spell it (the forward pass of CTC)."""
        if not text:
            return float(self.log_probability[:, _NO_LETTER].sum())
        letters = self._channels(text)
        states = np.full(2 * len(letters) + 1, _NO_LETTER)
        states[1::2] = letters
        # A letter follows the one before it without a gap, unless it repeats it.
        skips = np.zeros(len(states), dtype=bool)
        skips[3::2] = letters[1:] != letters[:-1]
        forward = np.full(len(states), -np.inf)
        forward[:2] = self.log_probability[0, states[:2]]
        stepped = np.full(len(states), -np.inf)
        skipped = np.full(len(states), -np.inf)
        for column in self.log_probability[1:, states]:
            stepped[1:] = forward[:-1]
            skipped[2:] = np.where(skips[2:], forward[:-2], -np.inf)
            forward = np.logaddexp(np.logaddexp(forward, stepped), skipped) + column
        return float(np.logaddexp(forward[-1], forward[-2]))

    def _channels(self, text: str) -> IntArray:
        return np.array([self.alphabet.find(letter) for letter in text]) % len(self.alphabet)


@dataclass(frozen=True)
class Recogniser:
    """The network and its alphabet, by the channels of its output."""

    session: onnxruntime.InferenceSession
    alphabet: str

    def read(self, patch: NDArray[np.uint8]) -> Letters:
        """The letters of a patch (48, W) of grey values, 0 to 255, whose text runs from left to right.

        Their alphabet is that of the ground and whatever else is likeliest somewhere along the patch.
        """
        grey = np.asarray(patch / np.float32(_GREY_HALF) - 1, dtype=np.float32)
        batch = np.broadcast_to(grey, (1, 3, *grey.shape))
        (output,) = self.session.run(None, {self.session.get_inputs()[0].name: np.ascontiguousarray(batch)})
        weighted = output[0] * self._weights
        weighted += np.float32(_FAINTEST)
        channels = np.unique(np.append(self._usual, weighted.argmax(axis=1)))
        total = weighted.sum(axis=1)
        of_channels = weighted[:, channels]
        weighted[:, channels] = 0.0
        probability = np.column_stack([of_channels, weighted.max(axis=1)]).astype(np.float64) / total[:, None]
        return Letters(
            np.log(np.maximum(probability, _FAINTEST)),
            "".join([*(self.alphabet[channel] for channel in channels), _ANY_OTHER]),
        )

    @cached_property
    def _weights(self) -> NDArray[np.float32]:
        """The weight (C,) of each channel before anything is seen."""
        weights = np.full(len(self.alphabet), _OTHER_SIGN, dtype=np.float32)
        for channel in self._usual.tolist():
            weights[channel] = _SMALL_LETTER if self.alphabet[channel].islower() else 1.0
        return weights

    @cached_property
    def _usual(self) -> IntArray:
        """The channels of "no new letter" and of the letters and digits of the ground."""
        is_usual = [letter.isascii() and letter.isalnum() for letter in self.alphabet]
        is_usual[_NO_LETTER] = True
        return np.flatnonzero(is_usual)


def load_recogniser(threads: int) -> Recogniser | None:
    """The network of the extra ``text``, None where that is not installed.

    Raises ConfigError where the installed package has no such network.
    """
    package = find_spec("rapidocr")
    if package is None or not package.submodule_search_locations:
        return None
    folder = Path(package.submodule_search_locations[0])
    advice = "install rapidocr as the text extra does, pip install 'v2hdm[text]'"
    files = sorted(folder.glob(_FILES))
    if len(files) != 1:
        raise ConfigError(f"{folder}: {len(files)} networks {_FILES}, not one; {advice}")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    # Threads that spin while they wait take the time of the workers beside them.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = onnxruntime.InferenceSession(str(files[0]), options, providers=["CPUExecutionProvider"])
        lines = session.get_modelmeta().custom_metadata_map[_LETTERS].split("\n")
    except KeyError:
        raise ConfigError(f"{files[0]}: does not list its letters; {advice}") from None
    except Exception as error:  # onnxruntime's own are of many kinds
        raise ConfigError(f"{files[0]}: cannot be loaded ({one_line(str(error))}); {advice}") from None
    channels = session.get_outputs()[0].shape[-1]
    alphabet = "\0" + "".join(line if len(line) == 1 else "\ufffd" for line in lines) + " "
    if len(alphabet) != channels:
        raise ConfigError(f"{files[0]}: {channels} channels for {len(alphabet)} letters; {advice}")
    return Recogniser(session, alphabet)

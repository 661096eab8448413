"""The horizon of each image of a source, from its own lines and from the other images.

Images come from one mounting or from several, nobody says how many: a Dirichlet process mixture (Ferguson,
Ann. Statist. 1973), estimated image by image (Wang and Dunson, J. Comput. Graph. Statist. 2011). The pitch of
an image differs from that of its mounting with the vehicle's body and the road; its standard deviation is
estimated from the mounting's images. So images of one camera narrow each other's horizons, unrelated
photographs do not, and an image without lines has the horizons of the others. How often an image has the same
mounting as the one before is estimated as well. Focal length and height stay as uncertain as their priors.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, replace

import numpy as np

from v2hdm.detection.mounting import HorizonGrid, Lines, Mounting
from v2hdm.records import CameraInfo, FloatArray

BODY_SIGMA_RAD = np.deg2rad(0.35)
"""Standard deviation of a body's pitch on its suspension: .3 to .4 degrees in 106 photographs of one camera,
and .1 to .4 on a drive of KITTI."""

_SPREADS_RAD = BODY_SIGMA_RAD * np.array([1.0, 2.0, 4.0])
"""Standard deviations of the pitch of a mounting's images, equally likely beforehand.

262 photographs of seven roads are as likely, image after image, with up to two more of them or one less.
"""

_NEW = 1.0  # images that a new mounting weighs like, against those seen: .3 to 3 are as good in these images
_MOST = 16  # mountings that are kept: those of the fewest images go
_ALIKE_RAD = np.deg2rad(1.0)  # pitches this far apart find nearly the same markings


@dataclass
class _Group:
    """Images of one mounting."""

    belief: FloatArray  # (S, P, R) over spread, pitch and roll; the sum is 1
    weight: float  # number of images


@dataclass(frozen=True)
class _Statement:
    """The information on the mountings that came from one image."""

    likelihood: FloatArray  # (P, R)
    share: dict[int, float]  # probability of each group, by its number
    factor: dict[int, FloatArray]  # of the belief (S, P, R) of each group


class Horizons:
    """The horizons of a source's images; each in turn has the earlier ones as its prior."""

    def __init__(self, info: CameraInfo, prior: Mounting):
        self.info = info
        self.images = 0
        self._grid = HorizonGrid(info, prior)
        spread = np.minimum(_SPREADS_RAD[:, None, None], prior.sigma_rad[0])
        off = (self._grid.pitch_rad[:, None] - self._grid.pitch_rad) / spread
        kernel = np.exp(-0.5 * off**2)
        self._moved: FloatArray = kernel / kernel.sum(axis=1, keepdims=True)  # (S, P, P): image from mounting
        count = len(_SPREADS_RAD)
        self._base = np.repeat(self._grid.prior_share[None] / count, count, axis=0)
        self._groups: dict[int, _Group] = {}
        self._previous: dict[int, float] = {}  # probability of each group for the image before
        self._stayed = 1.0, 2.0  # images of the mounting of the one before, of how many
        self._statements: dict[Hashable, _Statement] = {}
        self._numbers = 0  # groups so far

    @property
    def mounting(self) -> Mounting:
        """The mounting of most images so far; its standard deviations leave out how one image differs."""
        group = max(self._groups.values(), key=lambda group: group.weight, default=None)
        belief = (self._base if group is None else group.belief).sum(axis=0)
        return self._summary(belief, np.ones(len(self._grid.pitch_rad)))

    @property
    def of_mounting(self) -> float:
        """Share of the images with that mounting."""
        weights = [group.weight for group in self._groups.values()]
        return max(weights, default=0.0) / max(sum(weights), 1e-9)

    def add(self, lines: Lines, key: Hashable | None = None) -> None:
        """Take in the lines of an image out of order; :meth:`earlier` asks for it by its ``key``."""
        self._previous = {}
        self._take(self._grid.likelihood(lines), key)
        self._previous = {}

    def next(self, lines: Lines) -> Mounting:
        """The mounting of the next image with its own pitch, by its lines and those of the others."""
        likelihood = self._grid.likelihood(lines)
        belief = self._expected(self._weights()) * likelihood
        self._take(likelihood)
        return self._likeliest(belief)

    def earlier(self, key: Hashable) -> Mounting | None:
        """The mounting of an image that was added under this ``key``, or None; its lines count once."""
        statement = self._statements.pop(key, None)
        if statement is None:
            return None
        without = dict(self._groups)
        for name, factor in statement.factor.items():
            if name in without:
                belief = without[name].belief / factor
                weight = max(without[name].weight - statement.share[name], 0.0)
                without[name] = _Group(belief / belief.sum(), weight)
        belief = statement.likelihood * self._expected(self._weights(without), without)
        self._previous = {name: part for name, part in statement.share.items() if name in self._groups}
        return self._likeliest(belief)

    def coming(self, share: float) -> tuple[Mounting, float]:
        """The likeliest mounting of the next image, and the pitch, rad, that a ``share`` is not beyond."""
        belief = self._expected(self._weights())
        below = np.cumsum(belief.sum(axis=1))
        at = min(int(np.searchsorted(below, share * below[-1])), len(below) - 1)
        return self._likeliest(belief), float(self._grid.pitch_rad[at])

    def _weights(self, groups: dict[int, _Group] | None = None) -> dict[int | None, float]:
        """Prior probability of each group for the next image; None stands for a new group."""
        groups = self._groups if groups is None else groups
        counts: dict[int | None, float] = {None: _NEW}
        counts |= {name: group.weight for name, group in groups.items()}
        total = sum(counts.values())
        stays = self._stayed[0] / self._stayed[1] if self._previous else 0.0
        stayed: dict[int | None, float] = dict(self._previous.items())
        return {
            name: (1 - stays) * count / total + stays * stayed.get(name, 0.0)
            for name, count in counts.items()
        }

    def _belief(self, name: int | None, groups: dict[int, _Group]) -> FloatArray:
        return self._base if name is None else groups[name].belief

    def _expected(
        self, weights: dict[int | None, float], groups: dict[int, _Group] | None = None
    ) -> FloatArray:
        """Prior (P, R) of the pitch and roll of an image, by the probability of each group."""
        groups = self._groups if groups is None else groups
        mixed = np.sum([weight * self._belief(name, groups) for name, weight in weights.items()], axis=0)
        return np.asarray((self._moved @ mixed).sum(axis=0) * self._grid.shows_ground[:, None])

    def _take(self, likelihood: FloatArray, key: Hashable | None = None) -> None:
        """Narrow the mountings that an image may have by its likelihood (P, R), or begin a new mounting."""
        weights = self._weights()
        of_mounting = self._moved.swapaxes(1, 2) @ likelihood  # (S, P, R)
        fit = {name: float((self._belief(name, self._groups) * of_mounting).sum()) for name in weights}
        total = sum(weights[name] * fit[name] for name in weights)
        if self._previous:
            stays = self._stayed[0] / self._stayed[1]
            stayed = sum(stays * part * fit[name] for name, part in self._previous.items()) / total
            self._stayed = self._stayed[0] + stayed, self._stayed[1] + 1
        posterior = {name: weights[name] * fit[name] / total for name in weights}
        new_share = posterior.pop(None)
        share: dict[int, float] = {name: part for name, part in posterior.items() if name is not None}
        if new_share >= max(share.values(), default=0.0):
            share[self._new_group()] = new_share
            share = {name: part for name, part in share.items() if name in self._groups}
        factor = {name: 1 - part + part * of_mounting for name, part in share.items()}
        for name, part in share.items():
            belief = self._groups[name].belief * factor[name]
            self._groups[name] = _Group(belief / belief.sum(), self._groups[name].weight + part)
        self.images += 1
        self._previous = share
        if key is not None:
            self._statements[key] = _Statement(likelihood, share, factor)

    def _new_group(self) -> int:
        """The number of a new group without images; where there are too many, the smallest group goes."""
        if len(self._groups) == _MOST:
            del self._groups[min(self._groups, key=lambda name: self._groups[name].weight)]
        self._numbers += 1
        self._groups[self._numbers] = _Group(self._base, 0.0)
        return self._numbers

    def _likeliest(self, belief: FloatArray) -> Mounting:
        """The mounting whose pitch has the most of a belief (P, R) about it."""
        pitch = self._grid.pitch_rad
        alike = np.exp(-0.5 * ((pitch[:, None] - pitch) / _ALIKE_RAD) ** 2)
        return self._summary(belief, alike[int((alike @ belief.sum(axis=1)).argmax())])

    def _summary(self, belief: FloatArray, window: FloatArray) -> Mounting:
        """Means of a belief (P, R) within a ``window`` (P,) of pitches; about them, sigmas of all of it."""
        windowed = belief * window[:, None]
        windowed = windowed / windowed.sum()
        belief = belief / belief.sum()
        means = []
        sigmas = []
        values = (self._grid.pitch_rad, self._grid.roll_rad)
        for axis, (value, within) in enumerate(zip(values, self._grid.variance_rad2, strict=True)):
            means.append(float(windowed.sum(axis=1 - axis) @ value))
            sigmas.append(float(np.sqrt(belief.sum(axis=1 - axis) @ (value - means[-1]) ** 2 + within)))
        pitch_sigma, roll_sigma = sigmas
        return replace(
            self._grid.prior, pitch_rad=means[0], roll_rad=means[1], sigma_rad=(pitch_sigma, roll_sigma)
        )

"""Trains the :class:`models.judge.Judge` on quadrilaterals of which it is known whether they are markings."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import binary_cross_entropy_with_logits

from models.judge import Judge

_BATCH = 64  # quadrilaterals in a batch
_LEAST_DEVIATION = 1e-6  # least standard deviation of a feature that is divided by


@dataclass(frozen=True)
class Quadrilaterals:
    """N of them: ``views`` (N, C, S, S), ``evidence`` (N, F), one-hot ``shape`` (N, K), ``true`` (N,).

    ``side_error`` (N, 4), px, is how far the true side lies outside the fitted one, nan where that is not
    known, and ``side_variance`` (N, 4), px^2, what the fit says of it; sides are in the order of the views.
    ``claimed_channels`` and ``claimed_features`` are those of views and evidence that are claims of the paint
    network; the others are the image's.
    """

    views: NDArray[np.float32]
    evidence: NDArray[np.float32]
    shape: NDArray[np.float32]
    true: NDArray[np.bool_]
    side_error: NDArray[np.float32]
    side_variance: NDArray[np.float32]
    claimed_channels: tuple[int, ...] = ()
    claimed_features: tuple[int, ...] = ()

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> Quadrilaterals:
        """Some of them."""
        parts = (self.views, self.evidence, self.shape, self.true, self.side_error, self.side_variance)
        chosen = (part[rows] for part in parts)
        return Quadrilaterals(*chosen, self.claimed_channels, self.claimed_features)


@dataclass(frozen=True, kw_only=True)
class JudgeConfig:
    """How the classifier learns; rate and decay are those of AdamW (Loshchilov and Hutter, ICLR 2019).

    Its inputs are varied, as by other cameras and roads: each channel of a view by a factor whose logarithm
    has ``light_sigma``, the evidence by ``evidence_sigma`` of its own deviation. In a ``claimed_share`` of
    the cases the network's output is its mean output on markings, so that the image decides where the network
    is confident and wrong. ``side_weight`` is that of the sides' errors in the loss.
    """

    epochs: int = 18
    learning_rate: float = 3e-3
    weight_decay: float = 2e-2
    width: int = 24
    dropout: float = 0.3
    side_weight: float = 0.1
    light_sigma: float = 0.4
    evidence_sigma: float = 0.2
    claimed_share: float = 0.2
    seed: int = 0


def train_judge(quadrilaterals: Quadrilaterals, config: JudgeConfig, start: Judge | None = None) -> Judge:
    """A judge that has learnt from all of ``quadrilaterals``, ready to be asked.

    One to ``start`` from knows most of it already: a quarter of the time at a third of the rate is enough.
    """
    torch.manual_seed(config.seed)
    rng = np.random.default_rng(config.seed)
    channels = quadrilaterals.views.shape[1]
    features = quadrilaterals.evidence.shape[1]
    shapes = quadrilaterals.shape.shape[1]
    judge = Judge(channels, features, shapes, config.width, config.dropout).train()
    if start is not None:
        judge.load_state_dict(start.state_dict())
        config = replace(config, epochs=-(-config.epochs // 4), learning_rate=config.learning_rate / 3)
    else:
        judge.mean.copy_(torch.from_numpy(quadrilaterals.evidence.mean(axis=0)))
        judge.deviation.copy_(
            torch.from_numpy(np.maximum(quadrilaterals.evidence.std(axis=0), _LEAST_DEVIATION))
        )
    parts = [
        torch.from_numpy(part)
        for part in (quadrilaterals.views, quadrilaterals.evidence, quadrilaterals.shape)
    ]
    true = torch.from_numpy(quadrilaterals.true.astype(np.float32))
    side_error = torch.from_numpy(quadrilaterals.side_error)
    side_variance = torch.from_numpy(quadrilaterals.side_variance)
    claims = _Claims.of(quadrilaterals)
    batches = -(-len(true) // (_BATCH if start is None else 2 * _BATCH))
    optimiser = torch.optim.AdamW(judge.parameters(), config.learning_rate, weight_decay=config.weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, config.learning_rate, total_steps=config.epochs * batches
    )
    for _ in range(config.epochs):
        for batch in np.array_split(rng.permutation(len(true)), batches):
            rows = torch.from_numpy(batch)
            views, evidence, shape = (part[rows] for part in parts)
            views, sides = _mirrored(views, rng)
            views = _in_other_light(views, config.light_sigma, rng)
            claimed = torch.from_numpy(rng.random(len(batch)) < config.claimed_share)
            views, evidence = claims.put(views, evidence, claimed)
            noise = torch.from_numpy(rng.standard_normal(evidence.shape).astype(np.float32))
            odds, log_sigma = judge(views, evidence + config.evidence_sigma * judge.deviation * noise, shape)
            error, variance = (part[rows].gather(1, sides) for part in (side_error, side_variance))
            loss = binary_cross_entropy_with_logits(odds, true[rows])
            loss = loss + config.side_weight * _side_loss(error, variance, log_sigma)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
    return judge.eval()


_FREEDOM = 4.0
"""Degrees of freedom of the t distribution that errors of sides have: a few are of something else
altogether."""


def _side_loss(error: torch.Tensor, variance: torch.Tensor, log_sigma: torch.Tensor) -> torch.Tensor:
    """Minus the mean log likelihood of errors (B, 4), nan where unknown, whose formal variance is (B, 4)."""
    is_known = torch.isfinite(error)
    total = variance + torch.exp(2 * log_sigma)
    square = torch.where(is_known, error, torch.zeros_like(error)) ** 2 / total
    loss = 0.5 * torch.log(total) + 0.5 * (_FREEDOM + 1) * torch.log1p(square / _FREEDOM)
    return (loss * is_known).sum() / is_known.sum().clamp(min=1)


def judged(judge: Judge, quadrilaterals: Quadrilaterals) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Log odds (N,), and how far the sides may be off (N, 4), px."""
    out = []
    sides = []
    with torch.no_grad():
        for first in range(0, len(quadrilaterals.true), 512):
            part = quadrilaterals.take(np.arange(first, min(first + 512, len(quadrilaterals.true))))
            inputs = (torch.from_numpy(array) for array in (part.views, part.evidence, part.shape))
            odds, log_sigma = judge(*inputs)
            out.append(odds.numpy().astype(np.float64))
            sides.append(log_sigma.exp().numpy().astype(np.float64))
    return (np.concatenate(out), np.concatenate(sides)) if out else (np.zeros(0), np.zeros((0, 4)))


@dataclass(frozen=True)
class _Claims:
    """The network's mean output on markings: channels (C', S, S) and features (F')."""

    channels: list[int]
    features: list[int]
    views: torch.Tensor
    evidence: torch.Tensor

    @classmethod
    def of(cls, quadrilaterals: Quadrilaterals) -> _Claims:
        channels = list(quadrilaterals.claimed_channels)
        features = list(quadrilaterals.claimed_features)
        views = quadrilaterals.views[quadrilaterals.true][:, channels].mean(axis=0)
        evidence = quadrilaterals.evidence[quadrilaterals.true][:, features].mean(axis=0)
        return cls(channels, features, torch.from_numpy(views), torch.from_numpy(evidence))

    def put(
        self, views: torch.Tensor, evidence: torch.Tensor, where: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Views (M, C, S, S) and evidence (M, F) with these claims in place of their own, ``where`` (M,)."""
        views = views.clone()
        evidence = evidence.clone()
        views[:, self.channels] = torch.where(where[:, None, None, None], self.views, views[:, self.channels])
        evidence[:, self.features] = torch.where(where[:, None], self.evidence, evidence[:, self.features])
        return views, evidence


def _mirrored(views: torch.Tensor, rng: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Half of the views turned about in each direction, and which side (M, 4) is where then.

    Which corner is the first means nothing.
    """
    sides = torch.arange(4).expand(len(views), 4)
    for axis, swapped in ((2, [2, 1, 0, 3]), (3, [0, 3, 2, 1])):
        turned = torch.from_numpy(rng.random(len(views)) < 0.5)
        views = torch.where(turned[:, None, None, None], views.flip(axis), views)
        sides = torch.where(turned[:, None], sides[:, swapped], sides)
    return views, sides


def _in_other_light(views: torch.Tensor, sigma: float, rng: np.random.Generator) -> torch.Tensor:
    """Views (M, C, S, S) each of whose channels is weaker or stronger by chance."""
    gain = np.exp(sigma * rng.standard_normal((*views.shape[:2], 1, 1))).astype(np.float32)
    return views * torch.from_numpy(gain)

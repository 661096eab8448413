"""A taught network in a larger one that says the same: so that a design can grow without starting over.

After "Net2Net" (Chen, Goodfellow and Shlens, ICLR 2016): what is added computes the identity, or nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from models import MarkingNet, NetConfig

_OFF_BEFORE = {"wide_kinds": False}
"""Switches of networks that files may be older than, and what they were then."""


def recorded_net(settings: Mapping[str, Any]) -> NetConfig:
    """The network that a checkpoint or an exported file says it holds.

    Raises:
        TypeError: One of the settings is none of a network.
    """
    return NetConfig(**(_OFF_BEFORE | dict(settings)))


def can_grow(then: NetConfig, now: NetConfig) -> bool:
    """Whether ``now`` is ``then`` or a larger one.

    With more channels or context blocks, a wide head of kinds, whole convolutions for separable ones.
    """
    longer = now.dilations[: len(then.dilations)] == then.dilations
    wider = all(old <= new for old, new in zip(then.widths, now.widths, strict=True))
    more = now.wide_kinds or not then.wide_kinds
    denser = then.separable or not now.separable
    freed = replace(
        then,
        widths=now.widths,
        dilations=now.dilations,
        wide_kinds=now.wide_kinds,
        separable=now.separable,
    )
    return longer and wider and more and denser and freed == now


def grow(folded: Mapping[str, Tensor], then: NetConfig, now: NetConfig) -> dict[str, Tensor]:
    """The weights of a network ``now``, normalisations folded, that computes what ``folded`` does.

    Context blocks that are new pass on what they are given (it is not negative, their ReLU leaves it). A new
    head's last convolution is 0, and what it reads is drawn at random, as are new channels, which none of the
    old ones reads.
    """
    grown = dict(folded)
    if then == now:
        return grown
    fresh = MarkingNet(now).fold().state_dict()
    if then.separable and not now.separable:
        _join_separable(grown)
    for block in range(len(then.dilations), len(now.dilations)):
        channels = then.widths[-1]
        grown[f"context.{block}.0.weight"] = torch.nn.init.dirac_(torch.empty(channels, channels, 3, 3))
        grown[f"context.{block}.0.bias"] = torch.zeros(channels)
    if now.wide_kinds and not then.wide_kinds:
        head = {name: value for name, value in fresh.items() if name.startswith("wide_kinds.")}
        last = [name for name in head if name.startswith("wide_kinds.1.")]
        grown |= head | {name: torch.zeros_like(head[name]) for name in last}
    return {name: _widened(grown[name], value) for name, value in fresh.items()}


def _join_separable(folded: dict[str, Tensor]) -> None:
    """Replace each pair of a convolution in every channel and one across them by the one they make."""
    for across in [name for name in folded if name.endswith(".1.0.weight")]:
        layer = across.removesuffix(".1.0.weight")
        first = f"{layer}.0.0.weight"
        if first not in folded or folded[first].shape[1] != 1 or folded[across].shape[2] != 1:
            continue  # two layers that follow each other, the first of which is a whole one
        inside, mixing = folded.pop(first), folded.pop(across)
        shift = mixing[:, :, 0, 0] @ folded.pop(f"{layer}.0.0.bias")
        folded[f"{layer}.0.weight"] = mixing * inside.transpose(0, 1)
        folded[f"{layer}.0.bias"] = folded.pop(f"{layer}.1.0.bias") + shift


def _widened(old: Tensor, fresh: Tensor) -> Tensor:
    """``fresh``, in which the first channels are the ``old`` ones and read nothing of the others."""
    wide = fresh.clone()
    outputs = len(old)
    wide[:outputs] = 0
    wide[tuple(slice(size) for size in old.shape)] = old
    return wide

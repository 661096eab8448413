"""A taught network in a larger one that says the same: so that a design can grow without starting over.

After "Net2Net" (Chen, Goodfellow and Shlens, ICLR 2016): what is added computes the identity, or nothing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from models import MarkingNet, NetConfig
from v2hdm.catalogue import AREA, OTHER, QUADRILATERAL, STRIPE, SYMBOL, Catalogue
from v2hdm.errors import ConfigError
from v2hdm.records import CROSSWALK_BAR, OTHER_PAINT, STOP_LINE

_OFF_BEFORE = {"wide_kinds": False, "added_kinds": 0}
"""Switches of networks that files may be older than, and what they were then."""

_STARTS_AS = {
    QUADRILATERAL: CROSSWALK_BAR,
    STRIPE: STOP_LINE,
    SYMBOL: OTHER_PAINT,
    AREA: OTHER_PAINT,
    OTHER: OTHER_PAINT,
}
"""By family, the class that a network takes a new one for before it has learnt it."""

_STARTS_WITH = 0.05
"""Share of that class's odds that the new one starts with."""

CLASS_HEADS = ("kinds.", "wide_kinds.")
"""How the names of the weights of layers begin that only classes are read from."""

CLASS_LAYERS = ("kinds", "wide_kinds.1")
"""Layers with an output channel for each class, whose sum is the logits."""

CLASS_CHANNELS = frozenset(f"{layer}.{part}" for layer in CLASS_LAYERS for part in ("weight", "bias"))
"""Names of the weights whose first axis is that of the classes."""

HIDDEN_CLASS_LAYER = "wide_kinds.0."
"""How the names of the weights begin whose first axis is that of the channels that classes alone read."""


def read_by(weights: Mapping[str, Tensor], classes: Tensor) -> Tensor:
    """Which channels (C,) of the head's hidden layer some of the ``classes`` (K,), of booleans, read."""
    read = weights["wide_kinds.1.weight"][classes]
    return read.flatten(2).abs().amax(dim=2).amax(dim=0) > 0


def class_count(weights: Mapping[str, Tensor]) -> int:
    """How many classes a network of such weights tells apart."""
    return len(weights["kinds.bias"])


def with_classes(
    weights: Mapping[str, Tensor], then: Sequence[str], catalogue: Catalogue, where: str
) -> dict[str, Tensor]:
    """The weights of a network that knows the classes ``then``, and now those of a catalogue.

    The shares of known classes among themselves stay. A new one starts with a small share of that of the
    shipped class that it looks most like.

    Args:
        weights: of a network, folded or not.
        then: its classes, in the order of its channels.
        catalogue: the classes wanted.
        where: the weights come from, for errors.

    Raises:
        ConfigError: the catalogue lacks one of the classes.
    """
    missing = [name for name in then if name not in catalogue.classes]
    if missing:
        raise ConfigError(f"{where} knows {', '.join(missing)}: list every class of it in catalogue=, too")
    grown = dict(weights)
    if tuple(then) == catalogue.names:
        return grown
    has_earlier = [name in then for name in catalogue.names]
    origin = [
        then.index(name if name in then else _STARTS_AS[catalogue.classes[name].family])
        for name in catalogue.names
    ]
    for head in (head for head in CLASS_LAYERS if f"{head}.bias" in grown):
        for part in ("weight", "bias"):
            grown[f"{head}.{part}"] = grown[f"{head}.{part}"][origin]
    grown["kinds.bias"] = grown["kinds.bias"] + torch.where(
        torch.tensor(has_earlier), 0.0, math.log(_STARTS_WITH)
    )
    return grown


def recorded_net(settings: Mapping[str, Any]) -> NetConfig:
    """The network that a checkpoint or an exported file says it holds.

    Raises:
        TypeError: One of the settings is none of a network.
    """
    return NetConfig(**(_OFF_BEFORE | dict(settings)))


def can_grow(then: NetConfig, now: NetConfig) -> bool:
    """Whether ``now`` is ``then`` or a larger one.

    With more channels or context blocks, a wide head of kinds or more channels in it, whole convolutions for
    separable ones.
    """
    longer = now.dilations[: len(then.dilations)] == then.dilations
    wider = all(old <= new for old, new in zip(then.widths, now.widths, strict=True))
    more = (now.wide_kinds or not then.wide_kinds) and now.added_kinds >= then.added_kinds
    denser = then.separable or not now.separable
    freed = replace(
        then,
        widths=now.widths,
        dilations=now.dilations,
        wide_kinds=now.wide_kinds,
        added_kinds=now.added_kinds,
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
    fresh = MarkingNet(now, class_count(folded)).fold().state_dict()
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
        inside = folded.pop(first)
        mixing = folded.pop(across)
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

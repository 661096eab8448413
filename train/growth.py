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
    """Whether ``now`` is ``then``, or that with further context blocks or a wide head of kinds."""
    longer = now.dilations[: len(then.dilations)] == then.dilations
    wider = now.wide_kinds or not then.wide_kinds
    return longer and wider and replace(then, dilations=now.dilations, wide_kinds=now.wide_kinds) == now


def grow(folded: Mapping[str, Tensor], then: NetConfig, now: NetConfig) -> dict[str, Tensor]:
    """The weights of a network ``now``, normalisations folded, that computes what ``folded`` does.

    Context blocks that are new pass on what they are given (it is not negative, their ReLU leaves it); a new
    head's last convolution is 0, and what it reads is drawn at random.
    """
    grown = dict(folded)
    if then == now:
        return grown
    fresh = MarkingNet(now).fold().state_dict()
    for block in range(len(then.dilations), len(now.dilations)):
        convolution = fresh[f"context.{block}.0.weight"]
        grown[f"context.{block}.0.weight"] = torch.nn.init.dirac_(torch.empty_like(convolution))
        grown[f"context.{block}.0.bias"] = torch.zeros(len(convolution))
    if now.wide_kinds and not then.wide_kinds:
        head = {name: value for name, value in fresh.items() if name.startswith("wide_kinds.")}
        for name in ("wide_kinds.1.weight", "wide_kinds.1.bias"):
            head[name] = torch.zeros_like(head[name])
        grown |= head
    return grown

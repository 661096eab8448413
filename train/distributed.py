"""Several processes that train one network, started by torchrun; or one process alone.

Every process shows its own images to its own copy of the network; before each update all take the mean of
their gradients, so that the copies stay the same. The network is so small that one message an update does.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from v2hdm.errors import EXIT_USER_ERROR, ConfigError, V2hdmError

_T = TypeVar("_T")


@dataclass(frozen=True)
class Team:
    """The processes that train together, seen from one of them: number ``rank`` of ``size``."""

    device: torch.device
    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this is the process that validates, saves and reports."""
        return self.rank == 0

    def average(self, tensors: Iterable[Tensor]) -> None:
        """Replace tensors of one type by their means over all processes, in place; all must call it."""
        if self.size == 1:
            return
        group = list(tensors)
        message = torch.cat([tensor.detach().flatten() for tensor in group])
        dist.all_reduce(message)
        message /= self.size
        self._fill(group, message)

    def follow(self, tensors: Iterable[Tensor]) -> None:
        """Replace floating-point tensors by those of the leader, in place."""
        if self.size == 1:
            return
        group = [tensor for tensor in tensors if tensor.is_floating_point()]
        message = torch.cat([tensor.detach().flatten() for tensor in group])
        dist.broadcast(message, src=0)
        self._fill(group, message)

    def agree(self, value: float) -> float:
        """The leader's value."""
        if self.size == 1:
            return value
        message = torch.tensor([value], dtype=torch.float64, device=self.device)
        dist.broadcast(message, src=0)
        return float(message.item())

    def from_leader(self, make: Callable[[], _T]) -> _T:
        """The leader's result. An error of the user ends all processes; only the leader reports it.

        Raises:
            V2hdmError: In the leader, what ``make`` raised.
        """
        if self.size == 1:
            return make()
        message: list[_T | None] = [None]
        failure = None
        if self.leads:
            try:
                message = [make()]
            except V2hdmError as error:
                failure = error
        failed = self.agree(float(failure is not None))
        if failure is not None:
            raise failure
        if failed:
            raise SystemExit(EXIT_USER_ERROR)
        dist.broadcast_object_list(message, src=0, device=self.device)
        answer = message[0]
        assert answer is not None
        return answer

    @staticmethod
    def _fill(tensors: Iterable[Tensor], message: Tensor) -> None:
        with torch.no_grad():
            begin = 0
            for tensor in tensors:
                end = begin + tensor.numel()
                tensor.copy_(message[begin:end].view_as(tensor))
                begin = end


@contextmanager
def joined_team(device: str) -> Iterator[Team]:
    """The processes that torchrun started with this one, for as long as the context lasts.

    Args:
        device: ``auto``, ``cpu`` or ``cuda``; on GPUs every process of a machine takes one of its own.

    Raises:
        ConfigError: The device is unknown, or there are more processes than GPUs.
    """
    size = int(os.environ.get("WORLD_SIZE", "1"))
    local_rank = int(os.environ.get("LOCAL_RANK", "0"))
    chosen = choose_device(device, local_rank if size > 1 else None)
    if size == 1:
        yield Team(chosen)
        return
    if chosen.type == "cuda":
        torch.cuda.set_device(chosen)
    dist.init_process_group("nccl" if chosen.type == "cuda" else "gloo")
    try:
        yield Team(chosen, dist.get_rank(), size)
    finally:
        dist.destroy_process_group()


def choose_device(name: str, local_rank: int | None = None) -> torch.device:
    """The device of a name; ``auto`` is a GPU where there is one.

    Raises:
        ConfigError: It is unknown, or process ``local_rank`` of this machine has no GPU to itself.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ConfigError(f"device={name} is unknown: use auto, cpu or cuda") from error
    if device.type != "cuda" or local_rank is None:
        return device
    if local_rank >= torch.cuda.device_count():
        raise ConfigError(
            f"--nproc-per-node asks for more processes than this machine's {torch.cuda.device_count()} GPUs; "
            "start one a GPU, or set device=cpu"
        )
    return torch.device("cuda", local_rank)


def has_bfloat16(device: torch.device) -> bool:
    """Whether a device has instructions for products of bfloat16; without them it is slower than float32."""
    if device.type != "cpu":
        return device.type == "cuda"
    capabilities = torch.cpu.get_capabilities()
    return any(capabilities.get(name, False) for name in ("avx512_bf16", "amx_bf16"))

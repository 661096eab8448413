"""One site from many drives: the parts of its adjustment on Ray, several to an actor."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import ray
import torch
from torch import Tensor

from v2hdm.adjust.parts.condense import Base
from v2hdm.adjust.parts.split import Part
from v2hdm.adjust.parts.worker import Worker


class Keeper:
    """An actor that keeps some parts laid out and linearised.

    All that it keeps it makes anew from what it is asked with, so that one that died is replaced in silence.
    """

    def __init__(self) -> None:
        torch.set_num_threads(1)
        self._workers: dict[int, tuple[str, Worker]] = {}
        self._bases: dict[int, tuple[str, Base]] = {}

    def process(self) -> int:
        """Its process's number."""
        return os.getpid()

    def corners(self, parts: Sequence[tuple[int, Any]]) -> list[tuple[Tensor, Tensor]]:
        """The :attr:`Worker.corners` of parts, given by number and reference."""
        return [self._worker(*one).corners for one in parts]

    def ask(self, question: str, tasks: Sequence[tuple[int, Any, Any, tuple[Any, ...]]]) -> list[Any]:
        """Answers of parts; a task is a part's number, references to it and to its base, and the rest."""
        return [
            getattr(self._worker(number, part), question)(self._base(number, base), *rest)
            for number, part, base, rest in tasks
        ]

    def move(self, tasks: Sequence[tuple[int, Any, Any, tuple[Any, ...]]]) -> Any:
        """The bases of parts moved, each an object of its own."""
        bases = self.ask("move", tasks)
        return bases if len(bases) > 1 else bases[0]

    def _worker(self, number: int, part: Any) -> Worker:
        key = part.hex()
        if number not in self._workers or self._workers[number][0] != key:
            self._workers[number] = key, Worker(ray.get(part))
        return self._workers[number][1]

    def _base(self, number: int, base: Any) -> Base:
        key = base.hex()
        if number not in self._bases or self._bases[number][0] != key:
            self._bases[number] = key, ray.get(base)
        return self._bases[number][1]


class RayTeam:
    """A :class:`v2hdm.adjust.parts.Team` of actors; a base stays on the machine of its actor."""

    def __init__(self, actors: int, cores_each: float = 1.0) -> None:
        """Start actors that take so many cores each."""
        options: dict[str, Any] = {"num_cpus": cores_each, "max_restarts": -1, "max_task_retries": -1}
        # Without cores to book they would all be put on one machine.
        options["scheduling_strategy"] = "SPREAD"
        self.actors: list[Any] = [ray.remote(Keeper).options(**options).remote() for _ in range(actors)]

    def start(self, parts: Sequence[Part]) -> list[tuple[Tensor, Tensor]]:
        """Share the parts out, the large ones first, each to the actor that has least to do."""
        self._parts = [ray.put(part) for part in parts]
        load = [0] * len(self.actors)
        self._mine: list[list[int]] = [[] for _ in self.actors]
        sizes = [len(part.problem.observations.corner) for part in parts]
        for number in sorted(range(len(parts)), key=lambda n: (-sizes[n], n)):
            actor = load.index(min(load))
            load[actor] += sizes[number]
            self._mine[actor].append(number)
        told = [
            actor.corners.remote([(number, self._parts[number]) for number in mine])
            for actor, mine in zip(self.actors, self._mine, strict=True)
        ]
        return self._in_order(ray.get(told))

    def keep(self, bases: Sequence[Base]) -> list[Any]:
        """References to the bases."""
        return [ray.put(base) for base in bases]

    def ask(self, question: str, bases: Sequence[Any], *arguments: Sequence[Any]) -> list[Any]:
        """Ask all actors at once."""
        told = [actor.ask.remote(question, tasks) for actor, tasks in self._tasks(bases, arguments) if tasks]
        return self._in_order(ray.get(told))

    def move(self, bases: Sequence[Any], *arguments: Sequence[Any]) -> list[Any]:
        """References to the bases moved."""
        told = []
        for actor, tasks in self._tasks(bases, arguments):
            references = actor.move.options(num_returns=len(tasks)).remote(tasks) if tasks else []
            told.append(references if isinstance(references, list) else [references])
        return self._in_order(told)

    def fetch(self, bases: Sequence[Any]) -> list[Base]:
        """The bases themselves."""
        return list(ray.get(list(bases)))

    def _tasks(self, bases: Sequence[Any], arguments: Sequence[Sequence[Any]]) -> list[tuple[Any, list[Any]]]:
        return [
            (actor, [(n, self._parts[n], bases[n], tuple(one[n] for one in arguments)) for n in mine])
            for actor, mine in zip(self.actors, self._mine, strict=True)
        ]

    def _in_order(self, told: Sequence[Sequence[Any]]) -> list[Any]:
        """What the actors say of their parts, in the order of the parts."""
        out: dict[int, Any] = {}
        for mine, answers in zip(
            [one for one in self._mine if one], [one for one in told if one], strict=True
        ):
            out.update(zip(mine, answers, strict=True))
        return [out[number] for number in range(len(out))]

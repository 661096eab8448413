"""The training loop: update, average, validate, save, until time or steps are used up."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torch.utils.tensorboard import SummaryWriter

from models import MarkingNet, Prediction
from train.checkpoint import (
    Checkpoint,
    check_same_experiment,
    fresh_checkpoint,
    load_checkpoint,
    save_checkpoint,
)
from train.config import TrainConfig, check_training
from train.data import Pair, training_batches
from train.distributed import Team, choose_device, has_bfloat16
from train.growth import CLASS_CHANNELS, CLASS_HEADS, HIDDEN_CLASS_LAYER, read_by
from train.labels import read_labels
from train.losses import kept_loss, total_loss
from train.targets import Targets
from train.validation import metrics_of_sets, score_of, validation_sets
from v2hdm.errors import ConfigError
from v2hdm.safe.texts import shown

_HEADS_FASTER = 10.0
"""Heads that learn alone take steps so many times as large: the rest cannot be torn about."""

_LOG = logging.getLogger(__name__)

Progress = Callable[[float, str], None]
"""Told the share of the run that has passed and a line of figures."""


@dataclass
class Trainer:
    """A training run in the folder ``config.output``: last.pt, best.pt and TensorBoard's log.

    Each process of a distributed training has its trainer; an update takes ``config.batch`` of each.
    """

    config: TrainConfig
    progress: Progress
    team: Team | None = None

    def __post_init__(self) -> None:
        config = self.config
        check_training(config)
        torch.manual_seed(config.seed)
        torch.set_num_threads(config.threads)
        self._team = self.team or Team(choose_device(config.device))
        self.device = self._team.device
        self._halves = config.bfloat16 and has_bfloat16(self.device)
        self.output = Path(config.output)
        self.state = self._team.from_leader(self._open)
        self._resumed_at = self.state.step, self.state.renders
        self.net = MarkingNet(config.net, len(self.state.catalogue.names)).to(self.device)
        self.net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.averaged = AveragedModel(self.net, multi_avg_fn=self._average, use_buffers=True)
        self.optimizer = torch.optim.AdamW(self.net.parameters(), weight_decay=config.weight_decay)
        if self.state.model:
            self._restore()
        self._before = self._started_from() if config.start and self._heads_alone() else None
        self._stays = self._rows_that_stay()
        self._team.follow([*self.net.state_dict().values(), *self.averaged.module.state_dict().values()])

    def run(self) -> Checkpoint:
        """Train to the end; returns the last state, which is also in last.pt."""
        config = self.config
        state = self.state
        team = self._team
        part = team.rank, team.size
        classes = state.catalogue.names
        labels = read_labels(config.data, classes, self.progress)
        batches = training_batches(config.data, config.seed, config.batch, state.renders, part, labels)
        validation = validation_sets(config, classes, self.progress) if team.leads else {}
        began_s = time.monotonic() - state.elapsed_s
        saved = validated = state.elapsed_s
        with SummaryWriter(str(self.output)) if team.leads else nullcontext() as board:
            while self._share() < 1:
                loss = self._update(next(batches))
                state.elapsed_s = team.agree(time.monotonic() - began_s)
                if state.step % 20 == 0:
                    self._report(loss, board)
                if state.elapsed_s - validated > 60 * config.validation.every_minutes:
                    self._validate(validation, board)
                    validated = state.elapsed_s
                if state.elapsed_s - saved > 60 * config.checkpoint_minutes:
                    self._save("last.pt")
                    saved = state.elapsed_s
            self._validate(validation, board)
        self._save("last.pt")
        self.progress(1.0, f"step {state.step}, IoU {state.best_iou:.3f}")
        return state

    def _open(self) -> Checkpoint:
        """The state to go on from: the last of this folder, or a fresh one."""
        path = self.output / "last.pt"
        if not (self.config.resume and path.is_file()):
            return fresh_checkpoint(self.config)
        state = load_checkpoint(path)
        check_same_experiment(state, self.config, path)
        state.config = asdict(self.config)
        _LOG.info("resuming at step %d after %.1f minutes", state.step, state.elapsed_s / 60)
        return state

    def _restore(self) -> None:
        self.net.load_state_dict(self.state.model)
        self.averaged.module.load_state_dict(self.state.averaged)
        self.averaged.n_averaged.fill_(self.state.step)
        if self.state.optimizer:
            self.optimizer.load_state_dict(self.state.optimizer)

    def _started_from(self) -> MarkingNet:
        """The network that this run started from: heads that learn alone keep to its classes."""
        start = MarkingNet(self.config.net, len(self.state.catalogue.names)).to(self.device)
        with torch.random.fork_rng():
            torch.manual_seed(self.config.seed)  # channels that are added are drawn at random
            start.load_state_dict(fresh_checkpoint(self.config).averaged)
        return start.eval()

    def _rows_that_stay(self) -> Tensor | None:
        """Which classes' channels (K,) stay while the heads learn alone; None where none has to.

        Raises:
            ConfigError: The network has no such class.
        """
        only = self.config.only_classes
        if only is None:
            return None
        names = self.state.catalogue.names
        for name in only:
            if name not in names:
                raise ConfigError(f"only_classes: no class {shown(name)}; choose from: {', '.join(names)}")
        return torch.tensor([name not in only for name in names], device=self.device)

    @torch.no_grad()
    def _put_back(self, before: MarkingNet, stays: Tensor) -> None:
        """Undo what an update did to the channels of classes that stay, and to those that they read."""
        earlier = dict(before.named_parameters())
        for name, parameter in self.net.named_parameters():
            if name in CLASS_CHANNELS:
                parameter[stays] = earlier[name][stays]
            elif name.startswith(HIDDEN_CLASS_LAYER) and parameter.requires_grad:
                is_read = read_by(earlier, stays)
                # The first half of a separable layer has no channels of its own: it stays.
                stay = is_read if len(parameter) == len(is_read) else slice(None)
                parameter[stay] = earlier[name][stay]

    def _share(self) -> float:
        """How much of the run has passed, 0 to 1."""
        config = self.config
        by_time = self.state.elapsed_s / (60 * config.minutes) if config.minutes else 0.0
        by_step = self.state.step / config.steps if config.steps else 0.0
        return max(by_time, by_step)

    def _learning_rate(self) -> float:
        share = min(self._share(), 1.0)
        if self._heads_alone():
            return _HEADS_FASTER * self.config.learning_rate * 0.5 * (1 + math.cos(math.pi * share))
        warmup = self.config.warmup
        if share < warmup:
            return self.config.learning_rate * (0.05 + 0.95 * share / warmup)
        return self.config.learning_rate * 0.5 * (1 + math.cos(math.pi * (share - warmup) / (1 - warmup)))

    def _heads_alone(self) -> bool:
        """Whether only the heads of classes learn."""
        return self.state.step < self.config.head_updates

    def _set_what_learns(self) -> None:
        """Let the heads of classes learn alone, or everything."""
        alone = self._heads_alone()
        self.net.train(not alone)
        for name, parameter in self.net.named_parameters():
            of_heads = name.startswith(CLASS_HEADS)
            if self._stays is not None:
                hidden = self.config.net.added_kinds > 0 and name.startswith(HIDDEN_CLASS_LAYER)
                of_heads = name in CLASS_CHANNELS or hidden
            parameter.requires_grad_(not alone or of_heads)

    def _average(self, averaged: Any, current: Any, count: Any) -> None:
        """Move averaged weights towards the current ones, the farther the fewer updates there were.

        Otherwise the first weights, which are random, would outlast a run of a few ``ema_updates``.
        """
        decay = min(1 - 1 / self.config.ema_updates, (1 + self.state.step) / (10 + self.state.step))
        get_ema_multi_avg_fn(decay)(averaged, current, count)  # type: ignore[no-untyped-call]

    def _update(self, batch: Pair) -> float:
        """One step of the optimiser."""
        image, targets = self._to_device(batch)
        for group in self.optimizer.param_groups:
            group["lr"] = self._learning_rate()
        self._set_what_learns()
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self._halves):
            prediction = self.net(image)
        prediction = Prediction(*(output.float() for output in prediction))
        loss = total_loss(prediction, targets, self.config.loss)
        if self._before is not None and self._heads_alone():
            with torch.inference_mode():
                before = self._before(image).kinds
            loss_of_kept = kept_loss(prediction.kinds, before, prediction.paint, targets)
            loss = loss + self.config.loss.kept * loss_of_kept
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        # Statistics of the normalisations are averaged, too: each member has seen its own images only.
        gradients = [p.grad for p in self.net.parameters() if p.grad is not None]
        statistics = [buffer for buffer in self.net.buffers() if buffer.is_floating_point()]
        loss = loss.detach()
        self._team.average([*gradients, *statistics, loss])
        nn.utils.clip_grad_norm_(self.net.parameters(), 5.0)
        self.optimizer.step()
        if self._before is not None and self._stays is not None and self._heads_alone():
            self._put_back(self._before, self._stays)
        self.averaged.update_parameters(self.net)
        self.state.step += 1
        step, renders = self._resumed_at
        views = (self.state.step - step) * self.config.batch * self._team.size
        self.state.renders = renders - (-views // self.config.data.views_per_render)
        return float(loss)

    def _to_device(self, batch: Pair) -> Pair:
        image, targets = batch
        move = (target.to(self.device, non_blocking=True) for target in targets)
        return image.to(self.device, non_blocking=True), Targets(*move)

    def _validate(self, sets: Mapping[str, list[Pair]], board: SummaryWriter | None) -> None:
        """Score the averaged weights on each set, and keep them if they are the best yet on all together."""
        if not any(sets.values()) or board is None:
            return
        self.averaged.eval()
        classes = self.state.catalogue.names
        scores = {name: score_of(self.averaged, pairs, classes, self.device) for name, pairs in sets.items()}
        self.state.metrics = metrics_of_sets(scores)
        for name, score in scores.items():
            _LOG.info("step %d, %.1f min, %s: %s", self.state.step, self.state.elapsed_s / 60, name, score)
        for name, value in self.state.metrics.items():
            board.add_scalar(f"validation/{name}", value, self.state.step)
        mean_iou = sum(score.mean_iou for score in scores.values()) / len(scores)
        if mean_iou >= self.state.best_iou:
            self.state.best_iou = mean_iou
            self._save("best.pt")

    def _report(self, loss: float, board: SummaryWriter | None) -> None:
        if board is None:
            return
        board.add_scalar("train/loss", loss, self.state.step)
        board.add_scalar("train/learning_rate", self._learning_rate(), self.state.step)
        rate = self.state.step * self.config.batch / max(self.state.elapsed_s, 1e-9)
        figures = (
            f"step {self.state.step}, {rate:.1f} images/s, loss {loss:.3f}, IoU {self.state.best_iou:.3f}"
        )
        self.progress(min(self._share(), 1.0), figures)

    def _save(self, name: str) -> None:
        if not self._team.leads:
            return
        self.state.model = _on_cpu(self.net.state_dict())
        self.state.averaged = _on_cpu(self.averaged.module.state_dict())
        self.state.optimizer = self.optimizer.state_dict()
        save_checkpoint(self.state, self.output / name)


def _on_cpu(state: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.detach().cpu().clone() for name, value in state.items()}

"""Training images without end, rendered by worker processes while the network learns, and users' own."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import fields

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from train.augment import random_crop, random_photometry
from train.config import DataConfig
from train.labels import LabelledImages
from train.scenes.hardships import Hardships
from train.scenes.scenes import TrainingSample, training_sample
from train.targets import Targets, targets
from v2hdm.executor.processes import undisturbed_starts

_VALIDATION_SEED_OFFSET = 1_000_003  # distance of the validation's seeds from the training's

Pair = tuple[Tensor, Targets]
"""Images (H, W, 3) uint8 and the answers for them."""


def hardships_of(config: DataConfig) -> Hardships:
    """The hardships that renders are drawn with."""
    return Hardships(**{setting.name: getattr(config, setting.name) for setting in fields(Hardships)})


class RenderStream(IterableDataset[Pair]):
    """Pairs of image and answers, the same for the same seed, workers and part.

    Args:
        config: Sizes and how often a render is shown.
        seed: Names the sequence.
        first_render: Where in it to begin, so that a resumed run sees other renders.
        part: Which of how many trainings in step this stream feeds: no two see the same render.
        labels: Labelled images to mix in, ``config.labelled_share`` of all.
    """

    def __init__(
        self,
        config: DataConfig,
        seed: int,
        first_render: int = 0,
        part: tuple[int, int] = (0, 1),
        labels: LabelledImages | None = None,
    ) -> None:
        self.config = config
        self.hardships = hardships_of(config)
        self.seed = seed
        self.first_render = first_render
        self.part = part
        self.labels = labels

    def __iter__(self) -> Iterator[Pair]:
        worker = get_worker_info()
        number, workers = (worker.id, worker.num_workers) if worker else (0, 1)
        rank, size = self.part
        number = rank * workers + number
        workers = size * workers
        rng = np.random.default_rng([self.seed, self.first_render, number, 9])
        for pair in self._renders(rng, number, workers):
            while self.labels is not None and rng.random() < self.config.labelled_share:
                yield self.labels.view(rng)
            yield pair

    def _renders(self, rng: np.random.Generator, number: int, workers: int) -> Iterator[Pair]:
        """Views of the renders ``number``, ``number + workers``, ..."""
        recent: list[TrainingSample] = []
        appeal: list[float] = []
        index = self.first_render + number
        while True:
            sample = self._render(index)
            recent.append(sample)
            appeal.append(_appeal(sample))
            index += workers
            yield self._view(rng, sample)
            for _ in range(self.config.views_per_render - 1):
                again = rng.choice(len(recent), p=np.array(appeal) / sum(appeal))
                yield self._view(rng, recent[int(again)])
            if len(recent) >= self.config.reservoir:
                dropped = int(rng.integers(len(recent)))
                del recent[dropped], appeal[dropped]

    def _render(self, index: int) -> TrainingSample:
        config = self.config
        difficulty = min(1.0, index / max(config.easy_samples, 1))
        return training_sample(
            self.seed, index, config.render_width, config.render_height, difficulty, self.hardships
        )

    def _view(self, rng: np.random.Generator, sample: TrainingSample) -> Pair:
        crop = random_crop(rng, sample, self.config.width, self.config.height)
        return torch.from_numpy(random_photometry(rng, crop.image)), targets(crop)


def training_batches(
    config: DataConfig,
    seed: int,
    batch: int,
    first_render: int,
    part: tuple[int, int] = (0, 1),
    labels: LabelledImages | None = None,
) -> Iterator[Pair]:
    """Batches without end, from worker processes (or this one if ``workers`` is 0), ``labels`` among them."""
    stream = RenderStream(config, seed, first_render, part, labels)
    workers = config.workers
    if workers is None:
        workers = max(1, ((os.cpu_count() or 2) - 1) // part[1])
    loader = DataLoader(
        stream,
        batch_size=batch,
        num_workers=workers,
        prefetch_factor=6 if workers else None,
        worker_init_fn=_single_thread if workers else None,
        multiprocessing_context="spawn" if workers else None,
    )
    with undisturbed_starts():
        return iter(loader)


def validation_pairs(config: DataConfig, seed: int, images: int) -> Iterator[Pair]:
    """A fixed set of renders of full difficulty that no training seed of the same run shows."""
    for index in range(images):
        sample = training_sample(seed + _VALIDATION_SEED_OFFSET, index, config.width, config.height)
        yield torch.from_numpy(sample.image), targets(sample)


def _appeal(sample: TrainingSample) -> float:
    """How often to show a render again, relatively: up to eleven times oftener for paint in it."""
    return 0.1 + min(float((sample.labels > 0).mean()) / 0.015, 1.0)


def _single_thread(_worker: int) -> None:
    cv2.setNumThreads(1)
    torch.set_num_threads(1)

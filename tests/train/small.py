"""A training small enough for a test, and labels for it."""

import json
from pathlib import Path

import cv2
import numpy as np

from models import NetConfig
from train.checkpoint import Checkpoint
from train.config import DataConfig, TrainConfig, ValidationConfig
from train.loop import Trainer

WIDTH, HEIGHT = 96, 64


def coco(folder: Path, **changes: object) -> Path:
    """A file of two images, a bright rectangle (columns 30 to 49, rows 20 to 39) an arrow."""
    for name, grey in (("a.png", 60), ("b.png", 90)):
        image = np.full((HEIGHT, WIDTH, 3), grey, dtype=np.uint8)
        if name == "a.png":
            image[20:40, 30:50] = 220
        cv2.imwrite(str(folder / name), image)
    size = {"width": WIDTH, "height": HEIGHT}
    content = {
        "images": [{"id": 7, "file_name": "a.png", **size}, {"id": 9, "file_name": "b.png", **size}],
        "categories": [{"id": 1, "name": "Arrow"}, {"id": 2, "name": "zebra"}],
        "annotations": [
            {"id": 1, "image_id": 7, "category_id": 1, "segmentation": [[30, 20, 50, 20, 50, 40, 30, 40]]}
        ],
    } | changes
    (folder / "coco.json").write_text(json.dumps(content))
    return folder / "coco.json"


def tiny(output: Path, steps: int = 3) -> TrainConfig:
    net = NetConfig(widths=[16, 16, 16, 16], dilations=[1], separable=True, wide_kinds=False)
    sizes = {"width": 64, "height": 32, "render_width": 80, "render_height": 48}
    data = DataConfig(**sizes, views_per_render=2, reservoir=4, workers=0)
    validation = ValidationConfig(images=2)
    return TrainConfig(output=str(output), steps=steps, batch=2, net=net, data=data, validation=validation)


def train(config: TrainConfig) -> Checkpoint:
    return Trainer(config, lambda share, line: None).run()

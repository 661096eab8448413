"""The settings of a training; `conf/train.yaml` holds the values that are used."""

from __future__ import annotations

from dataclasses import dataclass, field

from models import NetConfig
from models.marking_net import MULTIPLE
from v2hdm.errors import ConfigError, V2hdmError
from v2hdm.settings import COUNT, MOST_PROCESSES, NOT_NEGATIVE, POSITIVE, SEED, SHARE, Within, check_settings


class LabelError(V2hdmError):
    """Labels to train the detector from are missing, damaged or of a class that is not known."""


@dataclass(kw_only=True)
class DataConfig:
    """The stream of renders.

    A render of ``render_width`` x ``render_height`` px is shown ``views_per_render`` times on average, the
    oftener the more paint it shows, each time another crop of ``width`` x ``height`` px in other light. Past
    renders to show again are kept in a ``reservoir``. ``easy_samples`` renders pass until scenes are as hard
    as they get. ``shadows_on_paint`` and those that follow it up to ``aside``
    are the :class:`~train.scenes.hardships.Hardships` of the renders. ``workers`` processes render; None is
    one for each core but the trainer's, shared among its processes.

    ``coco`` and ``tusimple`` are files of users' own labels: polygons of markings in COCO's format, lanes in
    TuSimple's. The images' names in them start from ``coco_images`` and ``tusimple_images``, or else from the
    folder of the file. ``coco_classes`` says what categories mean that are not called like a class: a class,
    several with "|" between them of which each piece is one, "none" for what is no marking, a class "|none"
    for outlines within which some is paint of that class, "unknown" for ground of which nothing is known.
    ``labelled_share`` of all views are then of these images.

    ``coco_size`` (width, height) is what images of that file are stretched to, labels too, where they were
    squeezed. ``coco_edge_px``: nobody knows what is nearer to a labelled outline than this. ``coco_complete``
    are the classes of which all within reach is labelled; paint of others that the shipped network sees
    outside of the labels is unknown, not bare; None means all classes. ``coco_camera`` are its camera's
    height (m), pitch (deg, down) and horizontal field of view (deg), about: by them sizes on the ground tell
    classes apart. One in ten blocks of neighbouring images is kept for validation where ``coco_held_out``,
    two in ten are shown by nobody.
    """

    width: int = 448
    height: int = 256
    render_width: int = 512
    render_height: int = 288
    views_per_render: int = 8
    reservoir: int = 512
    easy_samples: int = 1000
    shadows_on_paint: float = 3.0
    things_beside: float = 0.8
    faint: float = 0.25
    seams: float = 0.25
    side_seams: float = 1.5
    pavements: float = 0.3
    bleached: float = 0.08
    overexposed: float = 0.15
    blue_shade: float = 0.3
    tight_bends: float = 0.15
    kerbs: float = 0.2
    junctions: float = 0.12
    mountings: float = 0.15
    facing: float = 0.5
    stout: float = 0.4
    hollow: float = 0.25
    crossings: float = 0.12
    words: float = 0.1
    erased: float = 0.7
    litter: float = 1.2
    traffic: float = 0.5
    own_vehicle: float = 0.2
    rain: float = 0.08
    low_sun: float = 0.1
    dusk: float = 0.06
    sun_flecks: float = 0.08
    grounds: float = 0.4
    aside: float = 0.08
    workers: int | None = 1
    coco: str | None = None
    coco_images: str | None = None
    coco_classes: dict[str, str] = field(default_factory=dict)
    coco_size: list[int] | None = None
    coco_edge_px: float = 0.0
    coco_complete: list[str] | None = None
    coco_camera: list[float] | None = None
    coco_held_out: bool = False
    tusimple: str | None = None
    tusimple_images: str | None = None
    labelled_share: float = 0.3


@dataclass(kw_only=True)
class LossConfig:
    """Weights of the terms: Dice of the paint, its class, and the lanes, beside the paint's cross entropy.

    ``paint_weight`` and ``lane_weight`` are what a cell of paint or a crossing weighs against one of nothing.

    Attributes:
        dice: weight of the Dice loss of the paint.
        kinds: weight of the class of paint.
        lanes: weight of the lanes.
    """

    paint_weight: float = 2.0
    dice: float = 0.5
    kinds: float = 1.0
    lanes: float = 1.0
    lane_weight: float = 3.0


@dataclass(kw_only=True)
class ValidationConfig:
    """A fixed set of renders of full difficulty, scored every so many minutes.

    Attributes:
        images: number of renders; 0 validates nothing.
        every_minutes: time between two validations.
    """

    images: int = 64
    every_minutes: float = 8.0


@dataclass(kw_only=True)
class TrainConfig:
    """One training run. It ends after ``minutes`` of training or ``steps`` updates, whichever comes first.

    The learning rate rises to ``learning_rate`` over the first ``warmup`` of the run, then falls to
    nothing as a half cosine, by the share of the run that has passed. The weights that are validated, kept
    and exported are averages over about the last ``ema_updates`` updates, over fewer near the start.
    ``bfloat16`` has convolutions computed in that where the device is faster so. ``resume`` goes on with
    what ``output`` holds. ``start`` is a checkpoint of another run, or an exported file, whose averaged
    weights and place in the sequence of renders this one starts from: to learn on, or to learn users' own
    labels. ``catalogue`` is a YAML file of users' own classes, see `docs/labels.md`; None takes those that
    ``start`` knows.

    Attributes:
        seed: of the network's first weights and of the renders.
        device: auto, cpu or cuda.
        batch: images per update, on each process.
        weight_decay: of AdamW.
        threads: of torch, for each process.
        checkpoint_minutes: time between two checkpoints.
    """

    output: str = "runs/train"
    start: str | None = None
    catalogue: str | None = None
    seed: int = 1
    device: str = "auto"
    minutes: float | None = None
    steps: int | None = None
    batch: int = 8
    learning_rate: float = 2e-3
    weight_decay: float = 0.01
    warmup: float = 0.03
    ema_updates: int = 1000
    threads: int = 1
    bfloat16: bool = True
    checkpoint_minutes: float = 2.0
    resume: bool = True
    net: NetConfig = field(default_factory=NetConfig)
    data: DataConfig = field(default_factory=DataConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    validation: ValidationConfig = field(default_factory=ValidationConfig)


_SIDE = Within(MULTIPLE, 2**13, step=MULTIPLE)
_RENDER_SIDE = Within(MULTIPLE, 2**14)
_LEVELS = 4
"""The network has this many widths."""

_RANGES = {
    "seed": SEED,
    "minutes": Within(0, 1e7, open=True),
    "steps": COUNT,
    "batch": Within(1, 2**16),
    "learning_rate": Within(0, 10, open=True),
    "weight_decay": Within(0, 10),
    "warmup": Within(0, 0.9),
    "ema_updates": COUNT,
    "threads": Within(1, MOST_PROCESSES),
    "checkpoint_minutes": POSITIVE,
    "net.widths": Within(8, 2**12, step=8),
    "net.dilations": Within(1, 256),
    "net.head_width": Within(1, 2**10),
    "data.width": _SIDE,
    "data.height": _SIDE,
    "data.render_width": _RENDER_SIDE,
    "data.render_height": _RENDER_SIDE,
    "data.views_per_render": COUNT,
    "data.reservoir": COUNT,
    "data.easy_samples": NOT_NEGATIVE,
    "data.workers": Within(0, MOST_PROCESSES),
    "data.labelled_share": SHARE,
    "data.coco_size": Within(1, 2**15),
    "data.coco_edge_px": Within(0, 100),
    "data.coco_camera": Within(-90, 180),
    **{
        f"data.{name}": Within(0, 100)
        for name in (
            "shadows_on_paint", "things_beside", "faint", "seams", "side_seams", "pavements", "bleached",
            "overexposed", "blue_shade", "tight_bends", "kerbs", "junctions", "mountings", "aside",
            "facing", "stout", "hollow", "crossings", "words", "erased", "litter", "traffic",
            "own_vehicle", "rain", "low_sun", "dusk", "sun_flecks", "grounds",
        )
    },
    **{f"loss.{name}": NOT_NEGATIVE for name in ("paint_weight", "dice", "kinds", "lanes", "lane_weight")},
    "validation.images": Within(0, 2**20),
    "validation.every_minutes": POSITIVE,
}  # fmt: skip


def check_training(config: TrainConfig) -> None:
    """Refuse settings that no training can work with, or that would never end.

    Raises:
        ConfigError: a value is out of range; the message names the key.
    """
    check_settings(config, _RANGES)
    if config.minutes is None and config.steps is None:
        raise ConfigError("the training has no end: set minutes= or steps=")
    if len(config.net.widths) != _LEVELS or not config.net.dilations:
        raise ConfigError(
            f"net.widths has {len(config.net.widths)} entries: give {_LEVELS}, and some dilations"
        )
    data = config.data
    for name, length in (("coco_size", 2), ("coco_camera", 3)):
        value = getattr(data, name)
        if value is not None and len(value) != length:
            raise ConfigError(f"data.{name} has {len(value)} entries: give {length}")
    if data.width > data.render_width or data.height > data.render_height:
        raise ConfigError(
            f"data.width x data.height is {data.width} x {data.height}, and a render has "
            f"{data.render_width} x {data.render_height}: set it no larger"
        )

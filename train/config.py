"""What can be set about a training; `conf/train.yaml` holds the values that are used."""

from __future__ import annotations

from dataclasses import dataclass, field

from models import NetConfig


@dataclass(kw_only=True)
class DataConfig:
    """The stream of renders.

    A render of ``render_width`` x ``render_height`` px is shown ``views_per_render`` times on average, the
    oftener the more paint it shows, each time another crop of ``width`` x ``height`` px in other light. Past
    renders to show again are kept in a ``reservoir``. ``easy_samples`` renders pass until scenes are as hard
    as they get. ``shadows_on_paint`` and those that follow it up to ``aside``
    are the :class:`~train.scenes.hardships.Hardships` of the renders. ``workers`` processes render; None is
    one for each core but the trainer's, shared among the processes of a team.

    ``coco`` and ``tusimple`` are files of users' own labels: polygons of markings in COCO's format, lanes in
    TuSimple's. The images' names in them start from ``coco_images`` and ``tusimple_images``, or else from the
    folder of the file. ``coco_classes`` says what categories mean that are not called like a class: a class,
    or "none" for what is no marking. ``labelled_share`` of all views are then of these images.
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
    aside: float = 0.08
    workers: int | None = 1
    coco: str | None = None
    coco_images: str | None = None
    coco_classes: dict[str, str] = field(default_factory=dict)
    tusimple: str | None = None
    tusimple_images: str | None = None
    labelled_share: float = 0.3


@dataclass(kw_only=True)
class LossConfig:
    """Weights of the terms: Dice of the paint, its class, and the lanes, beside the paint's cross entropy.

    ``paint_weight`` and ``lane_weight`` are what a cell of paint or a crossing weighs against one of nothing.
    """

    paint_weight: float = 2.0
    dice: float = 0.5
    kinds: float = 1.0
    lanes: float = 1.0
    lane_weight: float = 3.0


@dataclass(kw_only=True)
class ValidationConfig:
    """A fixed set of renders of full difficulty, scored every so many minutes."""

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
    labels. ``catalogue`` is a YAML file of users' own classes, see `docs/own-class.md`; None takes those that
    ``start`` knows.
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

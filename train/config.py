"""The settings of a training; `conf/train.yaml` holds the values that are used."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from models import NetConfig
from models.marking_net import MULTIPLE
from v2hdm.errors import ConfigError, V2hdmError
from v2hdm.settings import COUNT, MOST_PROCESSES, NOT_NEGATIVE, POSITIVE, SEED, SHARE, Within, check_settings


class LabelError(V2hdmError):
    """Labels to train the detector from are missing, damaged or of a class that is not known."""


_COCO_AND_TUSIMPLE = (
    "coco and tusimple are files of users' own labels: polygons of markings in COCO's format, lanes in "
    "TuSimple's."
)


_SIDE = Within(MULTIPLE, 2**13, step=MULTIPLE)  # of an image that the network sees, px
_RENDER_SIDE = Within(MULTIPLE, 2**14)  # of an image that views are cut out of, px
_Amount = Annotated[float, Within(0, 100)]  # a share or mean number per scene; chosen: above any need

_COCO_IMAGES_AND_TUSIMPLE_IMAGES = (
    "The images' names in them start from coco_images and tusimple_images, or else from the folder of "
    "the file."
)


_SHADOWS_ON_PAINT_AND_ASIDE = (
    "shadows_on_paint and those that follow it up to aside are the Hardships of the renders."
)


_WIDTH_AND_HEIGHT = (
    "A render of render_width x render_height px is shown views_per_render times on average, the "
    "oftener the more paint it shows, each time another crop of width x height px in other light."
)


@dataclass(kw_only=True)
class DataConfig:
    """The stream of renders, and of users' own labelled images beside them."""

    width: Annotated[int, _SIDE, _WIDTH_AND_HEIGHT] = 448
    height: Annotated[int, _SIDE, _WIDTH_AND_HEIGHT] = 256
    render_width: Annotated[int, _RENDER_SIDE, _WIDTH_AND_HEIGHT] = 512
    render_height: Annotated[int, _RENDER_SIDE, _WIDTH_AND_HEIGHT] = 288
    views_per_render: Annotated[int, COUNT, _WIDTH_AND_HEIGHT] = 8
    reservoir: Annotated[int, COUNT, "Past renders to show again are kept in a reservoir."] = 512
    easy_samples: Annotated[
        int, NOT_NEGATIVE, "easy_samples renders pass until scenes are as hard as they get."
    ] = 1000
    shadows_on_paint: Annotated[_Amount, _SHADOWS_ON_PAINT_AND_ASIDE] = 3.0
    things_beside: Annotated[
        _Amount,
        "mean number of containers, barriers, cabinets and vehicles that stand right beside a marking: what "
        "is bright, has corners and touches such a thing is a part of it in most scenes.",
    ] = 0.8
    faint: Annotated[
        _Amount, "share of scenes half of whose markings are so dirty that the ground is nearly as bright."
    ] = 0.25
    seams: Annotated[
        _Amount,
        "share of lane lines that have a seam of the surface beside them, as paving leaves it there: dark "
        "or bright, and going on where a dash ends.",
    ] = 0.25
    side_seams: Annotated[
        _Amount, "mean number of markings with a crack or a tar seam along one of their sides and beyond it."
    ] = 1.5
    pavements: Annotated[
        _Amount, "share of scenes in which the surface changes its tone along a line, beside its paint."
    ] = 0.3
    bleached: Annotated[
        _Amount,
        "share of scenes whose ground is nearly as light as its paint. Half of them are overexposed, so "
        "that ground and paint are clipped together.",
    ] = 0.14
    overexposed: Annotated[
        _Amount,
        "share of images that are exposed several times too long, as the sunlit half of a scene is by a "
        "camera set for its shade.",
    ] = 0.15
    blue_shade: Annotated[_Amount, "share of scenes whose shade is lit by a deep blue sky."] = 0.3
    tight_bends: Annotated[
        _Amount,
        "share of scenes whose way, and all paint with it, turns as sharply as in yards and roundabouts; "
        "what would stand on the paint is left out.",
    ] = 0.15
    kerbs: Annotated[
        _Amount,
        "share of scenes with a bright kerb along a line of a lane, no wider than paint, that lies open in "
        "stretches as long as dashes.",
    ] = 0.2
    gutters: Annotated[
        _Amount, "share of scenes with a strip of stones or concrete along the way, level with the ground."
    ] = 0.06
    joints: Annotated[_Amount, "mean number of long seams along the way, apart from all lines of lanes."] = (
        0.5
    )
    junctions: Annotated[
        _Amount, "share of scenes with the whole approach to a junction: arrows, stop line, crosswalk."
    ] = 0.12
    mountings: Annotated[
        _Amount,
        "share of cameras that sit lower than in cars (0.5 to 1.1 m) or higher than on most trucks (3.6 to "
        "5 m).",
    ] = 0.15
    facing: Annotated[_Amount, "share of the lanes whose arrows and writing face the camera."] = 0.5
    stout: Annotated[
        _Amount, "share of the lanes with arrows whose shafts are thick and tapered, their heads short."
    ] = 0.4
    hollow: Annotated[
        _Amount,
        "share of ports whose diamonds are outlines, labelled as filled ones as photographs are; and of "
        "streets with such diamonds in a lane.",
    ] = 0.25
    crossings: Annotated[
        _Amount, "share of scenes with a stop line that meets or crosses lines of lanes."
    ] = 0.12
    words: Annotated[_Amount, "share of scenes with words or a number in lanes."] = 0.15
    bays: Annotated[_Amount, "share of scenes with a row of numbers of bays or slots along the way."] = 0.12
    boxes: Annotated[
        _Amount,
        "share of scenes with an area to be kept clear: yellow boxes, hatched aisles, crossed rectangles.",
    ] = 0.15
    users: Annotated[_Amount, "share of scenes with bicycles, people or wheelchairs painted in lanes."] = 0.1
    others: Annotated[
        _Amount,
        "share of scenes with paint that has no class of its own: rings, crosses, zigzags, corners of bays.",
    ] = 0.06
    give_way: Annotated[
        _Amount, "share of scenes with a give-way line of short dashes or teeth, labelled as a stop line."
    ] = 0.1
    far_stops: Annotated[_Amount, "share of scenes with a stop line 12 to 40 m ahead."] = 0.25
    crosswalks: Annotated[
        _Amount,
        "share of scenes with a whole crosswalk: bars, bars between two lines, or the two lines alone.",
    ] = 0.15
    doubles: Annotated[_Amount, "share of scenes with a double line, half of them yellow ones."] = 0.15
    erased: Annotated[
        _Amount, "mean number of markings that were ground off, burnt off or painted over: no paint."
    ] = 0.7
    litter: Annotated[_Amount, "mean number of sheets, boxes, bags and cans on the ground."] = 1.2
    traffic: Annotated[
        _Amount,
        "mean number of vehicles, boards and kerbs with stripes, windows, wheels, plates and writing.",
    ] = 0.5
    own_vehicle: Annotated[
        _Amount,
        "share of images with the own bonnet or dashboard, wipers, or drops and reflections on the "
        "windscreen.",
    ] = 0.2
    rain: Annotated[_Amount, "share of scenes whose ground is wet all over and mirrors a bright sky."] = 0.08
    low_sun: Annotated[_Amount, "share of scenes with a sun at 3 to 11 degrees, half of them against it."] = (
        0.1
    )
    dusk: Annotated[_Amount, "share of scenes after sunset, mostly in the light of the own headlights."] = (
        0.06
    )
    sun_flecks: Annotated[_Amount, "share of scenes in deep shade with few spots of sun."] = 0.08
    grounds: Annotated[_Amount, "share of grounds of asphalt or concrete that are photographed ones."] = 0.4
    aside: Annotated[_Amount, _SHADOWS_ON_PAINT_AND_ASIDE] = 0.08
    workers: Annotated[int | None, Within(0, MOST_PROCESSES), "workers processes render;"] = 1
    coco: Annotated[str | None, _COCO_AND_TUSIMPLE] = None
    coco_images: Annotated[str | None, _COCO_IMAGES_AND_TUSIMPLE_IMAGES] = None
    coco_classes: Annotated[
        dict[str, str],
        'coco_classes says what categories mean that are not called like a class: a class, several with "|" '
        'between them of which each piece is one, "none" for what is no marking, a class "|none" for '
        'outlines within which some is paint of that class, "unknown" for ground of which nothing is known.',
    ] = field(default_factory=dict)
    coco_size: Annotated[
        list[int] | None,
        Within(1, 2**15),
        "coco_size (width, height) is what images of that file are stretched to, labels too, where they "
        "were squeezed.",
    ] = None
    coco_edge_px: Annotated[
        float, Within(0, 100), "coco_edge_px: nobody knows what is nearer to a labelled outline than this."
    ] = 0.0
    coco_complete: Annotated[
        list[str] | None,
        "the classes of which all within reach is labelled; paint of others that the shipped network sees "
        "outside of the labels is unknown, not bare;",
    ] = None
    coco_relabel: Annotated[
        dict[str, str],
        "by the name of a category: a JSON file that lists, under annotations or alone, the ids of those "
        "annotations that are of that category whatever they are called.",
    ] = field(default_factory=dict)
    coco_tone: Annotated[
        bool,
        "coco_tone takes of outlines of many pieces, stripes and lines only what is brighter than the ground "
        "beside it for paint, and what is as dark for ground.",
    ] = False
    coco_balance: Annotated[
        float,
        SHARE,
        "how much oftener than others images with a rare class are shown: 0 not at all, 1 so often that "
        "each class is shown alike, but at most eight times.",
    ] = 0.0
    coco_camera: Annotated[
        list[float] | None,
        Within(-90, 180),
        "its camera's height (m), pitch (deg, down) and horizontal field of view (deg), about: by them "
        "sizes on the ground tell classes apart.",
    ] = None
    coco_held_out: Annotated[
        bool,
        "One in ten blocks of neighbouring images is kept for validation where coco_held_out, two in ten "
        "are shown by nobody.",
    ] = False
    tusimple: Annotated[str | None, _COCO_AND_TUSIMPLE] = None
    tusimple_images: Annotated[str | None, _COCO_IMAGES_AND_TUSIMPLE_IMAGES] = None
    labelled_share: Annotated[float, SHARE, "labelled_share of all views are then of these images."] = 0.3


_PAINT_WEIGHT_AND_LANE_WEIGHT = (
    "paint_weight and lane_weight are what a cell of paint or a crossing weighs against one of nothing."
)


@dataclass(kw_only=True)
class LossConfig:
    """Weights of the terms: Dice of the paint, its class, and the lanes, beside the paint's cross entropy."""

    paint_weight: Annotated[float, NOT_NEGATIVE, _PAINT_WEIGHT_AND_LANE_WEIGHT] = 2.0
    dice: Annotated[float, NOT_NEGATIVE, "weight of the Dice loss of the paint."] = 0.5
    kinds: Annotated[float, NOT_NEGATIVE, "weight of the class of paint."] = 1.0
    lanes: Annotated[float, NOT_NEGATIVE, "weight of the lanes."] = 1.0
    kept: Annotated[
        float,
        NOT_NEGATIVE,
        "weight of what start says of classes, while only the heads that name them learn, where no label "
        "says otherwise.",
    ] = 2.0
    lane_weight: Annotated[float, NOT_NEGATIVE, _PAINT_WEIGHT_AND_LANE_WEIGHT] = 3.0


@dataclass(kw_only=True)
class ValidationConfig:
    """A fixed set of renders of full difficulty, scored every so many minutes."""

    images: Annotated[int, Within(0, 2**20), "number of renders; 0 validates nothing."] = 64
    every_minutes: Annotated[float, POSITIVE, "time between two validations."] = 8.0


_LEARNING_RATE_AND_WARMUP = (
    "The learning rate rises to learning_rate over the first warmup of the run, then falls to nothing "
    "as a half cosine, by the share of the run that has passed."
)


_MINUTES_AND_STEPS = "It ends after minutes of training or steps updates, whichever comes first."


_OUTPUT_AND_RESUME = "resume goes on with what output holds."


@dataclass(kw_only=True)
class TrainConfig:
    """One training run."""

    output: Annotated[str, _OUTPUT_AND_RESUME] = "runs/train"
    start: Annotated[
        str | None,
        "a checkpoint of another run, or an exported file, whose averaged weights and place in the sequence "
        "of renders this one starts from: to learn on, or to learn users' own labels. null takes those that "
        "start knows.",
    ] = None
    catalogue: Annotated[str | None, "a YAML file of users' own classes, see docs/labels.md;"] = None
    seed: Annotated[int, SEED, "of the network's first weights and of the renders."] = 1
    device: Annotated[str, "auto, cpu or cuda."] = "auto"
    minutes: Annotated[float | None, Within(0, 1e7, open=True), _MINUTES_AND_STEPS] = None
    steps: Annotated[int | None, COUNT, _MINUTES_AND_STEPS] = None
    batch: Annotated[int, Within(1, 2**16), "images per update, on each process."] = 8
    learning_rate: Annotated[float, Within(0, 10, open=True), _LEARNING_RATE_AND_WARMUP] = 2e-3
    weight_decay: Annotated[float, Within(0, 10), "of AdamW."] = 0.01
    warmup: Annotated[float, Within(0, 0.9), _LEARNING_RATE_AND_WARMUP] = 0.03
    head_updates: Annotated[
        int,
        NOT_NEGATIVE,
        "In the first head_updates only the heads that name classes learn, ten times as fast: those of new "
        "classes catch up before what they read is changed.",
    ] = 0
    only_classes: Annotated[
        list[str] | None,
        "In the first head_updates only the channels of these classes learn, if any are named: other "
        "classes, paint and lanes stay what start says.",
    ] = None
    ema_updates: Annotated[
        int,
        COUNT,
        "The weights that are validated, kept and exported are averages over about the last ema_updates "
        "updates, over fewer near the start.",
    ] = 1000
    threads: Annotated[int, Within(1, MOST_PROCESSES), "of torch, for each process."] = 1
    bfloat16: Annotated[bool, "bfloat16 has convolutions computed in that where the device is faster so."] = (
        True
    )
    checkpoint_minutes: Annotated[float, POSITIVE, "time between two checkpoints."] = 2.0
    resume: Annotated[bool, _OUTPUT_AND_RESUME] = True
    net: NetConfig = field(default_factory=NetConfig)
    data: DataConfig = field(default_factory=DataConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    validation: ValidationConfig = field(default_factory=ValidationConfig)


_LEVELS = 4
"""The network has this many widths."""


def check_training(config: TrainConfig) -> None:
    """Refuse settings that no training can work with, or that would never end.

    Raises:
        ConfigError: a value is out of range; the message names the key.
    """
    check_settings(config)
    if config.minutes is None and config.steps is None:
        raise ConfigError("the training has no end: set minutes= or steps=")
    if config.only_classes is not None and not (config.start and config.head_updates):
        raise ConfigError(
            "only_classes names classes that heads learn alone: set start= and head_updates=, too, or leave "
            "it out"
        )
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

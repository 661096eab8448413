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


_SIDE = Within(MULTIPLE, 2**13, step=MULTIPLE)  # of an image that the network sees, px
_RENDER_SIDE = Within(MULTIPLE, 2**14)  # of an image that views are cut out of, px
_Amount = Annotated[float, Within(0, 100)]  # a share or mean number per scene; chosen: above any need


@dataclass(kw_only=True)
class DataConfig:
    """The stream of renders, and of users' own labelled images beside them."""

    width: Annotated[
        int,
        _SIDE,
        "width of the views that the network learns from, px: crops of renders, each in other light.",
    ] = 448
    height: Annotated[int, _SIDE, "height of the views that the network learns from, px."] = 256
    render_width: Annotated[int, _RENDER_SIDE, "width of a render, px, out of which views are cut."] = 512
    render_height: Annotated[int, _RENDER_SIDE, "height of a render, px."] = 288
    views_per_render: Annotated[
        int, COUNT, "views of each render, on average; renders with more paint are shown more."
    ] = 8
    reservoir: Annotated[int, COUNT, "number of past renders that are kept to be shown again."] = 512
    easy_samples: Annotated[
        int,
        NOT_NEGATIVE,
        "number of renders at the start over which scenes grow from easy to full difficulty.",
    ] = 1000
    shadows_on_paint: Annotated[_Amount, "mean number of shadows with an edge across a marking."] = 3.0
    things_beside: Annotated[
        _Amount,
        "mean number of containers, barriers, cabinets and vehicles right beside a marking.",
    ] = 0.8
    faint: Annotated[
        _Amount,
        "share of scenes in which half of the markings are so dirty that the ground is nearly as bright.",
    ] = 0.25
    seams: Annotated[
        _Amount,
        "share of lane lines with a dark or bright seam beside them that goes on where a dash ends.",
    ] = 0.25
    side_seams: Annotated[
        _Amount, "mean number of markings with a crack or a tar seam along a side and beyond it."
    ] = 1.5
    pavements: Annotated[
        _Amount, "share of scenes in which the surface changes its tone along a line beside the paint."
    ] = 0.3
    bleached: Annotated[
        _Amount,
        "share of scenes whose ground is nearly as light as its paint; half of them are overexposed.",
    ] = 0.14
    overexposed: Annotated[
        _Amount,
        "share of images that are exposed several times too long.",
    ] = 0.15
    blue_shade: Annotated[_Amount, "share of scenes whose shade is lit by a deep blue sky."] = 0.3
    tight_bends: Annotated[
        _Amount,
        "share of scenes whose road turns as sharply as in yards and roundabouts.",
    ] = 0.15
    kerbs: Annotated[
        _Amount,
        "share of scenes with a bright kerb along a lane line, as narrow as paint, visible in "
        "pieces as long as dashes.",
    ] = 0.2
    gutters: Annotated[
        _Amount, "share of scenes with a strip of stones or concrete along the road, level with the ground."
    ] = 0.06
    joints: Annotated[_Amount, "mean number of long seams along the road, away from lane lines."] = 0.5
    junctions: Annotated[_Amount, "share of scenes with a junction ahead: arrows, stop line, crosswalk."] = (
        0.12
    )
    mountings: Annotated[
        _Amount,
        "share of cameras lower than in cars (0.5 to 1.1 m) or higher than on most trucks (3.6 to 5 m).",
    ] = 0.15
    facing: Annotated[_Amount, "share of lanes whose arrows and words face the camera."] = 0.5
    stout: Annotated[
        _Amount, "share of lanes with arrows that have thick, tapered shafts and short heads."
    ] = 0.4
    hollow: Annotated[
        _Amount,
        "share of ports, and of streets with diamonds, whose diamonds are outlines; they are "
        "labelled as filled.",
    ] = 0.25
    crossings: Annotated[_Amount, "share of scenes with a stop line that meets or crosses lane lines."] = 0.12
    words: Annotated[_Amount, "share of scenes with words or a number in lanes."] = 0.15
    bays: Annotated[_Amount, "share of scenes with a row of bay or slot numbers along the road."] = 0.12
    boxes: Annotated[
        _Amount,
        "share of scenes with an area to be kept clear: yellow boxes, hatched aisles, crossed rectangles.",
    ] = 0.15
    users: Annotated[_Amount, "share of scenes with bicycles, people or wheelchairs painted in lanes."] = 0.1
    others: Annotated[
        _Amount,
        "share of scenes with paint that belongs to no class: rings, crosses, zigzags, corners of bays.",
    ] = 0.06
    give_way: Annotated[
        _Amount, "share of scenes with a give-way line of short dashes or teeth, labelled as a stop line."
    ] = 0.1
    far_stops: Annotated[_Amount, "share of scenes with a stop line 12 to 40 m ahead."] = 0.25
    crosswalks: Annotated[
        _Amount,
        "share of scenes with a whole crosswalk: bars, bars between two lines, or the two lines alone.",
    ] = 0.15
    doubles: Annotated[_Amount, "share of scenes with a double line; half of these lines are yellow."] = 0.15
    erased: Annotated[
        _Amount,
        "mean number of markings that were ground off, burnt off or painted over; they are "
        "labelled as bare ground.",
    ] = 0.7
    litter: Annotated[_Amount, "mean number of sheets, boxes, bags and cans on the ground."] = 1.2
    traffic: Annotated[
        _Amount,
        "mean number of vehicles, boards and kerbs with stripes, windows, wheels, plates or writing.",
    ] = 0.5
    own_vehicle: Annotated[
        _Amount,
        "share of images that show the camera's vehicle: bonnet, dashboard, wipers, or drops and "
        "reflections on the windscreen.",
    ] = 0.2
    rain: Annotated[_Amount, "share of scenes whose ground is wet and mirrors a bright sky."] = 0.08
    low_sun: Annotated[
        _Amount, "share of scenes with the sun 3 to 11 degrees high; half of them look towards it."
    ] = 0.1
    dusk: Annotated[_Amount, "share of scenes after sunset, mostly lit by the vehicle's headlights."] = 0.06
    sun_flecks: Annotated[_Amount, "share of scenes in deep shade with few spots of sun."] = 0.08
    grounds: Annotated[_Amount, "share of asphalt and concrete grounds whose texture is a photograph."] = 0.4
    aside: Annotated[_Amount, "share of cameras that look to the side of the vehicle."] = 0.08
    workers: Annotated[
        int | None,
        Within(0, MOST_PROCESSES),
        "number of processes that render; 0 renders in this process, null takes one less than the cores.",
    ] = 1
    coco: Annotated[str | None, "a file of your labelled images in COCO's format: polygons of markings."] = (
        None
    )
    coco_images: Annotated[
        str | None, "the folder that image names in coco start from; null for the folder of the file."
    ] = None
    coco_classes: Annotated[
        dict[str, str],
        'by category of coco: the class that it means; several with "|" between them where each '
        'piece is one of them; "none" for no marking; "CLASS|none" for outlines within which only '
        'some is paint of that class; "unknown" for ground of which nothing is known.',
    ] = field(default_factory=dict)
    coco_size: Annotated[
        list[int] | None,
        Within(1, 2**15),
        "width and height, px, to which the images of coco and their labels are stretched; null leaves them.",
    ] = None
    coco_edge_px: Annotated[
        float,
        Within(0, 100),
        "distance from a labelled outline, px, within which paint is unknown, for labels that are not exact.",
    ] = 0.0
    coco_complete: Annotated[
        list[str] | None,
        "the classes of which coco labels every marking within reach; null for all. Paint of "
        "other classes that the shipped network sees outside of labels is unknown, not bare.",
    ] = None
    coco_relabel: Annotated[
        dict[str, str],
        "by category: a JSON file with the ids of annotations that are of that category, whatever "
        "coco calls them.",
    ] = field(default_factory=dict)
    coco_tone: Annotated[
        bool,
        "whether only the part of an outline that is brighter than the ground beside it is paint; "
        "for outlines of many pieces, stripes and lines.",
    ] = False
    coco_balance: Annotated[
        float,
        SHARE,
        "how much more often images with a rare class are shown: 0 for no more, 1 for every class "
        "equally often, up to eight times.",
    ] = 0.0
    coco_camera: Annotated[
        list[float] | None,
        Within(-90, 180),
        "height (m), pitch (deg, down) and horizontal field of view (deg) of the camera of coco, "
        "roughly; sizes on the ground then tell classes apart.",
    ] = None
    coco_held_out: Annotated[
        bool,
        "whether blocks of neighbouring images of coco are held out: one in ten for validation, "
        "two in ten for judging a finished network.",
    ] = False
    tusimple: Annotated[str | None, "a file of your labelled lanes in TuSimple's format."] = None
    tusimple_images: Annotated[
        str | None, "the folder that image names in tusimple start from; null for the folder of the file."
    ] = None
    labelled_share: Annotated[
        float, SHARE, "share of views that are cut out of your labelled images, if there are any."
    ] = 0.3


@dataclass(kw_only=True)
class LossConfig:
    """Weights of the terms: Dice of the paint, its class, and the lanes, beside the paint's cross entropy."""

    paint_weight: Annotated[float, NOT_NEGATIVE, "weight of a cell of paint against a bare one."] = 2.0
    dice: Annotated[float, NOT_NEGATIVE, "weight of the Dice loss of the paint."] = 0.5
    kinds: Annotated[float, NOT_NEGATIVE, "weight of the class of paint."] = 1.0
    lanes: Annotated[float, NOT_NEGATIVE, "weight of the lanes."] = 1.0
    kept: Annotated[
        float,
        NOT_NEGATIVE,
        "weight of what the network of start says of classes, while only the class heads learn "
        "(head_updates), where no label says otherwise.",
    ] = 2.0
    lane_weight: Annotated[
        float, NOT_NEGATIVE, "weight of a cell that a lane crosses against an empty one."
    ] = 3.0


@dataclass(kw_only=True)
class ValidationConfig:
    """A fixed set of renders of full difficulty, scored every so many minutes."""

    images: Annotated[int, Within(0, 2**20), "number of renders; 0 validates nothing."] = 64
    every_minutes: Annotated[float, POSITIVE, "time between two validations, minutes."] = 8.0


@dataclass(kw_only=True)
class TrainConfig:
    """One training run."""

    output: Annotated[str, "folder of the run: its checkpoints, log and validation."] = "runs/train"
    start: Annotated[
        str | None,
        "a checkpoint of another run, or an exported file, whose averaged weights this run starts "
        "from; it goes on in the sequence of renders. null starts from random weights.",
    ] = None
    catalogue: Annotated[
        str | None, "a YAML file with classes of your own (docs/labels.md); null for the classes of start."
    ] = None
    seed: Annotated[int, SEED, "seed of the first weights and of the renders."] = 1
    device: Annotated[str, "where the network is trained: auto, cpu or cuda."] = "auto"
    minutes: Annotated[
        float | None,
        Within(0, 1e7, open=True),
        "longest time of training; the run ends at minutes or steps, whichever comes first.",
    ] = None
    steps: Annotated[
        int | None, COUNT, "most updates; the run ends at minutes or steps, whichever comes first."
    ] = None
    batch: Annotated[int, Within(1, 2**16), "images per update, on each process."] = 8
    learning_rate: Annotated[
        float,
        Within(0, 10, open=True),
        "highest learning rate: it rises to this value over the warm-up, then falls to 0 as half a cosine.",
    ] = 2e-3
    weight_decay: Annotated[float, Within(0, 10), "weight decay of AdamW."] = 0.01
    warmup: Annotated[float, Within(0, 0.9), "share of the run over which the learning rate rises."] = 0.03
    head_updates: Annotated[
        int,
        NOT_NEGATIVE,
        "number of updates at the start in which only the heads that name classes learn, ten "
        "times as fast, so that new classes catch up before the features change.",
    ] = 0
    only_classes: Annotated[
        list[str] | None,
        "classes whose channels alone learn during head_updates, while all else stays as in "
        "start; null for all.",
    ] = None
    ema_updates: Annotated[
        int,
        COUNT,
        "number of updates over which weights are averaged; the averages are validated, kept and exported.",
    ] = 1000
    threads: Annotated[int, Within(1, MOST_PROCESSES), "torch's threads per process."] = 1
    bfloat16: Annotated[
        bool, "whether convolutions are computed in bfloat16 where the device is faster with it."
    ] = True
    checkpoint_minutes: Annotated[float, POSITIVE, "time between two checkpoints, minutes."] = 2.0
    resume: Annotated[bool, "whether to go on with a run that output already holds."] = True
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

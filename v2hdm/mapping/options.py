"""Settings of the mapping; the defaults suit ports and city streets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

from v2hdm.doors import check_types
from v2hdm.errors import ConfigError
from v2hdm.records import ACCURACIES
from v2hdm.safe.texts import shown
from v2hdm.settings import NO_KEY, NOT_NEGATIVE, POSITIVE, Within, check_settings
from v2hdm.site.options import AFTER, JOINT, AcceptanceOptions, LaneOptions

BATCH = "batch"
INCREMENTAL = "incremental"
AUTO = "auto"
MODES = (BATCH, INCREMENTAL)  # values of ``mode``

PLANE = "plane"
SURFACE = "surface"
GROUNDS = (PLANE, SURFACE, AUTO)  # values of ``mapping.ground``

SHORTEST_SECTION_M = 100.0
"""Least way, m, of a section: its overlaps are 40 m wide, and a camera's mounting shows on some turns."""

POSE_MODELS: tuple[str, ...] = (AUTO, "paper", "roll_pitch", "full", "heave", "clock")
"""Values of ``mapping.pose_model``: the models of :data:`v2hdm.adjust.MODELS`, or ``auto``."""


@dataclass(kw_only=True)
class SizeOptions:
    """Sizes of classes that are painted to a standard, as factors of the joint solve."""

    by_class_m: Annotated[
        dict[str, list[float]],
        "by class, length and width, m, such as {diamond: [1.0, 0.7]}: diagonals of diamonds, "
        "sides of other classes.",
    ] = field(default_factory=dict)
    sigma_m: Annotated[float, POSITIVE, "standard deviation of these sizes, m."] = 0.005
    tolerance: Annotated[
        float, POSITIVE, "a marking whose size differs by more than this fraction is not held to it."
    ] = 0.15


@dataclass(kw_only=True)
class ControlOptions:
    """A surveyed corner of a marking."""

    id: Annotated[str, "name of the point in the survey."]
    position_map: Annotated[list[float], "x and y, m."]
    sigma_m: Annotated[list[float], "standard deviations of x and y, m."]


@dataclass(kw_only=True)
class SurveyOptions:
    """Surveyed corners of markings, as factors of the joint solve.

    Only a survey reveals a receiver's drift: no camera sees motion that vehicle and map share.
    """

    file: Annotated[
        str | None, "a CSV of control points and of check points, which are held out (docs/accuracy.md)."
    ] = None
    crs: Annotated[str | None, "the projected system of its eastings and northings, such as EPSG:32632."] = (
        None
    )
    geoid_m: Annotated[
        float | None, "the geoid's height above the ellipsoid, for heights above sea level."
    ] = None
    points: Annotated[list[ControlOptions], "control points in the frame of the recorded poses."] = field(
        default_factory=list
    )
    sigma_m: Annotated[float, POSITIVE, "the standard deviation of points in the file that state none."] = (
        0.01
    )
    reach_m: Annotated[
        float, POSITIVE, "a control point ties down the nearest corner of the map within this distance, m."
    ] = 0.25

    def without(self, name: str) -> SurveyOptions:
        """The survey without the control point of that name."""
        return self.only([point for point in self.points if point.id != name])

    def only(self, points: Sequence[ControlOptions]) -> SurveyOptions:
        """The survey with these control points, and no file left to read."""
        return replace(self, file=None, points=list(points))


@dataclass(kw_only=True)
class MappingOptions:
    """Settings of the mapping, except the solver's own."""

    max_range_m: Annotated[
        float,
        POSITIVE,
        "sightings farther from the camera join a marking if only that one fits, but start none: they could "
        "tie a repainted marking's old place to its new one.",
    ] = 16.0
    model_floor_px: Annotated[
        float,
        NOT_NEGATIVE,
        "added to every corner's covariance for errors that no corner fit knows: lens, shutter.",
    ] = 0.15
    mode: Annotated[
        str, "batch; or incremental, marking by marking as on the vehicle, then solved like batch."
    ] = field(default=BATCH, metadata=NO_KEY)
    pose_model: Annotated[
        str,
        "the part of each frame's pose that is estimated: paper, none; roll_pitch; full, also heading and "
        "position; heave, also height; clock, also each camera's clock offset; auto, the one that predicts "
        "held-out observations best.",
    ] = AUTO
    estimate_read_out: Annotated[
        bool, "estimate each camera's read-out time (rolling shutter) near the stated one."
    ] = False
    ground: Annotated[
        str,
        "plane, once the recorded road is laid flat; surface, a cross-section along the vehicle's path plus "
        "a smooth spline; or auto, the plane unless the drive contradicts it and a surface predicts "
        "held-out observations better.",
    ] = AUTO
    loss: Annotated[str, "robust loss of the solver: none, huber, cauchy or geman_mcclure."] = "cauchy"
    loss_scale: Annotated[
        float, POSITIVE, "residual, in standard deviations, from which the loss departs from least squares."
    ] = 2.0
    rounds: Annotated[
        int,
        Within(1, 100),
        "number of times that association under the optimised extrinsic and a joint solve repeat.",
    ] = 2
    device: Annotated[str, "torch device of the joint solves, cpu or cuda."] = field(
        default="cpu", metadata=NO_KEY
    )
    acceptance: AcceptanceOptions = field(default_factory=AcceptanceOptions)
    lanes: LaneOptions = field(default_factory=LaneOptions)
    known_sizes: SizeOptions = field(default_factory=SizeOptions)
    survey: SurveyOptions = field(default_factory=SurveyOptions)


def check_options(options: MappingOptions, kinds: Sequence[str] | None = None) -> None:
    """Raise ConfigError, which names the key, for values that mapping cannot work with.

    ``kinds`` are the four-cornered classes that the detector knows; None accepts any.
    """
    check_types(options, "mapping.")
    from v2hdm.adjust.problem import LOSSES  # brings torch, which settings as such do without

    choices = {
        "mode": (options.mode, MODES),
        "mapping.pose_model": (options.pose_model, POSE_MODELS),
        "mapping.ground": (options.ground, GROUNDS),
        "mapping.loss": (options.loss, LOSSES),
    }
    for key, (value, allowed) in choices.items():
        if value not in allowed:
            which = " or ".join(allowed) if len(allowed) == 2 else f"from {', '.join(allowed)}"
            raise ConfigError(f"{key} is {shown(value)}; choose {which}.")
    if options.lanes.model not in (AFTER, JOINT):
        raise ConfigError(f"mapping.lanes.model is {shown(options.lanes.model)}; choose {AFTER} or {JOINT}.")
    if options.acceptance.accuracy not in ACCURACIES:
        *better, worst = ACCURACIES
        raise ConfigError(
            f"mapping.acceptance.accuracy is {shown(options.acceptance.accuracy)}; "
            f"choose from {', '.join(better)} or {worst}."
        )
    check_settings(options, "mapping.")
    for kind, size in options.known_sizes.by_class_m.items():
        key = f"mapping.known_sizes.by_class_m.{kind}"
        if kinds is not None and kind not in kinds:
            raise ConfigError(f"{key}: there is no such class; choose from {', '.join(kinds)}.")
        if len(size) != 2 or not 0 < size[1] <= size[0]:
            raise ConfigError(f"{key} is {list(size)}; give length and width in m, the longer one first.")
    for number, point in enumerate(options.survey.points):
        key = f"mapping.survey.points[{number}]"
        if len(point.position_map) != 2:
            raise ConfigError(f"{key}.position_map is {list(point.position_map)}; give x and y in m.")
        if len(point.sigma_m) != 2 or not all(value > 0 for value in point.sigma_m):
            raise ConfigError(f"{key}.sigma_m is {list(point.sigma_m)}; give those of x and y in m, above 0.")
    names = [point.id for point in options.survey.points]
    twice = next((name for number, name in enumerate(names) if name in names[:number]), None)
    if twice is not None:
        raise ConfigError(f"mapping.survey names the point {twice} twice; keep one of them.")


def check_sections(options: MappingOptions) -> None:
    """Raise ConfigError for settings that the sections of a drive cannot have each for itself."""
    unfit = {
        "mapping.survey": bool(options.survey.points) or options.survey.file is not None,
        "mapping.known_sizes": bool(options.known_sizes.by_class_m),
        "mapping.lanes.model=joint": options.lanes.model == JOINT,
        "mapping.ground=surface": options.ground == SURFACE,
        "mode=incremental": options.mode == INCREMENTAL,
    }
    for key, is_set in unfit.items():
        if is_set:
            raise ConfigError(f"{key}: not with sections; leave it out, or set map.section_m=0")

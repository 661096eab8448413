"""Settings of the mapping; the defaults suit ports and city streets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from v2hdm.errors import ConfigError
from v2hdm.settings import NOT_NEGATIVE, POSITIVE, Within, check_settings
from v2hdm.site.options import AFTER, JOINT, AcceptanceOptions, LaneOptions

BATCH = "batch"
INCREMENTAL = "incremental"
AUTO = "auto"
MODES = (BATCH, INCREMENTAL)  # values of ``mapping.mode``

PLANE = "plane"
SURFACE = "surface"
GROUNDS = (PLANE, SURFACE, AUTO)  # values of ``mapping.ground``

POSE_MODELS: tuple[str, ...] = (AUTO, "paper", "roll_pitch", "full", "heave", "clock")
"""Values of ``mapping.pose_model``: the models of :data:`v2hdm.adjust.MODELS`, or ``auto``."""

_RANGES = dict.fromkeys(
    (
        "max_range_m", "loss_scale", "known_sizes.sigma_m", "known_sizes.tolerance", "survey.sigma_m",
        "survey.reach_m",
    ),
    POSITIVE,
) | dict.fromkeys(
    ("model_floor_px", "acceptance.max_sigma_m", "lanes.max_range_m", "lanes.min_images"), NOT_NEGATIVE
) | {"rounds": Within(1, 100), "acceptance.min_probability": Within(0, 1 - 1e-9, open=True)}  # fmt: skip


@dataclass(kw_only=True)
class SizeOptions:
    """Sizes of classes that are painted to a standard, as factors of the joint solve.

    ``by_class_m`` has length and width, m (diagonals of diamonds, sides of other classes), as in
    ``{diamond: [1.0, 0.7]}``, with the standard deviation ``sigma_m``. A marking off by more than the
    fraction ``tolerance`` is not of that size.
    """

    by_class_m: dict[str, list[float]] = field(default_factory=dict)
    sigma_m: float = 0.005
    tolerance: float = 0.15


@dataclass(kw_only=True)
class ControlOptions:
    """A surveyed corner of a marking.

    ``id`` is its name in the survey, ``position_map`` x and y with standard deviations ``sigma_m``, m.
    """

    id: str
    position_map: list[float]
    sigma_m: list[float]


@dataclass(kw_only=True)
class SurveyOptions:
    """Surveyed corners of markings, as factors of the joint solve.

    ``file`` is a CSV of control points and of check points, which are held out (docs/accuracy.md).
    ``crs`` is the projected system of its eastings and northings, such as ``EPSG:32632``.
    ``geoid_m`` is the geoid's height above the ellipsoid, for heights above sea level.
    ``points`` are control points in the frame of the recorded poses. ``sigma_m`` is the standard deviation
    of points in the file that state none. Each control point ties down the nearest corner of the map within
    ``reach_m``. Only a survey reveals a receiver's drift: no camera sees motion that vehicle and map share.
    """

    file: str | None = None
    crs: str | None = None
    geoid_m: float | None = None
    points: list[ControlOptions] = field(default_factory=list)
    sigma_m: float = 0.01
    reach_m: float = 0.25

    def without(self, name: str) -> SurveyOptions:
        """The survey without the control point of that name."""
        return self.only([point for point in self.points if point.id != name])

    def only(self, points: Sequence[ControlOptions]) -> SurveyOptions:
        """The survey with these control points, and no file left to read."""
        return replace(self, file=None, points=list(points))


@dataclass(kw_only=True)
class MappingOptions:
    """Settings of the mapping, except the solver's own.

    Attributes:
        max_range_m: sightings farther from the camera join a marking if only that one fits, but start none:
            they could tie a repainted marking's old place to its new one.
        model_floor_px: added to every corner's covariance for errors that no corner fit knows: lens, shutter.
        pose_model: the part of each frame's pose that is estimated: ``paper``, none; ``roll_pitch``;
            ``full``, also heading and position; ``heave``, also height; ``clock``, also each camera's clock
            offset; ``auto``, the one that predicts held-out observations best.
        loss: robust loss of the solver: ``none``, ``huber``, ``cauchy`` or ``geman_mcclure``.
        loss_scale: residual, in standard deviations, from which the loss departs from least squares.
        estimate_read_out: estimate each camera's read-out time (rolling shutter) near the stated one.
        mode: ``batch``; or ``incremental``, marking by marking as on the vehicle, then solved like batch.
        ground: ``plane``, once the recorded road is laid flat; ``surface``, a cross-section along the
            vehicle's path plus a smooth spline; or ``auto``, the plane unless the drive contradicts it and
            a surface predicts held-out observations better.
        rounds: number of times that association under the optimised extrinsic and a joint solve repeat.
        device: torch device of the joint solves, ``cpu`` or ``cuda``.
    """

    max_range_m: float = 16.0
    model_floor_px: float = 0.15
    mode: str = BATCH
    pose_model: str = AUTO
    estimate_read_out: bool = False
    ground: str = AUTO
    loss: str = "cauchy"
    loss_scale: float = 2.0
    rounds: int = 2
    device: str = "cpu"
    acceptance: AcceptanceOptions = field(default_factory=AcceptanceOptions)
    lanes: LaneOptions = field(default_factory=LaneOptions)
    known_sizes: SizeOptions = field(default_factory=SizeOptions)
    survey: SurveyOptions = field(default_factory=SurveyOptions)


def check_options(options: MappingOptions, kinds: Sequence[str] | None = None) -> None:
    """Raise ConfigError, which names the key, for values that mapping cannot work with.

    ``kinds`` are the four-cornered classes that the detector knows; None accepts any.
    """
    from v2hdm.adjust.problem import LOSSES  # brings torch, which settings as such do without

    choices = {"mode": MODES, "pose_model": POSE_MODELS, "ground": GROUNDS, "loss": LOSSES}
    for key, allowed in choices.items():
        value = getattr(options, key)
        if value not in allowed:
            which = " or ".join(allowed) if len(allowed) == 2 else f"from {', '.join(allowed)}"
            raise ConfigError(f"mapping.{key} is '{value}'; choose {which}.")
    if options.lanes.model not in (AFTER, JOINT):
        raise ConfigError(f"mapping.lanes.model is '{options.lanes.model}'; choose {AFTER} or {JOINT}.")
    check_settings(options, _RANGES, "mapping.")
    for kind, size in options.known_sizes.by_class_m.items():
        key = f"mapping.known_sizes.by_class_m.{kind}"
        if kinds is not None and kind not in kinds:
            raise ConfigError(f"{key}: there is no such class; choose from {', '.join(kinds)}.")
        if len(size) != 2 or not 0 < size[1] <= size[0]:
            raise ConfigError(f"{key} is {list(size)}; give length and width in m, the longer one first.")
    for number, one in enumerate(options.survey.points):
        key = f"mapping.survey.points[{number}]"
        if len(one.position_map) != 2:
            raise ConfigError(f"{key}.position_map is {list(one.position_map)}; give x and y in m.")
        if len(one.sigma_m) != 2 or not all(value > 0 for value in one.sigma_m):
            raise ConfigError(f"{key}.sigma_m is {list(one.sigma_m)}; give those of x and y in m, above 0.")
    names = [one.id for one in options.survey.points]
    twice = next((name for number, name in enumerate(names) if name in names[:number]), None)
    if twice is not None:
        raise ConfigError(f"mapping.survey names the point {twice} twice; keep one of them.")

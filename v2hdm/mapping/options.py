"""The settings of the mapping; every default suits a port and a city street alike."""

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

    ``by_class_m`` holds length and width, m: of diamonds the diagonals, of other classes the sides, as in
    ``{diamond: [1.0, 0.7]}``. The paint keeps them up to ``sigma_m``; a marking that is off by more than
    ``tolerance``, as a share of length or width, is none of that size.
    """

    by_class_m: dict[str, list[float]] = field(default_factory=dict)
    sigma_m: float = 0.005
    tolerance: float = 0.15


@dataclass(kw_only=True)
class ControlOptions:
    """A corner of a marking that a survey has measured.

    ``id`` is its name in the survey, ``position_map`` its x and y and ``sigma_m`` theirs, m.
    """

    id: str
    position_map: list[float]
    sigma_m: list[float]


@dataclass(kw_only=True)
class SurveyOptions:
    """Corners of markings that a survey has measured, as factors of the joint solve.

    ``file`` is a CSV of control points and of check points, which are held out (docs/accuracy.md); ``crs`` is
    the projected system of its eastings and northings, such as ``EPSG:32632``, and ``geoid_m`` the height of
    the geoid above the ellipsoid where its heights count from the sea.
    ``points`` are control points in the frame of the recorded poses. A point of the file that states no sigma
    is known up to ``sigma_m``. Each control point ties down the nearest corner of the map within ``reach_m``.
    Nothing else can tell the drift of a receiver from the ground: no camera sees what moves the vehicle and
    its map alike.
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
    """Everything about the mapping but the solver's own settings.

    Sightings farther than ``max_range_m`` from the camera start no marking, but join the one that alone they
    fit: by themselves they would tie the old place of a repainted marking to its new one.
    ``model_floor_px`` is added to every corner's covariance for what no corner fit knows of: lens, shutter.
    ``pose_model`` says what of each frame's pose is estimated along with the map: ``paper``, nothing;
    ``roll_pitch``; ``full``, heading and position too; ``heave``, the height too; ``clock``, each camera's
    clock offset too; ``auto``, the one of them that predicts held-out observations best. ``loss`` and
    ``loss_scale`` are the robust loss of the solver.
    ``estimate_read_out`` estimates each camera's read-out time (rolling shutter), near the one that the drive
    states.
    ``mode`` is ``batch``, or ``incremental``: the drive as the vehicle would map it, marking by marking,
    and in the end solved as ``batch`` does.
    ``ground`` is ``plane``, once the recorded road is laid flat; ``surface``, which rises or falls with the
    distance from the vehicle's own path, as a road with a crown does, and is a smooth spline beside; or
    ``auto``, the plane unless the drive contradicts it and a surface predicts held-out observations better.
    ``rounds`` counts association under the optimised extrinsic followed by a joint solve.
    ``device`` is the torch device that the joint solves run on, ``cpu`` or ``cuda``.
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
    """Raise ConfigError, which names the key, for values that no mapping can work with.

    ``kinds`` are classes with four corners that the detector knows; None takes any.
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

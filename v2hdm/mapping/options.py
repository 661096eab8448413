"""What a user may set about the mapping; every default suits a port and a city street alike."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, is_dataclass, replace

from v2hdm.errors import ConfigError

BATCH = "batch"
INCREMENTAL = "incremental"
AUTO = "auto"
LEAST_SIGHTINGS = 3
"""Images that must show a marking where nothing else is weighed: in the naive methods, and of a track before
the incremental map takes it up."""

POSE_MODELS: tuple[str, ...] = (AUTO, "paper", "roll_pitch", "full", "heave", "clock")
"""What ``mapping.pose_model`` may be: those of :data:`v2hdm.adjust.MODELS`, or ``auto``."""


@dataclass(kw_only=True)
class AssociationOptions:
    """How sightings of one marking find each other.

    ``ipm_sigma_rad`` is how wrong the direction of a camera's initial IPM may be (one sigma): it
    sets how far a marking may seem to move between two images. ``refined_sigma_rad`` is the same
    once the extrinsic has been optimised. ``gate_sigmas`` is the size of every gate in sigmas and
    ``max_gate_m`` its limit. A track survives images without a sighting for ``max_gap_m`` of
    travel. ``shape_tolerance`` is how far corners may deviate from another sighting of the same
    shape, as a fraction of the marking's diameter. ``naive_merge_m`` is how far apart the naive
    methods, which know of no uncertainty, may put two tracks of one marking.
    """

    ipm_sigma_rad: float = 0.015
    refined_sigma_rad: float = 0.002
    gate_sigmas: float = 4.0
    max_gate_m: float = 1.5
    max_gap_m: float = 4.0
    shape_tolerance: float = 0.25
    naive_merge_m: float = 1.0


@dataclass(kw_only=True)
class AcceptanceOptions:
    """What a place must show to enter the map.

    ``min_probability`` of being a marking, given its shape, how often it was seen and where it was not; and
    a worst corner less certain than the best one of the map by at most ``max_sigma_m``.
    """

    min_probability: float = 0.9
    max_sigma_m: float = 0.06


@dataclass(kw_only=True)
class LaneOptions:
    """How lane paint becomes polylines.

    ``max_range_m`` from the camera; ``node_spacing_m`` between the vertices of a polyline;
    ``half_width_m`` across and ``half_length_m`` along bound the neighbourhood that is averaged;
    ``max_dash_gap_m`` is the longest gap between two dashes of one line and ``max_break_m`` the
    longest break in solid paint that is bridged. A piece needs ``min_length_m`` and, at each
    vertex, ``min_images``.
    """

    max_range_m: float = 12.0
    node_spacing_m: float = 0.5
    half_width_m: float = 0.3
    half_length_m: float = 0.8
    max_dash_gap_m: float = 9.0
    max_break_m: float = 3.0
    min_length_m: float = 2.0
    min_images: int = 3


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

    ``file`` is a CSV of control points and of check points, which are held out (docs/survey.md); ``crs`` is
    the projected system of its eastings and northings, such as ``EPSG:32632``, and ``geoid_m`` the height of
    the geoid above the ellipsoid where its heights count from the sea.
    ``points_map`` are x and y of control points, m, in the frame of the recorded poses, as in
    ``[[3.21, 4.05]]``; ``points`` are such with names and sigmas of their own. The others are known up to
    ``sigma_m``. Each ties down the nearest corner of the map within ``reach_m``. Nothing else can tell the
    drift of a receiver from the ground: no camera sees what moves the vehicle and its map alike.
    """

    file: str | None = None
    crs: str | None = None
    geoid_m: float | None = None
    points_map: list[list[float]] = field(default_factory=list)
    points: list[ControlOptions] = field(default_factory=list)
    sigma_m: float = 0.01
    reach_m: float = 0.25

    @property
    def control(self) -> tuple[ControlOptions, ...]:
        """All control points; those of ``points_map`` are named after where they lie."""
        sigma_m = [self.sigma_m, self.sigma_m]
        unnamed = (
            ControlOptions(id=f"({x:.2f}, {y:.2f})", position_map=[x, y], sigma_m=sigma_m)
            for x, y in self.points_map
        )
        return (*unnamed, *self.points)

    def without(self, name: str) -> SurveyOptions:
        """The survey without the control point of that name."""
        return self.only([point for point in self.control if point.id != name])

    def only(self, points: Sequence[ControlOptions]) -> SurveyOptions:
        """The survey with these control points, and no file left to read."""
        return replace(self, file=None, points_map=[], points=list(points))


@dataclass(kw_only=True)
class MappingOptions:
    """Everything about the mapping but the solver's own settings.

    Observations farther than ``max_range_m`` from the camera are left out. ``model_floor_px`` is
    added to every corner's covariance for what no corner fit knows of: lens, shutter, flatness.
    ``pose_model`` says what of each frame's pose is estimated along with the map: ``paper``, nothing;
    ``roll_pitch``; ``full``, heading and position too; ``heave``, the height too; ``clock``, each camera's
    clock offset too; ``auto``, the one of them that predicts held-out observations best. ``loss`` and
    ``loss_scale`` are the robust loss of the solver.
    ``mode`` is ``batch``, or ``incremental``: the drive as the vehicle would map it, marking by marking,
    and in the end solved as ``batch`` does.
    ``rounds`` counts association under the optimised extrinsic followed by a joint solve.
    ``device`` is the torch device that the joint solves run on, ``cpu`` or ``cuda``.
    """

    max_range_m: float = 16.0
    model_floor_px: float = 0.15
    mode: str = BATCH
    pose_model: str = AUTO
    loss: str = "cauchy"
    loss_scale: float = 2.0
    rounds: int = 2
    device: str = "cpu"
    association: AssociationOptions = field(default_factory=AssociationOptions)
    acceptance: AcceptanceOptions = field(default_factory=AcceptanceOptions)
    lanes: LaneOptions = field(default_factory=LaneOptions)
    known_sizes: SizeOptions = field(default_factory=SizeOptions)
    survey: SurveyOptions = field(default_factory=SurveyOptions)


def check_options(options: MappingOptions, kinds: Sequence[str] | None = None) -> None:
    """Refuse values that no mapping can work with.

    Args:
        options: the settings.
        kinds: classes with four corners that the detector knows; None takes any.

    Raises:
        ConfigError: A value is out of range; the message names the key.
    """
    positive = {
        "max_range_m": options.max_range_m,
        "loss_scale": options.loss_scale,
        "rounds": options.rounds,
        "association.ipm_sigma_rad": options.association.ipm_sigma_rad,
        "association.refined_sigma_rad": options.association.refined_sigma_rad,
        "association.gate_sigmas": options.association.gate_sigmas,
        "association.max_gate_m": options.association.max_gate_m,
        "acceptance.min_probability": options.acceptance.min_probability,
        "lanes.node_spacing_m": options.lanes.node_spacing_m,
        "lanes.half_width_m": options.lanes.half_width_m,
        "lanes.half_length_m": options.lanes.half_length_m,
        "known_sizes.sigma_m": options.known_sizes.sigma_m,
        "known_sizes.tolerance": options.known_sizes.tolerance,
        "survey.sigma_m": options.survey.sigma_m,
        "survey.reach_m": options.survey.reach_m,
    }
    if options.mode not in (BATCH, INCREMENTAL):
        raise ConfigError(f"mapping.mode is '{options.mode}'; choose {BATCH} or {INCREMENTAL}.")
    if options.pose_model not in POSE_MODELS:
        raise ConfigError(
            f"mapping.pose_model is '{options.pose_model}'; choose from {', '.join(POSE_MODELS)}."
        )
    from v2hdm.adjust.problem import LOSSES  # brings torch, which settings as such do without

    if options.loss not in LOSSES:
        raise ConfigError(f"mapping.loss is '{options.loss}'; choose from {', '.join(LOSSES)}.")
    for key, value in positive.items():
        if not value > 0:
            raise ConfigError(f"mapping.{key} is {value}; it must be greater than zero.")
    for key, value in _numbers(options):
        if not value >= 0:
            raise ConfigError(f"mapping.{key} is {value}; it must be a number, zero or greater.")
    if options.acceptance.min_probability >= 1:
        value = options.acceptance.min_probability
        raise ConfigError(f"mapping.acceptance.min_probability is {value}; it must be less than one.")
    _check_sizes(options, kinds)
    _check_survey(options)


def _numbers(options: object, where: str = "") -> Iterator[tuple[str, float]]:
    """All single numbers among settings and the settings within them, by their keys."""
    for name, value in vars(options).items():
        if is_dataclass(value):
            yield from _numbers(value, f"{where}{name}.")
        elif isinstance(value, (int, float)):
            yield where + name, value


def _check_survey(options: MappingOptions) -> None:
    for number, point in enumerate(options.survey.points_map):
        if len(point) != 2 or not all(math.isfinite(value) for value in point):
            raise ConfigError(f"mapping.survey.points_map[{number}] is {list(point)}; give x and y in m.")
    for number, one in enumerate(options.survey.points):
        key = f"mapping.survey.points[{number}]"
        if len(one.position_map) != 2 or not all(math.isfinite(value) for value in one.position_map):
            raise ConfigError(f"{key}.position_map is {list(one.position_map)}; give x and y in m.")
        if len(one.sigma_m) != 2 or not all(0 < value < math.inf for value in one.sigma_m):
            raise ConfigError(f"{key}.sigma_m is {list(one.sigma_m)}; give those of x and y in m, above 0.")
    names = [one.id for one in options.survey.control]
    twice = next((name for number, name in enumerate(names) if name in names[:number]), None)
    if twice is not None:
        raise ConfigError(f"mapping.survey names the point {twice} twice; keep one of them.")


def _check_sizes(options: MappingOptions, kinds: Sequence[str] | None) -> None:
    for kind, size in options.known_sizes.by_class_m.items():
        key = f"mapping.known_sizes.by_class_m.{kind}"
        if kinds is not None and kind not in kinds:
            raise ConfigError(f"{key}: there is no such class; choose from {', '.join(kinds)}.")
        if len(size) != 2 or not 0 < size[1] <= size[0] < math.inf:
            raise ConfigError(f"{key} is {list(size)}; give length and width in m, the longer one first.")

"""Every fault that an input can have, one record each.

Score tests, odds, recovery and findings read what they need to know of a fault from its record. A new fault
is a record here and its columns of derivatives in :mod:`v2hdm.faults.columns`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto

import numpy as np

_SHOWN = {"m": (100.0, "cm"), "s": (1e3, "ms"), "rad": (180 / np.pi, "deg"), "px": (1.0, "px"), "": (1.0, "")}
"""For each unit, the factor and the unit with which a user sees its values."""

PRIOR_ODDS = 1 / 400
"""Prior odds of a wrong input: one in forty, in one of ten drives of a new vehicle."""

_WAYS = (("behind", "ahead of"), ("to the right of", "to the left of"), ("below", "above"))
_MAP_AXES = ("east", "north", "north-east", "north-west")


class Item(Enum):
    """The things that the ``item`` of a test counts."""

    NOTHING = auto()
    SESSION = auto()
    FRAME = auto()  # from which on an input is wrong
    LENGTH = auto()  # known lengths, without repetitions
    POINT = auto()  # surveyed points


class Recovery(Enum):
    """How the mapper does without an input that is contradicted."""

    NONE = auto()  # the drive needs the input
    SHIFT_CLOCKS = auto()
    DROP_CENTRES = auto()  # one axis of the surveyed centres
    DROP_SIZES = auto()
    DROP_POINT = auto()
    DROP_POINTS = auto()


@dataclass(frozen=True)
class Error:
    """An error of an input, as far as its sentence tells it."""

    value: float  # true minus stated, in the fault's unit
    axis: int  # as in :class:`v2hdm.faults.score.ScoreTest`
    cameras: tuple[str, ...]
    about: str  # which session, length or point is wrong, or from when on; may be empty

    @property
    def size(self) -> float:
        """Absolute value."""
        return abs(self.value)

    @property
    def whose(self) -> str:
        """Names of the cameras."""
        return " and ".join(self.cameras)

    def word(self, positive: str, negative: str) -> str:
        """The word for the sign of the value."""
        return positive if self.value > 0 else negative

    @property
    def way(self) -> str:
        """Distance and direction in the vehicle."""
        return f"{100 * self.size:.0f} cm {_WAYS[self.axis][self.value > 0]}"


@dataclass(frozen=True, eq=False, repr=False)
class Fault:
    """An input that may be wrong; its value is what is to be added to the stated input."""

    name: str
    unit: str  # of the value and of all sizes below; empty if dimensionless
    least: float  # smaller errors do not matter
    # largest model sigma at which a drive observes it. A less observable fault resembles others, and absorbs
    # remaining errors: k1 on a straight street, for instance.
    observable_sigma: float
    usual: float  # median size where an input is wrong
    most: float  # largest physical value; beyond it, the cause is unforeseen
    check: str  # name of the check that reports it
    remedy: str  # what the user should do
    sentence: Callable[[Error], str]  # the error and its size, as a clause
    item: Item = Item.NOTHING
    recovery: Recovery = Recovery.NONE
    recoverable_sigma: float = math.inf  # largest sigma at which the mapper does without the input
    corrected_by: str = "it was left out of the result"  # what the recovery did, as a clause
    needs_centres: bool = False  # tested only where all its cameras have a stated centre: others are guesses
    like_clock: bool = False  # a constant clock offset may stand for it
    prior_odds: float = PRIOR_ODDS
    # The stated noise of the poses allows for it: it may be why a map is doubtful, but contradicts none.
    is_allowed_for: bool = False
    is_of_lens: bool = False  # of camera_info
    like_ground: bool = False  # it deforms a plane's image: if a surface leaves it, it is the likelier cause

    @property
    def is_change(self) -> bool:
        """Whether the input becomes wrong at an unknown time."""
        return self.item is Item.FRAME

    def shown(self, size: float) -> str:
        """A size in the unit that users see."""
        scale, unit = _SHOWN[self.unit]
        return f"{scale * size:.2g} {unit}".rstrip()

    def __repr__(self) -> str:
        """The fault by its name."""
        return f"<fault: {self.name}>"


def _clock(error: Error) -> str:
    images = f"the images of {error.whose}{f' {error.about}' if error.about else ''}"
    late = error.word("later", "earlier")
    return f"{images} were taken {1e3 * error.size:.0f} ms {late} than their stamps say"


def _clock_drift(error: Error) -> str:
    by_ms = f"{1e3 * error.size:.0f} ms"
    how = f"wanders, as counted stamps do: within {by_ms}"
    if error.axis == 0:
        how = f"runs {error.word('slow', 'fast')}: by {by_ms} over the drive"
    return f"the clock of the images of {error.whose} {how}"


def _focal(error: Error) -> str:
    which = ("focal length", "focal length fy")[error.axis]
    longer = error.word("longer", "shorter")
    return f"the {which} of {error.whose} is {100 * error.size:.1f} % {longer} than camera_info says"


def _distortion(error: Error) -> str:
    return f"the lens distortion of {error.whose} is not that of camera_info (k1 off by {error.value:+.3f})"


def _principal(error: Error) -> str:
    way = ("right", "down")[error.axis]
    return f"the principal point of {error.whose} lies {error.value:+.0f} px {way} of where camera_info says"


def _slope(error: Error) -> str:
    return f"the ground rises by {100 * error.value:+.1f} % to the {_MAP_AXES[error.axis]} under the poses"


def _crown(error: Error) -> str:
    falls = error.word("falls", "rises")
    side = ("both sides", "the left", "the right")[error.axis]
    return f"the ground {falls} by {100 * error.size:.1f} % to {side} of the route, as on a crown"


def _course(error: Error) -> str:
    return (
        f"the heading is not the vehicle's, but the course of a point {error.size:.1f} m "
        f"{error.word('ahead of', 'behind')} the rear axle"
    )


def _slip(error: Error) -> str:
    return (
        f"in bends the headings, an antenna's course, are off by {np.rad2deg(error.size):.2f} deg for each "
        "m/s2 to the side (slip of the tyres, or a wrong lever_arm_m)"
    )


def _step(error: Error) -> str:
    by_cm = f"{100 * error.value:+.0f} cm {_MAP_AXES[error.axis]}"
    return f"the position steps by {by_cm} and stays there, {error.about}"


def _knock(error: Error) -> str:
    turned = ("in roll", "in pitch", "in yaw")[error.axis]
    of_all = "as if the heading stepped" if error.axis == 2 else "as by load"
    cause = of_all if len(error.cameras) > 1 else "as by a knock"
    by = f"{np.rad2deg(error.size):.1f} deg {turned}"
    return f"the mounting of {error.whose} is turned by {by} {error.about}, {cause}"


def _survey(error: Error) -> str:
    return f"the centre of {error.whose} lies {error.way} its survey"


def _lever(error: Error) -> str:
    return (
        f"the centres of {error.whose} all lie {error.way} their surveys, as if the poses were of another "
        "point of the vehicle (antenna instead of axle)"
    )


def _scale(error: Error) -> str:
    how_far = error.word("close together", "far apart")
    return f"the recorded positions lie {100 * error.size:.1f} % too {how_far}"


def _size(error: Error) -> str:
    longer = error.word("longer", "shorter")
    return f"paint that known_sizes states as {error.about} is {100 * error.size:.1f} cm {longer}"


def _control(error: Error) -> str:
    return f"the surveyed point {error.about} is {100 * error.size:.0f} cm off the marking's corner"


def _datum(error: Error) -> str:
    by_cm = f"{100 * error.value:+.0f} cm {_MAP_AXES[error.axis]}"
    return f"the surveyed points all lie {by_cm} of the markings"


# Images were taken later than stamped.
CLOCK = Fault(
    "clock", "s", least=0.005, observable_sigma=0.02, usual=0.05, most=5.0,
    check="clock",
    remedy="synchronise the clocks of cameras and receiver, or shift the stamps by that",
    sentence=_clock,
    item=Item.SESSION,
    recovery=Recovery.SHIFT_CLOCKS,
    recoverable_sigma=0.006,  # a late clock adds scatter to its estimate
    corrected_by="images got poses at the corrected times",
)  # fmt: skip

# Images were taken increasingly later: the value is the total from first to last image. Axis 0 is linear, the
# others are waves.
CLOCK_DRIFT = Fault(
    "clock drift", "s", least=0.01, observable_sigma=0.02, usual=0.05, most=5.0,
    check="clock drift",
    remedy="stamp images with their exposure time on the receiver's clock",
    sentence=_clock_drift,
    like_clock=True,
)  # fmt: skip

# Relative error of the focal length: of fx and fy (axis 0), or of fy alone.
FOCAL = Fault(
    "focal", "", least=0.003, observable_sigma=0.01, usual=0.02, most=1.0,
    check="focal length",
    remedy="check fx and fy in camera_info against the resolution, or recalibrate the lens",
    sentence=_focal,
    is_of_lens=True,
    like_ground=True,
)  # fmt: skip

# First radial coefficient.
DISTORTION = Fault(
    "distortion", "", least=0.002, observable_sigma=0.02, usual=0.05, most=1.0,
    check="distortion",
    remedy="check distortion_coefficients (and the focal length) in camera_info, or recalibrate",
    sentence=_distortion,
    is_of_lens=True,
    like_ground=True,
)  # fmt: skip

# Position of the principal point in the image; the axes are right and down.
PRINCIPAL = Fault(
    "principal", "px", least=5.0, observable_sigma=10.0, usual=20.0, most=500.0,
    check="principal point",
    remedy="check cx and cy in camera_info against the image's size and crop, or recalibrate",
    sentence=_principal,
    is_of_lens=True,
    like_ground=True,
)  # fmt: skip

# Slope of the ground that the poses do not know; the axes are east and north.
SLOPE = Fault(
    "slope", "rad", least=0.002, observable_sigma=0.003, usual=0.01, most=0.3,
    check="slope",
    remedy="record the height of the poses, or roll and pitch",
    sentence=_slope,
)  # fmt: skip

# Fall of the ground to both sides of the route (axis 0), to the left or to the right.
CROWN = Fault(
    "crown", "", least=0.005, observable_sigma=0.005, usual=0.02, most=0.15,
    check="crown",
    remedy="leave mapping.ground at auto, or map the two sides of the crown separately",
    sentence=_crown,
    like_ground=True,
)  # fmt: skip

# The heading is that of the motion of a point ahead of the rear axle.
COURSE = Fault(
    "course", "m", least=0.3, observable_sigma=0.3, usual=1.0, most=10.0,
    check="heading",
    remedy="record the vehicle's heading from two antennas or an INS",
    sentence=_course,
    like_clock=True,
)  # fmt: skip

# Angle by which the heading of a course is off for each m/s2 to the side. A constant speed makes it look like
# a clock. In one of twenty drives it is beyond two sigmas of what the course's smoother allows for.
SLIP = Fault(
    "slip", "rad", least=0.001, observable_sigma=0.0015, usual=0.005, most=0.05,
    check="heading slip",
    remedy="record a gyro (poses.gyro_file or gyro_topic), or the heading of two antennas",
    sentence=_slip,
    prior_odds=1 / 20,
    is_allowed_for=True,
)  # fmt: skip

# Offset of recorded positions from some time on; the axes are east, north, north-east and north-west.
STEP = Fault(
    "step", "m", least=0.03, observable_sigma=0.02, usual=0.1, most=100.0,
    check="position step",
    remedy="check the receiver's log there, and leave out poses without an RTK fix",
    sentence=_step,
    item=Item.FRAME,
)  # fmt: skip

# Rotation of a camera about an axis of the vehicle from some time on; of all cameras by load.
KNOCK = Fault(
    "knock", "rad", least=0.002, observable_sigma=0.002, usual=0.01, most=1.0,
    check="mounting",
    remedy="fasten the camera, and map what was driven before and after by themselves",
    sentence=_knock,
    item=Item.FRAME,
)  # fmt: skip

_CENTRE_RECOVERABLE_M = 0.1  # sigma of a centre above which a drive needs its survey: it shifts the map

# Error of one camera's surveyed centre along an axis of the vehicle.
SURVEY = Fault(
    "survey", "m", least=0.03, observable_sigma=0.15, usual=0.1, most=20.0,
    check="survey",
    remedy="survey the camera's centre again; check signs, axes and the origin on the ground under the axle",
    sentence=_survey,
    recovery=Recovery.DROP_CENTRES,
    recoverable_sigma=_CENTRE_RECOVERABLE_M,
    needs_centres=True,
)  # fmt: skip

# Error of all surveyed centres, or of the point that the poses refer to, along an axis of the vehicle.
LEVER = Fault(
    "lever", "m", least=0.03, observable_sigma=0.15, usual=0.5, most=20.0,
    check="survey",
    remedy="measure the centres from the reference point of the poses, such as the antenna, "
    "or move the poses",
    sentence=_lever,
    recovery=Recovery.DROP_CENTRES,
    recoverable_sigma=_CENTRE_RECOVERABLE_M,
    needs_centres=True,
)  # fmt: skip

# Relative error of distances between recorded positions; Web Mercator at 30 degrees of latitude: 0.15.
SCALE = Fault(
    "scale", "", least=0.003, observable_sigma=0.05, usual=0.15, most=1.0,
    check="scale",
    remedy="give positions in metres on the ground, as in UTM or a local frame, not in Web Mercator",
    sentence=_scale,
    needs_centres=True,
)  # fmt: skip

# Error of known lengths of one value.
SIZE = Fault(
    "size", "m", least=0.01, observable_sigma=0.05, usual=0.05, most=10.0,
    check="known_sizes",
    remedy="measure the paint, or leave it out of mapping.known_sizes",
    sentence=_size,
    item=Item.LENGTH,
    recovery=Recovery.DROP_SIZES,
    corrected_by="no known size was used",
)  # fmt: skip

# Error of one surveyed point.
CONTROL = Fault(
    "control", "m", least=0.02, observable_sigma=0.05, usual=0.1, most=1e3,
    check="surveyed points",
    remedy="survey it again, or leave it out of mapping.survey",
    sentence=_control,
    item=Item.POINT,
    recovery=Recovery.DROP_POINT,
)  # fmt: skip

# Error of all surveyed points; the axes are east and north.
DATUM = Fault(
    "datum", "m", least=0.02, observable_sigma=0.05, usual=0.1, most=1e3,
    check="surveyed points",
    remedy="check that survey and poses have the same datum and origin",
    sentence=_datum,
    recovery=Recovery.DROP_POINTS,
)  # fmt: skip

FAULTS: dict[str, Fault] = {
    fault.name: fault
    for fault in (
        CLOCK, CLOCK_DRIFT, FOCAL, DISTORTION, PRINCIPAL, SLOPE, CROWN, COURSE, SLIP,
        STEP, KNOCK, SURVEY, LEVER, SCALE, SIZE, CONTROL, DATUM,
    )
}  # fmt: skip
"""Every fault, by its name."""

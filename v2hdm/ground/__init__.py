"""The ground speaks without any marking: mounting, clock, lens and poses judged from bare asphalt."""

from v2hdm.ground.better import better_start
from v2hdm.ground.estimate import estimate_ground
from v2hdm.ground.options import GroundOptions
from v2hdm.ground.results import GroundEstimate, GroundStatus, MatchedGround, Parameter, Reading
from v2hdm.ground.rig import estimate_cameras

__all__ = [
    "GroundEstimate",
    "GroundOptions",
    "GroundStatus",
    "MatchedGround",
    "Parameter",
    "Reading",
    "better_start",
    "estimate_cameras",
    "estimate_ground",
]

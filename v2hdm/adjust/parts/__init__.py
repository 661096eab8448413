"""One problem in parts, a drive each: what drives share is solved for together, the rest where it is.

Unknowns that only one drive has a say in (its frames' states, its clock offsets, the corners that only it
saw) stay with it. Extrinsics and corners that several drives saw are shared. A part eliminates its own
unknowns and hands on what that leaves of the shared ones: a symmetric matrix and a gradient. Their sum is
factorised once a whitening, and the descent is that of :mod:`v2hdm.adjust.descent`: the same whitened
variables but for a rotation, under which L-BFGS takes the same steps.
"""

from v2hdm.adjust.parts.choice import adjust
from v2hdm.adjust.parts.solve import solve_in_parts
from v2hdm.adjust.parts.team import Local, Team

__all__ = ["Local", "Team", "adjust", "solve_in_parts"]

"""Whether a result can be trusted: named checks, each with a value, a limit, a cause and a remedy.

The checks before the run (``python -m v2hdm.check``) and those after it end in one :class:`Verdict`.
What needs torch, :mod:`v2hdm.quality.after`, is not imported here: the door of the check does without.
"""

from v2hdm.quality.before import check_drive
from v2hdm.quality.ground import clock_corrections
from v2hdm.quality.verdict import Finding, Status, Verdict

__all__ = [
    "Finding",
    "Status",
    "Verdict",
    "check_drive",
    "clock_corrections",
]

"""Whether a result can be trusted: named checks, each with a value, a limit, a cause and a remedy.

The checks before the run (``python -m v2hdm.check``) and those after it end in one :class:`Verdict`.
"""

from v2hdm.quality.after import check_result
from v2hdm.quality.before import check_drive
from v2hdm.quality.ground import clock_corrections
from v2hdm.quality.solution import check_solution
from v2hdm.quality.verdict import Finding, Status, Verdict

__all__ = [
    "Finding",
    "Status",
    "Verdict",
    "check_drive",
    "check_result",
    "check_solution",
    "clock_corrections",
]

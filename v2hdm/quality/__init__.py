"""Whether a result can be trusted: named checks, each with a value, a limit, a cause and a remedy.

The checks before a run (:func:`check_drive`, and ``python -m v2hdm.check``) need no torch; those after it are
in :mod:`v2hdm.quality.after`. Both end in one :class:`Verdict`.
"""

from v2hdm.quality.before import check_drive
from v2hdm.quality.ground import clock_corrections
from v2hdm.quality.verdict import Finding, Status, Verdict

__all__ = ["Finding", "Status", "Verdict", "check_drive", "clock_corrections"]

"""Whether a result can be trusted: named checks, each with a value, a limit, a cause and a remedy.

``inputs`` holds the checks before a run (:func:`check_drive`, and ``v2hdm check``), which need no
torch; ``results`` those after it. Both end in one :class:`Verdict`.
"""

from v2hdm.verdict.inputs.drive import check_drive
from v2hdm.verdict.inputs.ground import clock_corrections
from v2hdm.verdict.verdict import Finding, Status, Verdict

__all__ = ["Finding", "Status", "Verdict", "check_drive", "clock_corrections"]

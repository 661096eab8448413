"""Whether a result can be trusted: named checks, each with a value, a limit, a cause and a recovery.

``inputs`` holds the checks before a run, which need no torch, ``results`` those after it. Both end in one
:class:`Verdict`.
"""

from v2hdm.verdict.inputs.drive import check_drive, input_findings
from v2hdm.verdict.inputs.ground import clock_corrections
from v2hdm.verdict.inputs.origin import known_frames
from v2hdm.verdict.verdict import Finding, Status, Verdict

__all__ = [
    "Finding",
    "Status",
    "Verdict",
    "check_drive",
    "clock_corrections",
    "input_findings",
    "known_frames",
]

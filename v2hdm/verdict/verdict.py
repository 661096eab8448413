"""The findings of all checks and the verdict that follows from them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any


class Status(Enum):
    """How a check ended; the verdict on a run is the worst of its checks."""

    PASS = "PASS"
    WARN = "WARN"
    FAIL = "FAIL"

    @property
    def rank(self) -> int:
        """0 for PASS, 1 for WARN, 2 for FAIL."""
        return list(Status).index(self)


@dataclass(frozen=True)
class Finding:
    """What one check found.

    Attributes:
        check: name of the check, stable from version to version, such as ``clock``.
        status: PASS within the limit. WARN where the result still holds, or was corrected. FAIL where the
            result is wrong or cannot be relied on.
        value: what was measured, in ``unit``; None where this drive cannot tell.
        limit: the largest ``value`` that passes, in ``unit``; None where there is none.
        unit: of ``value`` and ``limit``, such as ``ms``; empty for a ratio or a count.
        says: one sentence that names the cause and the remedy.
        about: what the finding is about: a camera's name, ``poses``, a setting, ``map``.
    """

    check: str
    status: Status
    value: float | None
    limit: float | None
    unit: str
    says: str
    about: str

    def as_json(self) -> dict[str, Any]:
        """The finding as an object of ``metrics.json``."""
        return {
            "check": self.check,
            "status": self.status.value,
            "value": self.value,
            "limit": self.limit,
            "unit": self.unit,
            "says": self.says,
            "about": self.about,
        }

    @property
    def is_untold(self) -> bool:
        """Whether this drive cannot tell: nothing speaks against it, and nothing for it."""
        return self.status is Status.PASS and self.value is None

    @property
    def line(self) -> str:
        """The finding as one line for the terminal and the log."""
        outcome = "cannot tell" if self.is_untold else self.status.value
        return f"{outcome} {self.check} ({self.about}): {self.says}"


@dataclass(frozen=True)
class Verdict:
    """All findings of a run, the worst first; those of equal rank keep the order of their checks.

    >>> result.verdict.lines[0].startswith("verdict: PASS (nothing raised")
    True
    >>> result.verdict.raised
    ()
    """

    findings: tuple[Finding, ...]

    @classmethod
    def of(cls, findings: Iterable[Finding]) -> Verdict:
        """The verdict that follows from ``findings``."""
        return cls(tuple(sorted(findings, key=lambda finding: -finding.status.rank)))

    @property
    def status(self) -> Status:
        """The worst status of all findings; PASS without any."""
        return self.findings[0].status if self.findings else Status.PASS

    @property
    def raised(self) -> tuple[Finding, ...]:
        """The findings that did not pass, the worst first."""
        return tuple(finding for finding in self.findings if finding.status is not Status.PASS)

    @property
    def untold(self) -> tuple[Finding, ...]:
        """The checks that this drive gives no answer to."""
        return tuple(finding for finding in self.findings if finding.is_untold)

    @property
    def passed(self) -> tuple[Finding, ...]:
        """The checks that were answered, within their limits."""
        return tuple(f for f in self.findings if f.status is Status.PASS and not f.is_untold)

    def as_json(self) -> dict[str, Any]:
        """The verdict as an object of ``metrics.json``: raised, untold and passed checks apart."""
        return {
            "status": self.status.value,
            "findings": [finding.as_json() for finding in self.raised],
            "untold": [finding.as_json() for finding in self.untold],
            "passed": [finding.as_json() for finding in self.passed],
        }

    @property
    def lines(self) -> tuple[str, ...]:
        """The verdict, what was raised and what this drive cannot tell, one line each, for a terminal."""
        raised = {0: "nothing raised", 1: "1 finding"}.get(len(self.raised), f"{len(self.raised)} findings")
        summary = f"verdict: {self.status.value} ({raised}, {len(self.passed)} checks passed)"
        return (summary, *(finding.line for finding in _joined((*self.raised, *self.untold))))


def _joined(findings: Iterable[Finding]) -> list[Finding]:
    """The findings, those that say the same of several cameras as one."""
    joined: dict[tuple[str, str], Finding] = {}
    for finding in findings:
        key = (finding.check, finding.says)
        same = joined.get(key)
        joined[key] = replace(same, about=f"{same.about}, {finding.about}") if same else finding
    return list(joined.values())

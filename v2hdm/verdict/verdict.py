"""The findings of all checks, how one follows from a measured value, and the verdict on all of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

from v2hdm.doors import checked, checked_class

GOAL = "coarse"  # the check whether map and calibrations are as good as accuracy_goal_cm asks


_RESTS_ON = ("survey", "clock")
"""Checks of inputs that shift a whole map where they err alike for all cameras."""


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
    """The result of one check.

    Attributes:
        check: name of the check, stable from version to version, such as ``clock``.
        status: PASS within the limit. WARN where the result still holds, or was corrected. FAIL where the
            result is wrong or cannot be relied on.
        value: the measured value, in ``unit``; None where this drive does not make it observable.
        limit: the largest ``value`` that passes, or the least of one that must not be too small, in ``unit``;
            None where there is none, or another figure decides.
        unit: of ``value`` and ``limit``, such as ``ms``; empty for a ratio or a count.
        says: one sentence that names the cause and the recovery.
        about: a camera's name, ``poses``, a setting, ``map``.
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
        return {**vars(self), "status": self.status.value}

    @property
    def is_unobservable(self) -> bool:
        """Whether this drive cannot tell: nothing speaks against it, and nothing for it."""
        return self.status is Status.PASS and self.value is None

    @property
    def line(self) -> str:
        """The finding as one line for the terminal and the log."""
        outcome = "cannot tell" if self.is_unobservable else self.status.value
        return f"{outcome} {self.check} ({self.about}): {self.says}"


@checked_class
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
    @checked
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
    def unobservable(self) -> tuple[Finding, ...]:
        """The checks that this drive gives no answer to, those that the whole map rests on first."""
        findings = [finding for finding in self.findings if finding.is_unobservable]
        return tuple(sorted(findings, key=lambda finding: finding.check not in _RESTS_ON))

    @property
    def passed(self) -> tuple[Finding, ...]:
        """The checks that were answered, within their limits."""
        return tuple(f for f in self.findings if f.status is Status.PASS and not f.is_unobservable)

    @property
    def headline(self) -> str:
        """How good the map is, and in which frame, after the status; empty where no map was judged.

        >>> result.verdict.headline.startswith("PASS: 95 % of ")
        True
        """
        on_map = [f.says for f in self.findings if f.check == GOAL and f.about == "map"]
        how_good = on_map[0] if on_map else ""
        if how_good and self.status is Status.FAIL:
            how_good = f"no accuracy can be promised, see {self.findings[0].check} ({self.findings[0].about})"
        return how_good and f"{self.status.value}: {how_good.split(': ')[0]}"

    def as_json(self) -> dict[str, Any]:
        """The verdict as an object of ``metrics.json``: raised, unobservable and passed checks apart."""
        return {
            "status": self.status.value,
            "headline": self.headline,
            "findings": [finding.as_json() for finding in self.raised],
            "unobservable": [finding.as_json() for finding in self.unobservable],
            "passed": [finding.as_json() for finding in self.passed],
        }

    @property
    def lines(self) -> tuple[str, ...]:
        """The verdict, raised findings and unobservable checks, one line each, for a terminal."""
        raised = {0: "nothing raised", 1: "1 finding"}.get(len(self.raised), f"{len(self.raised)} findings")
        counted = f"{self.status.value} ({raised}, {len(self.passed)} checks passed)"
        summary = f"verdict: {self.headline.replace(self.status.value, counted, 1) or counted}"
        return (summary, *(finding.line for finding in _joined((*self.raised, *self.unobservable))))


def _joined(findings: Iterable[Finding]) -> list[Finding]:
    """The findings, those that say the same of several cameras as one."""
    joined: dict[tuple[str, str], Finding] = {}
    for finding in findings:
        key = (finding.check, finding.says)
        same = joined.get(key)
        joined[key] = replace(same, about=f"{same.about}, {finding.about}") if same else finding
    return list(joined.values())


def judge(
    check: str,
    about: str,
    value: float,
    limit: float,
    unit: str,
    *,
    fine: str,
    wrong: str,
    status: Status = Status.FAIL,
    least: float | None = None,
) -> Finding:
    """A finding, as :class:`Finding` describes its parts, that passes where ``value`` is within +-``limit``.

    It says ``fine`` then, else ``wrong``, cause and recovery, with ``status``. With ``least``, ``value``
    passes from this to ``limit``, and the finding holds the nearer one.
    """
    inside = abs(value) <= limit
    if least is not None:
        inside = least <= value <= limit
        limit = least if abs(value - least) < abs(value - limit) else limit
    outcome = Status.PASS if inside else status
    return Finding(check, outcome, float(value), float(limit), unit, fine if inside else wrong, about)


def passed(check: str, about: str, says: str, value: float | None = None, unit: str = "") -> Finding:
    """A finding that passes and has no limit, such as one that is not observable on this drive."""
    return Finding(check, Status.PASS, value, None, unit, says, about)

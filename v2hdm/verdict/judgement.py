"""One finding from one measured value and its limit."""

from __future__ import annotations

from v2hdm.verdict.verdict import Finding, Status


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
) -> Finding:
    """A finding that passes where the size of ``value`` is at most ``limit``.

    Args:
        check: name of the check.
        about: what the finding is about.
        value: what was measured, in ``unit``.
        limit: the largest size of ``value`` that passes.
        unit: of both.
        fine: the sentence where it passes.
        wrong: the sentence where it does not: cause and remedy.
        status: the status where it does not.
    """
    passed = abs(value) <= limit
    return Finding(
        check,
        Status.PASS if passed else status,
        float(value),
        float(limit),
        unit,
        fine if passed else wrong,
        about,
    )


def judge_between(
    check: str,
    about: str,
    value: float,
    limits: tuple[float, float],
    unit: str,
    *,
    fine: str,
    wrong: str,
    status: Status = Status.FAIL,
) -> Finding:
    """As :func:`judge`, for a ``value`` that passes between two limits; the finding holds the nearer one."""
    low, high = limits
    inside = low <= value <= high
    limit = low if abs(value - low) < abs(value - high) else high
    return Finding(
        check, Status.PASS if inside else status, float(value), limit, unit, fine if inside else wrong, about
    )


def passed(check: str, about: str, says: str, value: float | None = None, unit: str = "") -> Finding:
    """A finding that passes and has no limit, such as one that this drive cannot tell."""
    return Finding(check, Status.PASS, value, None, unit, says, about)

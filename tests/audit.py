"""Known weaknesses of the installed packages: ``python -m tests.audit``, which ``make audit`` runs.

``pip-audit`` asks PyPI for advisories. Where these cannot be reached (offline, or a mirror that serves files
only) the audit is skipped, and says why; a weakness found is exit code 1.
"""

from __future__ import annotations

import json
import subprocess
import sys
import urllib.error
import urllib.request

ADVISORIES = "https://pypi.org/pypi/PyYAML/5.3/json"
"""A release with a known weakness (CVE-2020-14343): where its advisory is missing, so are all others."""

_PATIENCE_S = 10.0


def why_not(address: str = ADVISORIES) -> str | None:
    """Why advisories cannot be reached at ``address``, None where they can."""
    try:
        with urllib.request.urlopen(address, timeout=_PATIENCE_S) as answer:
            told = json.load(answer)
    except (OSError, ValueError) as failure:
        return f"{address}: {failure}"
    known = isinstance(told, dict) and told.get("vulnerabilities")
    return None if known else f"{address}: the answer holds no advisories"


def main(address: str = ADVISORIES) -> int:
    """Audit the running interpreter's packages; pip-audit's exit code, 0 where it is skipped."""
    reason = why_not(address)
    if reason is not None:
        print(f"audit of the packages skipped: no advisory data can be reached ({reason})")
        return 0
    command = [sys.executable, "-m", "pip_audit", "--skip-editable", "--progress-spinner", "off"]
    return subprocess.run(command, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())

"""Doors that write: what each is given, and what it has made when nothing fails."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

from tests.calibration.site import INFO, clicked, write_table
from tests.faults.judge import Case, Outcome
from v2hdm.io.calibration.writing import write_camera_info
from v2hdm.store.inputs import LIST

HERE = "work/here/"


@dataclass(frozen=True)
class Situation:
    """A door and its inputs.

    Attributes:
        case: of the judge.
        grows: whether its files appear one by one; otherwise all of them do at once.
        cache: of the inputs' folder, what is a cache.
    """

    case: Case
    grows: bool = False
    cache: str = "cache"

    @property
    def name(self) -> str:
        """The case's name."""
        return self.case.name


def calibrating() -> Situation:
    """The door to a pre-calibration."""
    words = ("points.csv", "--intrinsics", "camera_info.yaml", "--output", "out")
    return Situation(Case("calibrate", "v2hdm calibrate points", words, _points, ""))


def _points(root: Path) -> None:
    write_camera_info(INFO, root / "camera_info.yaml")
    write_table(root, *clicked(seed=1))


@dataclass(frozen=True)
class Expected:
    """The outcome of a door where nothing fails: exit code, files, and which differ from run to run."""

    code: int | str
    files: dict[str, str]
    loose: frozenset[str]

    @classmethod
    def of(cls, situation: Situation, first: Outcome, second: Outcome) -> Expected:
        """As two runs show."""
        assert first.code in (0, 3), (situation.name, first.code, first.error)
        assert first.code == second.code, (situation.name, second.code, second.error)
        files = _without(situation, first.after)
        loose = {name for name, digest in files.items() if second.after.get(name) != digest}
        return cls(first.code, files, frozenset(loose))

    def defects(self, situation: Situation, outcome: Outcome, again: Outcome | None = None) -> list[str]:
        """Defects of an outcome on a disk that fails, and of ``again`` on one that does not any more."""
        if outcome.code != 2:
            defects = self._wrong(situation, outcome, "is")
        else:
            before, after = _without(situation, outcome.before), _without(situation, outcome.after)
            new_files = {
                name for name, digest in after.items() if situation.grows and self._is_whole(name, digest)
            }
            before = {name: content for name, content in before.items() if name not in new_files}
            leaves = "|".join(f"^{re.escape(name)}$" for name in new_files) or r"(?!)"
            case = replace(situation.case, says=r"\S", code=2, leaves=leaves)
            defects = replace(outcome, before=before, after=after).faults(case)
        return defects + ([] if again is None else self._wrong(situation, again, "is afterwards"))

    def _is_whole(self, name: str, digest: str) -> bool:
        """Whether a file is there as it must be in the end."""
        return digest == self.files.get(name) or name in self.loose

    def _wrong(self, situation: Situation, outcome: Outcome, when: str) -> list[str]:
        """Whether what there is, is what there must be."""
        defects = [] if outcome.code == self.code else [f"exit code {when} {outcome.code}, not {self.code}"]
        if "Traceback" in outcome.error:
            defects.append(f"a traceback {when} there")
        files = _without(situation, outcome.after)
        # Of a file that a damaged list no longer names the door says under which name it keeps it.
        said = outcome.error + outcome.output
        backups = {name for name in files if ".kept." in name and Path(name).name in said}
        changed = [
            name
            for name in (self.files.keys() | files.keys()) - backups
            if name not in files or not self._is_whole(name, files[name])
        ]
        return [*defects, *([f"{when} wrong or missing: {sorted(changed)[:4]}"] if changed else [])]


def _without(situation: Situation, state: dict[str, str]) -> dict[str, str]:
    """A state without the cache; where files come one by one without their list, too."""
    cache = f"{HERE}{situation.cache}"
    return {
        name: content
        for name, content in state.items()
        if name != cache
        and not name.startswith(f"{cache}/")
        and not (situation.grows and name.rpartition("/")[2].startswith((LIST, "events.out.")))
    }

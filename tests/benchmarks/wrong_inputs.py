"""Wrong inputs, one at a time: is the map right, or is the user told, and of the true cause?

``python -m tests.benchmarks.wrong_inputs [--route turning straight] [--only PATTERN] [--ports port1 port2]
[--seeds 41 42] [--workers 2]`` renders a turning and a straight drive, spoils a copy of each in every way of
:mod:`tests.benchmarks.wrong`, maps it as a user would, and compares the map that was written with the truth,
which the copies do not hold. A map is right if its corners are at most 1.3 times as far off as those of the
drive as it was, with no more false markings. ``--only '^nothing$'`` maps the good drives alone.
"""

from __future__ import annotations

import argparse
import json
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from omegaconf import OmegaConf

from tests.benchmarks.wrong.cameras import camera_faults
from tests.benchmarks.wrong.fault import Fault, copy_of
from tests.benchmarks.wrong.poses import poses_faults
from v2hdm.cli import compose as hydra_config
from v2hdm.errors import V2hdmError
from v2hdm.executor import open_executor
from v2hdm.io.maps.reading import read_geojson
from v2hdm.mapping.options import MappingOptions
from v2hdm.pipeline.config import DriveConfig, RunConfig
from v2hdm.pipeline.run import run
from v2hdm.report.metrics import marking_metrics
from v2hdm.simulate.port.config import PortConfig
from v2hdm.simulate.port.drive import rendered_drive

ROUTES = {
    "turning": [[24.0, 0.0], [18.0, -80.0], [16.0, 0.0], [16.0, 60.0], [14.0, 0.0]],
    "straight": [[75.0, 0.0]],
}
"""Pieces of each route: [length in m, turn to the left in degrees]."""

RIGHT_FACTOR = 1.3
"""A map whose corner RMSE is at most this multiple of the clean drive's is right."""

_REFUSED = "refused"
_CRASHED = "CRASHED"


@dataclass(frozen=True)
class Outcome:
    """The end of a run: its verdict or its error, and how good the map is that it wrote."""

    status: str
    message: str = ""
    rmse_m: float = float("nan")
    false: int = 0
    markings: int = 0
    findings: list[dict[str, Any]] = field(default_factory=list)
    unobservable: list[dict[str, Any]] = field(default_factory=list)
    seconds: float = 0.0


@dataclass(frozen=True)
class Row:
    """The outcome of one fault on one drive."""

    drive: str
    fault: str
    outcome: Outcome
    right: bool
    told: bool
    named: bool
    named_first: bool

    @property
    def silently_wrong(self) -> bool:
        """Whether a wrong map came without a word."""
        return not self.right and not self.told


def port_of(port: str, route: str, seed: int) -> PortConfig:
    """A shipped port with another route and seed."""
    shipped = OmegaConf.load(hydra_config.conf_dir() / "run" / f"{port}.yaml").simulate
    changes = {"name": f"{port}_{route}", "seed": seed, "route": {"pieces": ROUTES[route]}}
    merged = OmegaConf.merge(OmegaConf.structured(PortConfig), shipped, OmegaConf.create(changes))
    port = OmegaConf.to_object(merged)
    assert isinstance(port, PortConfig)
    return port


def map_drive(
    folder: Path, output: Path, mapping: MappingOptions, good: Path, cache: Path = Path("cache")
) -> Outcome:
    """Map a drive as a user would, and compare what was written with the truth of the ``good`` drive."""
    begin_s = time.perf_counter()
    output.mkdir(parents=True, exist_ok=True)
    settings = RunConfig(
        name=folder.name,
        drive=DriveConfig(path=str(folder)),
        mapping=mapping,
        output=str(output),
        cache=str(cache),
        workers=1,
        accuracy_goal_cm=1e4,  # a coarse map is no word on its input
    )
    try:
        result = run(settings)
    except V2hdmError as error:
        return Outcome(_REFUSED, str(error), seconds=time.perf_counter() - begin_s)
    except Exception as error:  # what a benchmark of robustness is for
        return Outcome(_CRASHED, f"{type(error).__name__}: {error}", seconds=time.perf_counter() - begin_s)
    verdict = json.loads((result.folder / "metrics.json").read_text())["verdict"]
    rmse_m, false, markings = float("nan"), 0, 0
    if (result.folder / "map.geojson").is_file():
        mapped = read_geojson(result.folder / "map.geojson")
        true = read_geojson(good / "truth" / "map.geojson")
        nothing = np.zeros(len(true.markings), dtype=bool)
        figures = marking_metrics(mapped, _Truth(true), nothing)  # type: ignore[arg-type]
        rmse_m, false, markings = figures.corner_rmse_m, figures.false_markings, figures.markings
    return Outcome(
        verdict["status"],
        "",
        rmse_m,
        false,
        markings,
        verdict["findings"],
        verdict.get("unobservable", verdict.get("untold", [])),
        time.perf_counter() - begin_s,
    )


@dataclass(frozen=True)
class _Truth:
    """As much of a truth as the comparison of markings reads."""

    map: Any


def judge(drive: str, fault: Fault, outcome: Outcome, clean: Outcome) -> Row:
    """Hold the end of a run against the fault that was put in."""
    right = (
        outcome.status in ("PASS", "WARN", "FAIL")
        and outcome.rmse_m <= RIGHT_FACTOR * clean.rmse_m
        and outcome.false <= clean.false
        and outcome.markings >= 0.9 * clean.markings
    )
    said = [_clause(finding) for finding in outcome.findings] or [outcome.message]
    pattern = fault.cause
    is_raised = outcome.status in ("WARN", "FAIL", _REFUSED)
    hidden = fault.hidden_on_straight if "straight" in drive else None
    if hidden is not None and not is_raised:
        said = [_clause(clause) for clause in outcome.unobservable]
        is_raised, pattern = bool(said), hidden
    named = [pattern is None or re.search(pattern, clause, re.IGNORECASE) is not None for clause in said]
    return Row(drive, fault.name, outcome, right, is_raised, any(named), bool(named and named[0]))


def _clause(finding: dict[str, Any]) -> str:
    """The cause that a finding names; the recovery is left out, since it may speak of other causes."""
    return f"{finding['check']} {re.split('; |: (?:check|correct|see) ', finding['says'])[0]}"


def clean_fault() -> Fault:
    """Nothing wrong."""
    return Fault("nothing", None)


_Job = tuple[str, int, str, str]


def _start_worker() -> None:
    cv2.setNumThreads(1)
    torch.set_num_threads(1)


def _faults() -> list[Fault]:
    return [clean_fault(), *poses_faults(), *camera_faults()]


def _work(job: _Job) -> Outcome:
    drive, number, good, scratch = job
    fault = _faults()[number]
    folder = copy_of(Path(good), Path(scratch) / "drives" / f"{drive}-{number:02d}")
    fault.spoil(folder)
    return map_drive(folder, Path(scratch) / "outputs", fault.mapping(MappingOptions()), Path(good))


def measure(ports: Sequence[PortConfig], only: str, workers: int, cache: Path, scratch: Path) -> list[Row]:
    """Run all faults that match ``only`` on all drives; prints a row as each is finished."""
    faults, rows = _faults(), []
    fault_numbers = [k for k, fault in enumerate(faults) if k == 0 or re.search(only, fault.name)]
    jobs: list[_Job] = []
    for port in ports:
        with open_executor(workers) as executor:
            good = rendered_drive(port, cache, executor, lambda finished, total: None).resolve()
        jobs += [(f"{port.name}_{port.seed}", k, str(good), str(scratch.resolve())) for k in fault_numbers]
    pending, clean = iter(jobs), {}

    def take(outcome: Outcome) -> None:
        drive, number, _, _ = next(pending)
        clean.setdefault(drive, outcome)
        row = judge(drive, faults[number], outcome, clean[drive])
        rows.append(row)
        print(_line(row), flush=True)

    with open_executor(workers, isolated=True) as executor:
        executor.share_out(_work, jobs, _start_worker, (), take)
    return rows


def _line(row: Row) -> str:
    outcome = row.outcome
    mark = "SILENT" if row.silently_wrong else "right" if row.right else "told"
    name = "-" if row.right and outcome.status == "PASS" else "named" if row.named_first else "named later"
    name = name if row.named else "not named"
    first = outcome.message or "; ".join(f["check"] + ": " + f["says"] for f in outcome.findings[:1])
    return (
        f"{row.drive:18}| {row.fault:38}| {outcome.status:8}| {mark:7}| {name:12}| "
        f"{100 * outcome.rmse_m:6.1f} cm | {outcome.false:3d} false of {outcome.markings:3d} | "
        f"{outcome.seconds:4.0f} s | {first[:150]}"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--route", nargs="+", choices=list(ROUTES), default=list(ROUTES))
    parser.add_argument("--ports", nargs="+", choices=["port1", "port2"], default=["port2"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[41])
    parser.add_argument("--only", default="", help="pattern of the faults' names")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--cache", type=Path, default=Path("cache"))
    parser.add_argument("--scratch", type=Path, default=Path("cache/wrong_inputs"))
    parsed = parser.parse_args()
    ports = [
        port_of(port, route, seed) for port in parsed.ports for route in parsed.route for seed in parsed.seeds
    ]
    rows = measure(ports, parsed.only, parsed.workers, parsed.cache, parsed.scratch)
    faults = [row for row in rows if row.fault != clean_fault().name]
    wanting = [row for row in faults if not (row.right and row.outcome.status == "PASS")]
    named = sum(row.named for row in wanting)
    first = sum(row.named_first for row in wanting)
    print(
        f"\n{len(faults)} runs: silently wrong {sum(row.silently_wrong for row in faults)}, "
        f"crashed {sum(row.outcome.status == _CRASHED for row in faults)}, "
        f"right {sum(row.right for row in faults)}, told {sum(row.told for row in faults)}; "
        f"of {len(wanting)} that are not silently right the cause is named in {named}, first in {first}"
    )


if __name__ == "__main__":
    main()

"""Drives made without pictures: are right ones passed, spoilt ones named, and are the stated sigmas right?

``python -m tests.benchmarks.right_drives [--seeds 0 200] [--spoil KIND ...] [--only PATTERN] [--workers 2]
[--out FILE]`` draws right drives (:mod:`tests.benchmarks.made`): a port's paint, a straight, bent or turning
route, errors of the poses, of the road and of the detector, stated as they are or left to the default. The
detections are the true corners, projected, with these errors. Each drive goes through the checks of its poses
and cameras, through the mapping, and through the verdict, as the product does from detections on; only what
looks at pixels (bare ground, exposure) is left out. It prints a line a drive; how many right drives fail; of
the score tests by kind, how well their p-values are uniform (Kolmogorov-Smirnov); and the share of errors
inside the 95 % regions. ``--spoil`` maps each drive with each of these faults as well (``all``, or names of
:data:`tests.benchmarks.made.faults.SPOILS`). ``--control`` states all errors as they are and draws none of
another kind: what is not uniform there is a mistake of this benchmark or of the mathematics. ``--read-out S``
has the images recorded by rolling shutters, whose read-out time is stated or, with ``--estimate``, estimated.
In a third of the drives the cameras fire in turn, between poses of a stream at 20 Hz; with ``--in-turn`` in
all of them. ``--stated`` states the noise of poses and clocks as it is, ``--camera NAME`` maps
with one alone.

Of a spoilt drive, what is said counts if it names the cause, or is not said of the drive as it was. No drive
states how well its clocks are synchronised.

- *wrong*: its corners are more than 1.3 times as far off as those of the drive as it was
- *told*: something is raised
- *usual*: of these, nothing but what is raised of the drive as it was, too; it names the cause
- *relied*: nothing is, but the input is named as one that the drive cannot check
- *SILENT*: wrong, and neither told nor relied
- *held*: of these, how many have at least 90 % of their corners inside their 95 % regions
- *inside*: the share of all corners of these drives inside their 95 % regions
"""

from __future__ import annotations

import argparse
import json
import re
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.stats import chi2, kstest

from tests.benchmarks.made.detect import detect
from tests.benchmarks.made.draw import ROUTES, Recipe, draw, draw_apart_s
from tests.benchmarks.made.faults import APART_S, RELIEFS, SPOILS, Spoil
from tests.benchmarks.made.world import World, drive_of, make, truth_of
from tests.benchmarks.uncertainty import QUANTITIES, squared_errors
from tests.benchmarks.wrong_inputs import RIGHT_FACTOR
from v2hdm.errors import V2hdmError
from v2hdm.executor import open_executor
from v2hdm.faults.odds import doubt, log_odds, matters
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.options import AUTO, GROUNDS, MappingOptions
from v2hdm.mapping.results import MethodResult
from v2hdm.records import BEST, Drive, FloatArray, HDMap
from v2hdm.report.metrics import driven_past, marking_metrics
from v2hdm.verdict import Finding, Verdict
from v2hdm.verdict.inputs.alignment import check_alignment
from v2hdm.verdict.inputs.drive import causes, check_camera, check_road
from v2hdm.verdict.inputs.heading import check_heading
from v2hdm.verdict.inputs.poses import Motion, check_attitude, check_jumps, check_noise, check_path
from v2hdm.verdict.inputs.recording import check_clocks
from v2hdm.verdict.results.accuracy import check_goal, told_once
from v2hdm.verdict.results.solution import check_solution, over_ground, told_by_poses
from v2hdm.verdict.verdict import GOAL

CLEAN = "nothing"
_INSIDE = float(chi2.ppf(0.95, 1))
_MOUNTING = ("height", "roll", "pitch", "yaw")
_PAIRED_M = 0.3  # of a corner and its true one, apart, at most
_GOAL_M = 0.05  # as accuracy_goal_cm is by default
_HELD = 0.9  # least share of corners inside their 95 % regions of a map whose stated sigmas hold
_LEVEL = 0.01  # of the tests whether p-values are uniform
_REFUSED, _CRASHED = "refused", "CRASHED"


@dataclass(frozen=True)
class Row:
    """The outcome of one drive.

    ``tests`` are the score tests: kind, p-value, value, sigma. ``errors`` are squared, in sigmas, by
    quantity. ``height_rmse_m`` is of the corners' heights, ``height_scatter_m`` the same about their mean.
    ``seconds`` are of the CPU.
    """

    seed: int
    route: str
    name: str
    spoil: str
    default_noise: bool
    road: bool
    status: str
    findings: list[dict[str, Any]] = field(default_factory=list)
    unobservable: list[dict[str, Any]] = field(default_factory=list)
    rmse_m: float = float("nan")
    height_rmse_m: float = float("nan")
    height_scatter_m: float = float("nan")
    recall: float = float("nan")
    false: int = 0
    markings: int = 0
    tests: list[dict[str, Any]] = field(default_factory=list)
    errors: dict[str, list[float]] = field(default_factory=dict)
    drawn: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0

    @property
    def first(self) -> str:
        """The first finding."""
        return _sentence(self.findings[0]) if self.findings else "-"


@dataclass(frozen=True)
class Job:
    """One drive to map.

    Attributes:
        seed: of all that is drawn.
        route: one of :data:`ROUTES`; None draws one.
        spoil: name of the fault.
        ground: as ``mapping.ground``.
        control: whether errors are of the kind and the size that the product reckons with.
        read_out_s: of the cameras; stated, unless it is to be estimated.
        estimate: whether the mapping estimates it.
        apart_s: time after each other at which the cameras fire in turn, under a stream of poses; or at once.
        stated: whether the noise of the poses is stated as it is, if that was not drawn.
        camera: to map with it alone; if empty, with all together.
    """

    seed: int
    route: str | None = None
    spoil: str = CLEAN
    control: bool = False
    read_out_s: float = 0.0
    estimate: bool = False
    ground: str = AUTO
    apart_s: float = 0.0
    stated: bool = False
    camera: str = ""

    @property
    def recipe(self) -> Recipe:
        """The recipe that is drawn for it."""
        drawn = draw(self.seed, self.route)
        if self.apart_s:
            drawn = drawn.in_turn(self.apart_s)
        if self.stated:
            drawn = drawn.with_noise_stated()
        return drawn.as_modelled() if self.control else drawn


def map_one(job: Job) -> Row:
    """Make, map and judge one drive."""
    recipe = job.recipe
    world = make(recipe)
    if job.spoil != CLEAN:
        world = (SPOILS | RELIEFS)[job.spoil].change(world)
    if job.read_out_s:
        world = world.rolling(job.read_out_s, stated=not job.estimate)
    drive = drive_of(world)
    detections, visibility = detect(world, drive)
    truth = truth_of(world, drive, visibility)
    about: dict[str, Any] = {
        "seed": job.seed, "route": recipe.route, "name": recipe.port.name, "spoil": job.spoil,
        "default_noise": recipe.default_noise, "road": recipe.road is not None,
        "drawn": recipe.as_figures(),
    }  # fmt: skip
    begin_s = time.process_time()
    cameras = (job.camera,) if job.camera else tuple(drive.cameras)
    try:
        options = MappingOptions(ground=job.ground, estimate_read_out=job.estimate)
        best = run_methods(drive, detections, cameras, options, naive=False)[BEST]
        before = over_ground(findings_of_inputs(drive), best, job.ground == AUTO)
        solved, of_goal = told_once(told_by_poses(check_solution(drive, best), before), unknown(best))
        findings = [*before, *solved, *of_goal]
    except V2hdmError as error:
        refusal = {"check": _REFUSED, "says": str(error), "status": _REFUSED}
        return Row(**about, status=_REFUSED, findings=[refusal], seconds=time.process_time() - begin_s)
    except Exception as error:  # what a benchmark of robustness is for
        crash = {"check": _CRASHED, "says": f"{type(error).__name__}: {error}", "status": _CRASHED}
        return Row(**about, status=_CRASHED, findings=[crash], seconds=time.process_time() - begin_s)
    seconds = time.process_time() - begin_s
    verdict = Verdict.of(findings)
    expected = driven_past(drive, truth, tuple(drive.cameras))
    figures = marking_metrics(best.hd_map, truth, expected)
    errors = squared_errors(best, truth) if figures.markings > figures.false_markings else {}
    height_off_m, height_sigma_m = height_errors_m(world, best.hd_map)
    errors["heights"] = np.square(height_off_m / height_sigma_m)
    assert best.evidence is not None
    about["drawn"] |= {f"read_out_s {name}": read_out for name, read_out in best.evidence.read_out_s.items()}
    return Row(
        **about,
        status=verdict.status.value,
        findings=[finding.as_json() for finding in verdict.raised],
        unobservable=[finding.as_json() for finding in verdict.unobservable],
        rmse_m=figures.corner_rmse_m,
        height_rmse_m=float(np.sqrt(np.mean(height_off_m**2))) if len(height_off_m) else float("nan"),
        height_scatter_m=float(np.std(height_off_m)) if len(height_off_m) else float("nan"),
        recall=figures.recall,
        false=figures.false_markings,
        markings=figures.markings,
        tests=[_test(test) for test in (*best.evidence.corrected, *best.evidence.score_tests)],
        errors={name: np.round(values, 3).tolist() for name, values in errors.items()},
        seconds=seconds,
    )


def unknown(best: MethodResult) -> list[Finding]:
    """Inputs that are unknown by more than the goal, which most made drives miss by their poses anyway."""
    return [finding for finding in check_goal(best, _GOAL_M, "poses") if finding.check != GOAL]


def height_errors_m(world: World, hd_map: HDMap) -> tuple[FloatArray, FloatArray]:
    """The errors of the corners' heights, by the nearest true corner, and their sigmas; none are not told."""
    true, with_height = (
        world.corners_map.reshape(-1, 3),
        [m for m in hd_map.markings if m.heights_sigma_m is not None],
    )
    if not with_height:
        return np.zeros(0), np.zeros(0)
    corners = np.concatenate([marking.corners_map for marking in with_height])
    heights, sigmas = (
        np.concatenate([getattr(marking, name) for marking in with_height])
        for name in ("heights_m", "heights_sigma_m")
    )
    away_m, nearest = cKDTree(true[:, :2]).query(corners)
    is_paired = away_m < _PAIRED_M
    return (heights - true[nearest, 2])[is_paired], sigmas[is_paired]


def findings_of_inputs(drive: Drive) -> list[Finding]:
    """The findings before the mapping, as far as they look at no picture."""
    motion = Motion.of(drive)
    findings = [
        *check_path(motion),
        *check_heading(motion),
        *check_alignment(motion, drive.pose_noise, drive.cameras),
        *check_attitude(motion),
        *check_jumps(motion, drive.pose_noise),
        *check_clocks(drive, motion),
        *check_noise(motion, drive.pose_noise),
        *check_road(drive),
    ]
    for name, camera in drive.cameras.items():
        findings += check_camera(name, camera)
    return causes(findings)


def _test(test: Any) -> dict[str, Any]:
    """A score test for the record; its p-value is its own where it has one, else that of its chi-square."""
    p_value = getattr(test, "p_value", None)
    whose = "each" if len(test.cameras) == 1 else "all"
    return {
        "kind": f"{test.fault.name} {test.axis} {whose}",
        "cameras": list(test.cameras),
        "p": float(chi2.sf(test.sigmas**2, 1)) if p_value is None else float(p_value),
        "value": test.value,
        "sigma": test.sigma,
        "log_odds": log_odds(test),
        "doubt": doubt(test),
        "matters": matters(test),
    }


def _sentence(finding: dict[str, Any]) -> str:
    return f"{finding['check']}: {finding['says']}"


def _clause(finding: dict[str, Any]) -> str:
    """A finding's name and cause, without the recovery, which may speak of other causes."""
    return f"{finding['check']} {finding['says'].split(': ')[0]}"


def line(row: Row, clean: Row | None) -> str:
    """A drive as it is printed, against itself without the fault."""
    shares = shares_inside([row])
    quantities = ("corners", "sides", "distances", "mountings", "heights")
    inside = " ".join(f"{shares[name]:.2f}" for name in quantities)
    mark = ""
    if clean is not None:
        mark = f"{judge(row, clean).word:19}| "
    noise = ("default" if row.default_noise else "stated") + (", road" if row.road else "")
    return (
        f"{row.seed:5d} {row.name} {row.route:8}| {noise:13} | {row.spoil:16}| {row.status:7}| {mark}"
        f"{100 * row.rmse_m:6.2f} cm, heights {100 * row.height_rmse_m:3.1f} "
        f"({100 * row.height_scatter_m:3.1f}) | "
        f"recall {row.recall:.2f}, {row.false} false of {row.markings:3d} | "
        f"inside {inside} | {row.seconds:4.1f} s | {row.first[:110]}{_read_outs(row)}"
    )


def _read_outs(row: Row) -> str:
    """The estimated read-out times, if there are any."""
    read_outs = {
        key.split()[1]: read_out for key, read_out in row.drawn.items() if key.startswith("read_out_s ")
    }
    return "".join(
        f" | {name} {1e3 * read_out[0]:.2f} +- {1e3 * read_out[1]:.2f} ms"
        for name, read_out in read_outs.items()
    )


class Judgement(NamedTuple):
    """The judgement of a spoilt map for its user, as the docstring of this file defines it."""

    wrong: bool
    told: bool
    relied: bool
    held: bool  # whether its stated sigmas hold
    usual: bool  # whether all that is told is told of the drive as it was, too
    named: str  # when the cause is named, of what is said: first, later or never; "-" where nothing is

    @property
    def silent(self) -> bool:
        """Whether it is wrong, and nothing is said."""
        return self.wrong and not self.told and not self.relied

    @property
    def word(self) -> str:
        """For the line of the drive."""
        said = "told" if self.told else "relied" if self.relied else "SILENT" if self.wrong else "pass"
        return f"{'wrong' if self.wrong else 'right'} {said} {self.named}"


def judge(row: Row, clean: Row) -> Judgement:
    """Judge a spoilt drive beside the ``clean`` one."""
    spoil = (SPOILS | RELIEFS)[row.spoil]
    wrong = not row.rmse_m <= RIGHT_FACTOR * clean.rmse_m
    said = _said(row.findings, clean.findings, spoil.cause)
    relied = []
    if row.route == "straight" and spoil.hidden is not None:
        relied = _said(row.unobservable, clean.unobservable, spoil.hidden)
        relied = [clause for clause in relied if re.search(spoil.hidden, clause, re.IGNORECASE)]
    named = "-"
    if spoil.cause is not None and said:
        hits = [re.search(spoil.cause, clause, re.IGNORECASE) is not None for clause in said]
        named = "first" if hits[0] else "later" if any(hits) else "never"
    held = shares_inside([row])["corners"] >= _HELD
    usual = bool(said) and not _said(row.findings, clean.findings, None)
    return Judgement(wrong, bool(said), bool(relied), held, usual, named)


def _said(
    findings: Sequence[dict[str, Any]], of_clean: Sequence[dict[str, Any]], cause: str | None
) -> list[str]:
    """Clauses of findings, without those that the clean drive has as well and that are not the cause."""
    usual = {(finding["check"], finding["status"], finding.get("about")) for finding in of_clean}
    clauses = [(finding, _clause(finding)) for finding in findings]
    return [
        clause
        for finding, clause in clauses
        if (finding["check"], finding["status"], finding.get("about")) not in usual
        or (cause is not None and re.search(cause, clause, re.IGNORECASE))
    ]


def shares_inside(rows: Iterable[Row]) -> dict[str, float]:
    """By quantity, the share of errors inside the 95 % region."""
    quantities = {name: (name,) for name in (*QUANTITIES, "heights")} | {"mountings": _MOUNTING}
    out = {}
    for name, parts in quantities.items():
        errors = np.concatenate([[], *(row.errors.get(part, []) for row in rows for part in parts)])
        out[name] = float(np.mean(errors <= _INSIDE)) if len(errors) else float("nan")
    return out


def summary_of_right(rows: Sequence[Row]) -> list[str]:
    """Failed drives, whether p-values are uniform, and coverage, of drives without a fault."""
    status = Counter(row.status for row in rows)
    lines = [f"right drives: {len(rows)}, " + ", ".join(f"{count} {name}" for name, count in status.items())]
    lines += [
        f"  {row.status} {row.seed} ({row.name} {row.route}, {100 * row.rmse_m:.1f} cm): {row.first}"
        for row in rows
        if row.status != "PASS"
    ]
    said = Counter(finding["check"] for row in rows for finding in row.findings)
    lines.append(
        "raised: " + (", ".join(f"{check} {count}" for check, count in said.most_common()) or "nothing")
    )
    by_kind: dict[str, list[float]] = {}
    for row in rows:
        for test in row.tests:
            if np.isfinite(test["sigma"]):
                by_kind.setdefault(test["kind"], []).append(test["p"])
    lines.append(f"{'score test':22s}{'tests':>6s}{'KS p':>10s}{'least p':>10s}{'p < .05':>9s}")
    for kind, p in sorted(by_kind.items()):
        uniform = float(kstest(p, "uniform").pvalue)
        mark = "" if uniform >= _LEVEL else "  not uniform"
        lines.append(
            f"{kind:22s}{len(p):6d}{uniform:10.2g}{min(p):10.1g}{np.mean(np.array(p) < 0.05):9.2f}{mark}"
        )
    lines.append(
        f"{'inside 95 %':22s}" + " ".join(f"{name:>9s}" for name in (*QUANTITIES, "heights", "mountings"))
    )
    for name, errors in (
        ("noise stated", [row for row in rows if not row.default_noise]),
        ("noise by default", [row for row in rows if row.default_noise]),
        ("attitude recorded", [row for row in rows if row.road]),
        ("all", rows),
    ):
        lines.append(f"{name:22s}" + " ".join(f"{share:9.3f}" for share in shares_inside(errors).values()))
    rmse = np.array([row.rmse_m for row in rows])
    lines.append(
        f"corner RMSE, median {100 * np.nanmedian(rmse):.2f} cm, recall "
        f"{np.nanmean([r.recall for r in rows]):.3f}, {np.mean([row.seconds for row in rows]):.1f} s a drive"
    )
    return lines


def summary_of_spoilt(rows: Sequence[Row], clean: dict[int, Row]) -> list[str]:
    """By fault, how many maps are wrong, silently, and when the true cause is named."""
    columns = ("drives", "wrong", "SILENT", "held", "relied", "told", "usual", "first", "later", "never")
    lines = [f"{'fault':18s}" + "".join(f"{column:>7s}" for column in (*columns, "inside"))]
    totals: Counter[str] = Counter()
    for spoil in dict.fromkeys(row.spoil for row in rows):
        of_spoil = [row for row in rows if row.spoil == spoil]
        counts = _counts([judge(row, clean[row.seed]) for row in of_spoil])
        totals.update(counts)
        inside = f"{shares_inside(of_spoil)['corners']:7.2f}"
        lines.append(f"{spoil:18s}" + "".join(f"{counts[column]:7d}" for column in columns) + inside)
        said = Counter(finding["check"] for row in of_spoil for finding in row.findings)
        checks = ", ".join(f"{check} {count}" for check, count in said.most_common())
        lines.append(f"    {checks or 'nothing'}")
    lines.append(f"{'all':18s}" + "".join(f"{totals[column]:7d}" for column in columns))
    lines.append(f"SILENT {totals['SILENT']}, of them inside their stated sigmas {totals['held']}")
    named = sum(totals[column] for column in ("first", "later", "never"))
    lines.append(f"cause first in {totals['first']} of {named} of which something is told")
    return lines


def _counts(judged: Sequence[Judgement]) -> Counter[str]:
    """The columns of the table of spoilt drives."""
    counts = Counter(judgement.named for judgement in judged)
    counts["drives"] = len(judged)
    counts["wrong"] = sum(judgement.wrong for judgement in judged)
    counts["SILENT"] = sum(judgement.silent for judgement in judged)
    counts["held"] = sum(judgement.silent and judgement.held for judgement in judged)
    counts["relied"] = sum(j.wrong and j.relied and not j.told for j in judged)
    counts["told"] = sum(judgement.told for judgement in judged)
    counts["usual"] = sum(judgement.usual for judgement in judged)
    return counts


def _start_worker() -> None:
    cv2.setNumThreads(1)
    torch.set_num_threads(1)


def measure(jobs: Sequence[Job], workers: int, verbose: bool) -> list[Row]:
    """Map all drives; prints a line as each is finished. A clean drive comes before its spoilt ones."""
    rows: list[Row] = []
    clean: dict[int, Row] = {}

    def take(row: Row) -> None:
        rows.append(row)
        if row.spoil == CLEAN:
            clean[row.seed] = row
        print(line(row, None if row.spoil == CLEAN else clean[row.seed]), flush=True)
        if verbose:
            for finding in row.findings:
                print(f"        {finding['status']} {_sentence(finding)}", flush=True)

    if workers == 1:
        _start_worker()
        for job in jobs:
            take(map_one(job))
    else:
        with open_executor(workers) as executor:
            executor.share_out(map_one, jobs, _start_worker, (), take)
    return rows


def wanted_spoils(names: Sequence[str]) -> list[Spoil]:
    """The faults of these names, all for ``all``."""
    return list(SPOILS.values()) if "all" in names else [(SPOILS | RELIEFS)[name] for name in names]


def main() -> None:
    """Print the lines and the summary."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument(
        "--seeds", nargs=2, type=int, default=[0, 200], help="the first, and the one after the last"
    )
    parser.add_argument("--route", choices=ROUTES, help="instead of a drawn one")
    parser.add_argument("--spoil", nargs="+", default=[], choices=["all", *SPOILS, *RELIEFS], metavar="KIND")
    parser.add_argument("--only", default="", help="pattern of 'port route seed' of the drives to map")
    parser.add_argument(
        "--control", action="store_true", help="draw no errors but those that the product reckons with"
    )
    parser.add_argument("--read-out", type=float, default=0.0, help="of rolling shutters, s")
    parser.add_argument("--estimate", action="store_true", help="do not state it, estimate it")
    parser.add_argument("--in-turn", action="store_true", help="have the cameras fire in turn in all drives")
    parser.add_argument("--stated", action="store_true", help="state the noise of the poses as it is")
    parser.add_argument("--camera", default="", help="map with this one alone")
    parser.add_argument("--ground", choices=GROUNDS, default=AUTO, help="as mapping.ground")
    parser.add_argument("--verbose", action="store_true", help="print all findings")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("outputs/right_drives.json"))
    parsed = parser.parse_args()
    seeds = [s for s in range(*parsed.seeds) if re.search(parsed.only, Job(s, parsed.route).recipe.name)]
    kinds = [CLEAN, *(spoil.name for spoil in wanted_spoils(parsed.spoil))]
    settings = parsed.control, parsed.read_out, parsed.estimate, parsed.ground
    apart_s = {seed: APART_S if parsed.in_turn else draw_apart_s(seed) for seed in seeds}
    stated_settings = parsed.stated, parsed.camera
    jobs = [
        Job(seed, parsed.route, kind, *settings, apart_s[seed], *stated_settings)
        for seed in seeds
        for kind in kinds
    ]
    rows = measure(jobs, parsed.workers, parsed.verbose or bool(parsed.spoil))
    parsed.out.parent.mkdir(parents=True, exist_ok=True)
    parsed.out.write_text(json.dumps([asdict(row) for row in rows]))
    right = [row for row in rows if row.spoil == CLEAN]
    print("\n" + "\n".join(summary_of_right(right)))
    if parsed.spoil:
        spoilt = [row for row in rows if row.spoil != CLEAN]
        print("\n" + "\n".join(summary_of_spoilt(spoilt, {row.seed: row for row in right})))


if __name__ == "__main__":
    main()

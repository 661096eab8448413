"""What each part of the detector of markings earns: switched off one at a time on scenes of unseen seeds.

    python -m tests.benchmarks.ablation [--images 60] [--only PATTERN] [--verdict FIRST LAST]

Printed, for the detector as it is and without each part: recall within 20 m of markings that must be found,
false ones, the share of markings with four corners known well, the corners' error, px, and whether the stated
covariance holds (inner-95 mean of the normalised squared error; honest 1.60). A part that earns nothing
leaves.

With ``--verdict`` instead what each column of the table of the sizes of faults (mapping/recovery.py) and each
number of mapping/foreign.py earns, on made drives of these seeds, as they are and with every fault: right
drives failed, wrong maps without a word, and of those with one how many are named rightly, first.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np

from tests.benchmarks.detector_quality import Tally
from tests.benchmarks.made.faults import SPOILS
from tests.benchmarks.right_drives import CLEAN, Job, judge, map_one
from train.examples import Example, example
from v2hdm.detection import classifier as find
from v2hdm.detection import fit, lattice, propose
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.mapping import foreign, recovery
from v2hdm.records import FloatArray
from v2hdm.verdict.results import solution

SEED = 5_318_008
"""No seed of training, of the judge's fit or of the quality benchmark."""

Part = tuple[str, Callable[[], AbstractContextManager[Any]]]


def parts() -> Iterator[Part]:
    """Each part's name, and within which context it is off."""
    yield "nothing off", lambda: patch.object(fit, "KNOTS", fit.KNOTS)
    yield "search on the coarse grid", _without_search
    yield "the network's paint in the search", _without_paint
    yield "parallelograms on the ground", lambda: patch.object(fit, "_CLOSURE_SHARE", 100.0)
    yield "red and blue beside grey", lambda: patch.object(lattice, "_GREY_FIRST", 1e6)
    yield "light that changes along", lambda: patch.object(fit, "_LIGHT_STEP", 1e-3)
    yield "a variance for each side", lambda: patch.object(fit, "_SHARED_PIXELS", 1e6)
    yield "the way from wide to narrow scatter", _with_narrow_scatter
    yield "the start within clipped paint", lambda: patch.object(fit, "_BLOOM", 0.0)
    yield "the floor of a side's error", lambda: patch.object(fit, "_MODEL_SIGMA_PX", 0.0)
    yield "the judge's doubt of sides", _without_side_doubt
    yield "the others of the image", _without_context
    yield "size in the odds of classes", _without_sizes
    yield "parts beside whole pieces", _without_parts


@contextmanager
def _without_search() -> Iterator[None]:
    settle = fit._State.settle

    def unless_searching(state: Any, seen: Any, steps: int, paint: Any = None) -> Any:
        return settle(state, seen, steps) if paint is None else None

    with patch.object(fit._State, "settle", unless_searching):
        yield


@contextmanager
def _without_paint() -> Iterator[None]:
    with patch.object(fit, "_add_paint", _nothing):
        yield


@contextmanager
def _with_narrow_scatter() -> Iterator[None]:
    with patch.object(fit, "_WIDE_SCATTER", 0.0), patch.object(fit, "_FINAL_SCATTER", 0.0):
        yield


@contextmanager
def _without_side_doubt() -> Iterator[None]:
    classify_alone = find.classify_alone

    def sure(*given: Any) -> tuple[FloatArray, FloatArray]:
        odds, sigma_px = classify_alone(*given)
        return odds, 0 * sigma_px

    with patch.object(find, "classify_alone", sure):
        yield


@contextmanager
def _without_context() -> Iterator[None]:
    def alone(odds: FloatArray, *_: Any) -> FloatArray:
        return np.asarray(1 / (1 + np.exp(-odds)))

    with patch.object(find, "classify_among", alone):
        yield


@contextmanager
def _without_sizes() -> Iterator[None]:
    shares = propose._shares

    def by_network(
        blob: Any, length_m: float, width_m: float, catalogue: Any, *, whole: bool
    ) -> dict[str, float]:
        return shares(blob, float("nan"), float("nan"), catalogue, whole=whole)

    with patch.object(propose, "_shares", by_network):
        yield


@contextmanager
def _without_parts() -> Iterator[None]:
    with patch("v2hdm.detection.propose._split", lambda *_: []):
        yield


def _nothing(*_: Any) -> None:
    return None


def row(name: str, shown: Sequence[Example]) -> str:
    """One line of the table."""
    detector = Detector.load(options=DetectorOptions(max_range_m=24.0))
    tally = Tally()
    known = []
    for one in shown:
        markings, _ = detector.detect(one.image, one.camera)
        tally.add_markings(one.markings, markings)
        known += [bool(marking.corner_valid.all()) for marking in markings if not len(marking.outline_px)]
    error = np.linalg.norm(np.array(tally.corner_error_px).reshape(-1, 2), axis=1)
    square = np.sort(tally.normalised)[: int(0.95 * len(error))]
    recall = sum(tally.found.values()) / max(sum(tally.fair.values()), 1)
    return (
        f"{name:38s} {recall:7.3f} {tally.false:6d} {np.mean(known):10.3f} {np.median(error):8.3f} "
        f"{np.quantile(error, 0.95):8.3f} {square.mean():8.2f}"
    )


def sizes() -> Iterator[Part]:
    """Each column of the table of sizes, each number of the foreign images, and the context that lacks it."""
    yield "nothing off", nullcontext
    for column, nothing in (("least", 0.0), ("sigma", np.inf), ("usual", np.inf), ("most", np.inf)):
        flat = {fault: replace(size, **{column: nothing}) for fault, size in recovery._SIZES.items()}
        yield f"{column} size of each fault", partial(patch.object, recovery, "_SIZES", flat)
    yield "foreign: views that share counts for", partial(patch.object, foreign, "_PSEUDO_VIEWS", 100.0)
    yield "foreign: markings taken by mistake", partial(patch.object, foreign, "_BY_MISTAKE", 1e-6)
    yield "foreign: mixtures of two markings", partial(patch.object, foreign, "_CONFUSED", 1e-6)
    yield "foreign: misses weighed by distance", partial(patch.object, foreign, "_DISTANCES", 1)
    yield "jitter that does not matter", partial(patch.object, solution, "_LEAST_JITTER_S", 0.0)


def row_of_verdict(name: str, seeds: Sequence[int]) -> str:
    """One line of the table of the verdict."""
    failed, judged = 0, []
    for seed in seeds:
        clean = map_one(Job(seed))
        failed += clean.status == "FAIL"
        judged += [judge(map_one(Job(seed, spoil=spoil)), clean) for spoil in SPOILS if spoil != CLEAN]
    silent = sum(wrong and not told for wrong, told, _ in judged)
    told = [when for _, told, when in judged if told]
    return f"{name:38s} {failed:7d} {silent:7d} {len(told):7d} {told.count('first'):7d}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--images", type=int, default=60)
    parser.add_argument("--only", default="")
    parser.add_argument("--verdict", nargs=2, type=int, metavar=("FIRST", "LAST"))
    parsed = parser.parse_args()
    cv2.setNumThreads(1)
    if parsed.verdict:
        print(f"{'off':38s} {'failed':>7s} {'silent':>7s} {'told':>7s} {'first':>7s}")
        for name, off in sizes():
            if re.search(parsed.only, name):
                with off():
                    print(row_of_verdict(name, range(*parsed.verdict)), flush=True)
        return
    shown = [example(index, 1.0, SEED) for index in range(parsed.images)]
    head = ("recall", "false", "all four", "median", "95 %", "squared")
    print(f"{'off':38s} {head[0]:>7s} {head[1]:>6s} {head[2]:>10s} {head[3]:>8s} {head[4]:>8s} {head[5]:>8s}")
    for name, off in parts():
        if re.search(parsed.only, name) or name == "nothing off":
            with off():
                print(row(name, shown), flush=True)


if __name__ == "__main__":
    main()

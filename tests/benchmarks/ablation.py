"""The worth of each part of the detector of markings, switched off one at a time on scenes of unseen seeds.

    python -m tests.benchmarks.ablation [--images 60] [--only PATTERN] [--verdict FIRST LAST]
                                        [--faults NAME ...] [--site FIRST LAST] [--drives FOLDER ...]
                                        [--short FIRST LAST]

Printed, for the detector as it is and without each part: recall within 20 m of markings that must be found,
false ones, the share of markings with four corners known well, the corners' error, px, and whether the stated
covariance holds (inner-95 mean of the normalised squared error; honest 1.60). A part that earns nothing
leaves.

With ``--verdict`` instead what each column of the table of fault sizes (faults/table.py), each number of
mapping/foreign.py, the priors of clocks and parts of the tests earn, on made drives of these seeds, as they
are and with every fault, or those of these names: right drives failed, wrong maps without a word, of those
with one how many are named rightly, first, and the share of the corners of all spoilt maps inside their 95 %
regions. To the right drives belongs each as a straight one under a stream of poses, whose cameras fire in
turn.

With ``--short`` what holds the mounting on short made drives past running boards (made/boards.py): how far
the normal of the ground and the height are off, root mean square, their squared error in stated sigmas (of
three; honest 3), markings that are mapped, false ones among them, and right drives failed.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import cv2
import numpy as np

from tests.benchmarks.detector_quality import Tally
from tests.benchmarks.made.boards import CAMERA, make_short
from tests.benchmarks.made.boxes import detect_pieces, make_boxes
from tests.benchmarks.made.detect import detect
from tests.benchmarks.made.draw import draw
from tests.benchmarks.made.faults import APART_S, SPOILS
from tests.benchmarks.made.lengths import make_lengths
from tests.benchmarks.made.queue import detect_queue, make_queue
from tests.benchmarks.made.world import World, drive_of, make, truth_of
from tests.benchmarks.right_drives import Job, judge, map_one, shares_inside
from tests.benchmarks.standing_ends import grey_of
from tests.benchmarks.uncertainty import corner_errors, in_order_of
from train.examples import Example, example
from v2hdm.association import ground
from v2hdm.detection import classifier as find
from v2hdm.detection.batch import detect_all
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.quads import fit, lattice, propose, robust, state
from v2hdm.faults import FAULTS, columns, ground_columns
from v2hdm.faults.sensitivity import Sensitivity
from v2hdm.geometry.ground_plane import by_tangent, plane_in
from v2hdm.geometry.rigid import inverse, log
from v2hdm.ground import planes
from v2hdm.io.drive import read_drive
from v2hdm.io.drive.truth import read_truth
from v2hdm.mapping import bundle, conclusion, foreign, optimise, recovery
from v2hdm.mapping.methods import run_methods
from v2hdm.pipeline.base import grey_reader
from v2hdm.records import (
    BEST,
    BoolArray,
    Drive,
    FloatArray,
    Image,
    ImageDetections,
    IntArray,
    Marking,
    Truth,
    poses,
)
from v2hdm.report.metrics import driven_past, marking_metrics, match_markings
from v2hdm.site import hypotheses, markings, parallax, posterior, standing, symbols
from v2hdm.verdict.inputs import alignment
from v2hdm.verdict.results import accuracy, solution
from v2hdm.verdict.verdict import Status

SEED = 5_318_008
"""No seed of training, of the judge's fit or of the quality benchmark."""

WRONG_M, WRONG_SIGMAS = 0.08, 4.0

_MOST_ENDS = 0.75  # share of the images that know an end behind a box to be hidden

Part = tuple[str, Callable[[], AbstractContextManager[Any]]]


def parts() -> Iterator[Part]:
    """Each part's name, and within which context it is off."""
    yield "nothing off", lambda: patch.object(state, "KNOTS", state.KNOTS)
    yield "search on the coarse grid", _without_search
    yield "the network's paint in the search", _without_paint
    yield "parallelograms on the ground", lambda: patch.object(state, "_CLOSURE_SHARE", 100.0)
    yield "red and blue beside grey", lambda: patch.object(lattice, "_GREY_FIRST", 1e6)
    yield "light that changes along", lambda: patch.object(state, "_LIGHT_STEP", 1e-3)
    yield "a variance for each side", lambda: patch.object(robust, "_SHARED_PIXELS", 1e6)
    yield "the way from wide to narrow scatter", _with_narrow_scatter
    yield "the start within clipped paint", lambda: patch.object(fit, "_BLOOM", 0.0)
    yield "the floor of a side's error", lambda: patch.object(fit, "_MODEL_SIGMA_PX", 0.0)
    yield "the judge's doubt of sides", _without_side_doubt
    yield "the others of the image", _without_context
    yield "size in the odds of classes", _without_sizes
    yield "parts beside whole pieces", _without_parts


@contextmanager
def _without_search() -> Iterator[None]:
    settle = state.State.settle

    def unless_searching(unknowns: Any, lattice: Any, steps: int, paint: Any = None) -> Any:
        return settle(unknowns, lattice, steps) if paint is None else None

    with patch.object(state.State, "settle", unless_searching):
        yield


@contextmanager
def _without_paint() -> Iterator[None]:
    with patch.object(state, "add_paint", _nothing):
        yield


@contextmanager
def _with_narrow_scatter() -> Iterator[None]:
    with patch.object(state, "_WIDE_SCATTER", 0.0), patch.object(state, "_FINAL_SCATTER", 0.0):
        yield


@contextmanager
def _without_side_doubt() -> Iterator[None]:
    classify_alone = find.classify_alone

    def sure(*features: Any) -> tuple[FloatArray, FloatArray]:
        odds, sigma_px = classify_alone(*features)
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
    with patch("v2hdm.detection.quads.blobs._split", lambda *_: []):
        yield


def _nothing(*_: Any) -> None:
    return None


def row(name: str, shown: Sequence[Example]) -> str:
    """One line of the table."""
    detector = Detector.load(options=DetectorOptions(max_range_m=24.0))
    tally = Tally()
    has_all_corners = []
    for picture in shown:
        markings, _ = detector.detect(picture.image, picture.camera)
        tally.add_markings(picture.markings, markings)
        has_all_corners += [
            bool(marking.corner_valid.all()) for marking in markings if not len(marking.outline_px)
        ]
    error = np.linalg.norm(np.array(tally.corner_error_px).reshape(-1, 2), axis=1)
    square = np.sort(tally.normalised)[: int(0.95 * len(error))]
    recall = sum(tally.found.values()) / max(sum(tally.fair.values()), 1)
    return (
        f"{name:38s} {recall:7.3f} {tally.false:6d} {np.mean(has_all_corners):10.3f} {np.median(error):8.3f} "
        f"{np.quantile(error, 0.95):8.3f} {square.mean():8.2f}"
    )


def sizes() -> Iterator[Part]:
    """Each column of the table of sizes, each number of the foreign images, and the context that lacks it."""
    yield "nothing off", nullcontext
    for column, nothing in (
        ("least", 0.0), ("observable_sigma", np.inf), ("usual", np.inf), ("most", np.inf),
    ):  # fmt: skip
        yield f"{column} size of each fault", partial(_without_size, column, nothing)
    yield "foreign: views that share counts for", partial(patch.object, foreign, "_PSEUDO_VIEWS", 100.0)
    yield "foreign: markings taken by mistake", partial(patch.object, foreign, "_BY_MISTAKE", 1e-6)
    yield "foreign: mixtures of two markings", partial(patch.object, foreign, "_CONFUSED", 1e-6)
    yield "foreign: misses weighed by distance", partial(patch.object, foreign, "_DISTANCES", 1)
    yield (
        "twists that noise averages out of",
        partial(patch.object, optimise, "vehicle_twists", _by_neighbours),
    )
    yield "jitter that does not matter", partial(patch.object, solution, "_LEAST_JITTER_S", 0.0)
    yield "a hypothesis of fy alone", partial(patch.object, columns, "_FOCAL_SHARES", ((1.0, 1.0),))
    yield (
        "distances between adjusted poses",
        partial(patch.object, Sensitivity, "map_from_vehicle", property(_recorded)),
    )
    yield "sightings of rejected corners", partial(patch.object, recovery, "_effective_count", _countless)
    yield "clocks: prior of being late", partial(patch.object, poses, "_UNSTATED_CLOCK_S", 0.0)
    yield "lenses: errors that nothing shows", partial(patch.object, accuracy, "_unseen_lenses", _none_unseen)
    yield "clocks: uneven stamps are no counted ones", partial(patch.object, poses, "_UNEVEN_S", np.inf)
    yield "clocks: prior of their drift", partial(patch.object, poses, "_UNSTATED_CLOCK_DRIFT_S", 0.0)
    yield "heading: held against surveys", partial(patch.object, alignment, "_ASKEW_RAD", np.deg2rad(1.0))


def _by_neighbours(map_from_vehicle: FloatArray, stamp_s: FloatArray, session: IntArray) -> FloatArray:
    """Vehicle twists (F, 6) from the poses just before and just behind each, as of one ``session``."""
    number = np.arange(len(stamp_s))
    before, behind = np.maximum(number - 1, 0), np.minimum(number + 1, len(number) - 1)
    moved = log(inverse(map_from_vehicle[before]) @ map_from_vehicle[behind])
    return np.asarray(moved / (stamp_s[behind] - stamp_s[before])[:, None])


def row_of_verdict(name: str, seeds: Sequence[int], faults: Sequence[str]) -> str:
    """One line of the table of the verdict."""
    failed, judged = 0, []
    spoilt = []
    for seed in seeds:
        clean = map_one(Job(seed))
        in_turn = map_one(Job(seed, "straight", apart_s=APART_S, stated=True))
        failed += sum(right.status == "FAIL" for right in (clean, in_turn))
        of_seed = [map_one(Job(seed, spoil=spoil)) for spoil in faults]
        judged += [judge(row, clean) for row in of_seed]
        spoilt += of_seed
    silent = sum(judgement.silent for judgement in judged)
    raised = [judgement.named for judgement in judged if judgement.told]
    inside = shares_inside(spoilt)["corners"]
    return f"{name:38s} {failed:7d} {silent:7d} {len(raised):7d} {raised.count('first'):7d} {inside:7.2f}"


def terms() -> Iterator[Part]:
    """Each term of the site model, and the context that lacks it."""
    yield "nothing off", nullcontext
    for kind, name in (
        (hypotheses.Kind.OTHER_LENGTH, "dashes of another length"),
        (hypotheses.Kind.WRONG_END, "wrong ends"),
        (hypotheses.Kind.PIECE, "pieces"),
    ):
        yield name, _without_kind(kind)
    yield "slanting cuts of pieces", partial(patch.object, hypotheses, "_SLANT_OF_PIECE", 0.0)
    yield "slanting ends of dashes", partial(patch.object, hypotheses, "_SLANT_OF_END", 0.0)
    yield "lengths that repeat", _without_repeats
    yield "standards where dashes are few", partial(patch.object, markings, "STANDARD_M", {})
    yield "ends that run on", partial(patch.object, hypotheses, "_RUN_ON_M", 0.0)
    yield "images' disagreement on worn ends", partial(patch.object, hypotheses, "_worn_evidence", _no_odds)
    yield "views that know a corner hidden", partial(patch.object, posterior, "_vague_evidence", _unknown)
    yield "what stands beyond ends", partial(patch.object, standing.Watch, "standing_odds", _nothing_stands)
    yield "examples at which nothing stands", partial(patch.object, posterior, "_examples", _likely)
    yield "lines of dashes", partial(patch.object, hypotheses, "in_series", _nothing)
    yield "clutter shaped like its class", partial(patch.object, hypotheses, "_LIKE_CLASS", 1e-9)
    yield "how much clutter differs from it", partial(patch.object, hypotheses, "_LIKE_SHARE", 0.0)
    yield "markings seldom found", partial(patch.object, posterior, "_NEGLECTED_SHARE", 1e-9)
    yield "symbols' presence", partial(patch.object, symbols, "symbols_presence", _all_present)
    yield "symbols on candidates", partial(patch.object, conclusion, "images_with_symbol", _no_images)
    yield "lines behind dashes", partial(patch.object, conclusion, "images_with_line", _no_images)
    yield "their sureness", partial(patch.object, ground, "_SURE_M", np.inf)
    yield "their direction", partial(patch.object, ground, "_PARALLEL", -1.0)
    yield "sightings of something else", partial(patch.object, parallax, "_OFF_SHARE", 1e-9)
    yield "sills of parked cars", partial(patch.object, parallax, "_SILL_SHARE", 1e-9)
    yield "corners of paint in one plane", partial(patch.object, parallax, "_GROUND", (1.0, 0.07, 0.07))


@contextmanager
def _without_size(column: str, nothing: float) -> Iterator[None]:
    with ExitStack() as stack:
        for fault in FAULTS.values():
            # Records are frozen: what they hold is replaced below their guard.
            stack.enter_context(patch.dict(vars(fault), {column: nothing}))
        yield


def _recorded(solved: Sensitivity) -> Any:
    return solved.arrays.vehicle_from_map.inverse()


def _none_unseen(*_: Any) -> Iterator[Any]:
    return iter(())


def _countless(*_: Any) -> float:
    return 1e4


@contextmanager
def _without_repeats() -> Iterator[None]:
    lengths = hypotheses.Hypotheses._other_lengths

    def alone(space: Any, *arguments: Any) -> tuple[FloatArray, FloatArray]:
        spread_m, again = lengths(space, *arguments)
        return spread_m, 0 * again

    with patch.object(hypotheses.Hypotheses, "_other_lengths", alone):
        yield


def _no_odds(_: Any, ends: Sequence[FloatArray], weight: FloatArray) -> FloatArray:
    return np.zeros((len(ends), len(weight)))


def _unknown(_: Any, weight: FloatArray) -> FloatArray:
    return np.zeros((len(weight), 4))


def _nothing_stands(_: Any, corners_map: FloatArray, is_end: BoolArray) -> FloatArray:
    return np.zeros(is_end.shape)


def _likely(weight: FloatArray, _: FloatArray) -> BoolArray:
    return np.asarray(weight > 0.5)


def _all_present(images: IntArray, *_: Any) -> posterior.Presence:
    return posterior.Presence(np.full(len(images), np.inf), np.zeros((len(images), 2)))


def _no_images(_: Any, __: Any, corners_map: FloatArray) -> FloatArray:
    return np.zeros(len(corners_map), dtype=np.int64)


def _without_kind(kind: int) -> Callable[[], AbstractContextManager[Any]]:
    add = hypotheses.Hypotheses.add

    def unless(space: Any, kind_of_row: int, *arguments: Any, **named: Any) -> None:
        if kind_of_row != kind:
            add(space, kind_of_row, *arguments, **named)

    return partial(patch.object, hypotheses.Hypotheses, "add", unless)


@dataclass
class Mapped:
    """Counts over the maps of several drives."""

    markings: int = 0
    false: int = 0
    found: float = 0.0
    expected: int = 0
    wrong: int = 0
    symbols: int = 0
    squared_m2: list[float] = field(default_factory=list)

    def add(self, mapped: Sequence[Marking], truth: Truth, expected: BoolArray) -> None:
        """Count a map's markings."""
        figures = marking_metrics(replace(truth.map, markings=tuple(mapped)), truth, expected)
        rows, columns = match_markings(mapped, truth.map.markings)
        true = [
            in_order_of(mapped[row].corners_map, truth.map.markings[column].corners_map)
            for row, column in zip(rows, columns, strict=True)
        ]
        markings_met = [mapped[row] for row in rows]
        off_m = np.array(
            [np.linalg.norm(a.corners_map - b, axis=1) for a, b in zip(markings_met, true, strict=True)]
        )
        sigmas2 = corner_errors(markings_met, np.array(true)).reshape(-1, 4)
        self.markings += figures.markings
        self.false += figures.false_markings
        self.found += figures.recall * figures.expected
        self.expected += figures.expected
        self.wrong += int(np.count_nonzero(((off_m > WRONG_M) & (sigmas2 > WRONG_SIGMAS**2)).any(axis=1)))
        self.squared_m2 += np.square(off_m).ravel().tolist()

    def __str__(self) -> str:
        rmse_m, recall = np.sqrt(np.mean(self.squared_m2)), self.found / max(self.expected, 1)
        counts = f"{self.markings:8d} {self.false:6d} {recall:7.3f} {100 * rmse_m:8.2f} {self.wrong:6d}"
        return f"{counts} {self.symbols:7d}"


class SiteDrive(NamedTuple):
    """A drive to map with some cameras, what is found in it and what is true; ``grey`` reads its images."""

    drive: Drive
    found: Sequence[ImageDetections]
    truth: Truth
    cameras: tuple[str, ...]
    grey: Callable[[Image], np.ndarray] | None = None


def site_drives(seeds: Sequence[int], folders: Sequence[Path]) -> Iterator[SiteDrive]:
    """Made drives of some seeds, of which those past boxes have images, and those of folders."""
    for seed in seeds:
        for world, see, cameras, has_images in (
            (make(draw(seed)), detect, ("front", "rear"), False),
            (make(draw(seed)), detect_pieces, ("front", "rear"), False),
            (make_boxes(draw(seed, "straight")), detect_pieces, ("front",), True),
            (
                make_boxes(draw(seed, "straight")),
                partial(detect_pieces, share_known=_MOST_ENDS),
                ("front",),
                False,
            ),
            (make_queue(draw(seed, "straight")), detect_queue, ("front",), False),
            (make_lengths(draw(seed, "straight")), detect, ("front",), False),
        ):
            drive = drive_of(world)
            detections, visibility = see(world, drive)
            truth = truth_of(world, drive, visibility)
            grey = rendered_once(world) if has_images else None
            yield SiteDrive(drive, detections, truth, cameras, grey)
    for folder in folders:
        drive = read_drive(folder)
        detected = detect_all(drive, DetectorOptions.for_mapping())
        yield SiteDrive(drive, detected, read_truth(drive), tuple(drive.cameras), grey_reader(drive))


def rendered_once(world: World) -> Callable[[Image], np.ndarray]:
    """Reads the images of a made drive, each of which is rendered once."""
    images: dict[Path, np.ndarray] = {}

    def grey(image: Image) -> np.ndarray:
        if image.path not in images:
            images[image.path] = grey_of(world, image)
        return images[image.path]

    return grey


def rows_of_site(only: str, seeds: Sequence[int], folders: Sequence[Path]) -> Iterator[str]:
    """The table of the site model. Each drive is mapped once, and its candidates classified once a term."""
    chosen_terms = [(name, off) for name, off in terms() if re.search(only, name) or name == "nothing off"]
    tally = {name: Mapped() for name, _ in chosen_terms}
    for drive, detections, truth, cameras, grey in site_drives(seeds, folders):
        expected, classified_inputs = driven_past(drive, truth, cameras), []

        def classify(*arguments: Any, recorded: list[Any] = classified_inputs) -> markings.Classified:
            recorded.append(arguments)
            return markings.classify(*arguments)

        asked_symbols: list[Any] = []

        original = symbols.map_symbols

        def map_symbols(*arguments: Any, recorded: list[Any] = asked_symbols, call: Any = original) -> Any:
            recorded.append(arguments)
            return call(*arguments)

        asked_parallax: list[Any] = []

        def measure(*arguments: Any, recorded: list[Any] = asked_parallax) -> parallax.Parallax:
            recorded.append(arguments)
            return parallax.measure_parallax(*arguments)

        with (
            patch.object(conclusion, "classify", classify),
            patch.object(conclusion, "measure_parallax", measure),
            patch.object(symbols, "map_symbols", map_symbols),
        ):
            run_methods(drive, detections, cameras, grey=grey)
        for name, off in chosen_terms:
            with off():
                solved, kind, kinds, counted, _, *others = classified_inputs[-1]
                on_ground = parallax.measure_parallax(*asked_parallax[-1])
                classified = markings.classify(solved, kind, kinds, counted, on_ground, *others)
                tally[name].add(classified.markings(), truth, expected)
                if asked_symbols:  # a drive without a symbol asks for none
                    tally[name].symbols += len(symbols.map_symbols(*asked_symbols[-1])[0])
    return (f"{name:38s} {counts}" for name, counts in tally.items())


def holds() -> Iterator[Part]:
    """Each thing that holds a mounting, or tells what stands, and the context that lacks it."""
    yield "nothing off", nullcontext
    yield "the ground that texture shows", partial(patch.object, bundle, "_ground_of", _nothing)
    yield "doubt of its height", partial(patch.object, planes, "_HEIGHT_SHARE", 0.0)
    yield "things that stand, among rejected", partial(patch.object, solution, "_OTHER_SHARE", 0.0)
    yield "sills of parked cars", partial(patch.object, parallax, "_SILL_SHARE", 1e-9)
    yield "columns of the ground in tests", partial(patch.object, ground_columns, "_rows", _no_rows)


def _no_rows(*_: Any) -> dict[str, Any]:
    return {}


def row_of_short(name: str, seeds: Sequence[int]) -> str:
    """One line of the table of short drives."""
    tilt_rad2, off_m2, squared = [], [], []
    mapped = false = failed = 0
    for seed in seeds:
        short = make_short(draw(seed, "straight"))
        best = run_methods(short.drive, short.found, (CAMERA,), naive=False)[BEST]
        calibration = best.calibrations[CAMERA]
        true = plane_in(short.truth.cam_from_vehicle[CAMERA])
        off = plane_in(calibration.cam_from_vehicle) - true
        axes = np.zeros((3, 4))
        axes[:2, :3] = np.linalg.svd(true[None, :3])[2][1:]
        axes[2, 3] = 1.0
        slope = axes @ by_tangent(calibration.cam_from_vehicle)
        error = axes @ off
        squared.append(error @ np.linalg.solve(slope @ calibration.covariance @ slope.T, error))
        tilt_rad2.append(off[:3] @ off[:3])
        off_m2.append(off[3] ** 2)
        expected = driven_past(short.drive, short.truth, (CAMERA,))
        figures = marking_metrics(best.hd_map, short.truth, expected)
        mapped += figures.markings
        false += figures.false_markings
        failed += any(finding.status is Status.FAIL for finding in solution.check_solution(short.drive, best))
    tilt_deg = np.rad2deg(np.sqrt(np.mean(tilt_rad2)))
    height_cm = 100 * np.sqrt(np.mean(off_m2))
    return (
        f"{name:38s} {tilt_deg:9.2f} {height_cm:10.1f} {np.median(squared):8.1f} {mapped:8d} {false:6d} "
        f"{failed:7d}"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--images", type=int, default=60)
    parser.add_argument("--only", default="")
    parser.add_argument("--verdict", nargs=2, type=int, metavar=("FIRST", "LAST"))
    parser.add_argument("--faults", nargs="+", default=list(SPOILS), choices=SPOILS, metavar="NAME")
    parser.add_argument("--site", nargs=2, type=int, metavar=("FIRST", "LAST"))
    parser.add_argument("--drives", nargs="+", type=Path, default=[])
    parser.add_argument("--short", nargs=2, type=int, metavar=("FIRST", "LAST"))
    parsed = parser.parse_args()
    cv2.setNumThreads(1)
    if parsed.site or parsed.drives:
        print(
            f"{'off':38s} {'markings':>8s} {'false':>6s} {'recall':>7s} {'RMSE, cm':>8s} {'wrong':>6s} "
            f"{'symbols':>7s}"
        )
        print(*rows_of_site(parsed.only, range(*(parsed.site or (0, 0))), parsed.drives), sep="\n")
        return
    if parsed.short:
        head = f"{'tilt, deg':>9s} {'height, cm':>10s} {'squared':>8s} {'markings':>8s}"
        print(f"{'off':38s} {head} {'false':>6s} {'failed':>7s}")
        for name, off in holds():
            if re.search(parsed.only, name) or name == "nothing off":
                with off():
                    print(row_of_short(name, range(*parsed.short)), flush=True)
        return
    if parsed.verdict:
        print(f"{'off':38s} {'failed':>7s} {'silent':>7s} {'told':>7s} {'first':>7s} {'inside':>7s}")
        for name, off in sizes():
            if re.search(parsed.only, name):
                with off():
                    print(row_of_verdict(name, range(*parsed.verdict), parsed.faults), flush=True)
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

"""Teaches the detector's judge and confidence what the claims of its network are worth.

``python -m train.ship`` runs it. Quadrilaterals that the detector proposes on rendered scenes, first two
thirds of full difficulty, then a third of easy ones, are true if they overlap a marking of their class by
half. They are false where the quality benchmark would say so, and on arrows. The judge, ``judge.onnx``,
learns to tell them apart, and how far the sides of the true ones are off. Logistic regressions with a weak
ridge, one for each shape, then weigh the claims of the others in an image: ``confidence.json``. Each scene
is looked at as on the vehicle; every third as in the mapping, too; every other one once more with spots of
sun that the network confidently takes for markings. The seed is neither that of the quality
benchmark nor one of training. Printed: the log odds that each feature of the others adds per standard
deviation; log loss, and the count of true ones at given counts of false ones, on the images of each fifth by
a fit to the others.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import cv2
import numpy as np

from export.judge_file import read_judge, write_judge
from models.judge import Judge
from train.confident_spots import Spots, lit
from train.config import DataConfig
from train.data import hardships_of
from train.examples import Example, TrueMarking, example, photograph, polygon_overlap
from train.judge import JudgeConfig, Quadrilaterals, judged, train_judge
from train.labels import LabelledImages
from train.odds import worth_of
from train.scenes.hardships import NONE
from v2hdm.catalogue import SHIPPED, SYMBOL
from v2hdm.detection.classifier import AMONG, COMPANIES, SHAPES, Readings, features_among, one_hot, shape_of
from v2hdm.detection.detector import Detector
from v2hdm.detection.evidence import CHANNELS, CLAIMED, FEATURES, SIZE
from v2hdm.detection.network import Network
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.weights import CONFIDENCE_FILE, JUDGE_FILE
from v2hdm.geometry.planar import Quad, following
from v2hdm.records import STOP_LINE, BoolArray, FloatArray
from v2hdm.store.files import replace_text, whole_file

SEED = 917  # seed of the rendered scenes, not that of the benchmark nor of a training
EASY = 0.2  # difficulty of the easy scenes
RIDGE = 2.0  # information of the prior that weights of the logistic functions are 0
FOLDS = 5  # parts of the images by which log loss is measured, each by a fit to the others
_JUDGE_FOLDS = 2
"""Parts of the images, each judged by what was learnt from the others; a judge takes minutes to learn."""

_FALSE_SHARE = 1 / 3
"""Share of the false readings of renders that is learnt from; photographs, which are few, count twice. The
confidence, fitted to all, sets the odds right again."""

HARDSHIPS_EVERY = 3
"""Every third scene is without any of them."""

HARDSHIPS = replace(
    hardships_of(DataConfig()), aside=0.0, hollow=0.5, crossings=0.3, words=0.25, things_beside=1.2
)
"""Scenes of training, oftener where the classifier decides: outlines and letters, stop lines that meet lines,
ends that are hidden. A camera that looks aside sees classes by other names."""

JUNCTIONS_SHARE = 1 / 12  # share of the scenes, the last ones, that are at junctions
AT_JUNCTIONS = replace(HARDSHIPS, junctions=0.7, crossings=0.7)
"""The last of the scenes have most of the stop lines, which are else one in two hundred true readings."""

CONFIG = JudgeConfig()
LIT_EVERY = 2  # every so many-th image is looked at once more with spots of sun
MIRRORED_EVERY = 3
"""Which images are looked at once more, with spots of sun and as in the mapping."""

_UNTOLD_SHARE = 0.05
"""Largest share of unknown ground in a quadrilateral of which anybody knows whether it is a marking."""

COUNTS = (10, 20, 40, 80)
"""Numbers of false readings at which the true ones are counted."""


@dataclass
class Gathered:
    """N readings of quadrilaterals as one class, those of one look at an image together.

    Their evidence, views, corners on the ground, classes, whether they are true (None where either will do),
    the errors of their sides, px, nan where unknown, with the formal variances, the numbers of the images
    they are from and of the looks, and whether spots of sun were added to these.
    """

    evidence: list[FloatArray] = field(default_factory=list)
    views: list[np.ndarray] = field(default_factory=list)
    ground: list[FloatArray] = field(default_factory=list)
    kind: list[str] = field(default_factory=list)
    true: list[bool | None] = field(default_factory=list)
    side_error: list[FloatArray] = field(default_factory=list)
    side_variance: list[FloatArray] = field(default_factory=list)
    image: list[int] = field(default_factory=list)
    look: list[int] = field(default_factory=list)
    lit: list[bool] = field(default_factory=list)
    photograph: list[bool] = field(default_factory=list)

    def add(self, index: int, shown: Example, detector: Detector, spots: Spots | None = None) -> None:
        """The detector's proposals in one image, whose network is confident that ``spots`` are markings."""
        output = detector.run_network(shown.image, shown.camera)
        if spots is not None:
            output = spots.claimed(output)
        readings = detector.read(shown.image, detector.propose(output, shown.camera))
        if readings is None:
            return
        look = 1 + max(self.look, default=-1)
        corners_px = readings.fit.corners_px
        variance = readings.fit.side_variance()
        for row, (m, kind) in enumerate(zip(readings.quadrilateral.tolist(), readings.kinds, strict=True)):
            true, marking = is_true(shown, kind, corners_px[m])
            order = (np.arange(4) + readings.first_side[row]) % 4
            self.evidence.append(readings.evidence[row])
            self.views.append(readings.views[row].astype(np.float16))
            self.ground.append(readings.ground[row])
            self.kind.append(kind)
            self.true.append(true)
            # Hand labels lie pixels off: they tell what is a marking, not where its sides are.
            measured = marking if shown.unknown is None else None
            self.side_error.append(side_errors(readings, m, corners_px[m], measured)[order])
            self.side_variance.append(variance[m, order])
            self.image.append(index)
            self.look.append(look)
            self.lit.append(spots is not None)
            self.photograph.append(shown.unknown is not None)

    def save(self, path: Path) -> None:
        """Write it to ``path``, which appears whole or not at all."""
        columns = {item.name: np.array(getattr(self, item.name)) for item in fields(self)}
        columns["true"] = np.array([-1 if true is None else int(true) for true in self.true], dtype=np.int8)
        with whole_file(path) as partial, partial.open("wb") as file:
            np.savez(file, **columns)

    @classmethod
    def load(cls, paths: Sequence[Path]) -> Gathered:
        """The contents of several files of :meth:`save`, one after the other."""
        whole = cls()
        for path in paths:
            first_look = 1 + max(whole.look, default=-1)
            with np.load(path) as columns:
                for item in fields(cls):
                    values = columns[item.name]
                    if item.name == "true":
                        values = [None if value < 0 else bool(value) for value in values]
                    elif values.ndim == 1:
                        values = (values + first_look if item.name == "look" else values).tolist()
                    getattr(whole, item.name).extend(values)
        return whole


def is_true(shown: Example, kind: str, corners_px: FloatArray) -> tuple[bool | None, TrueMarking | None]:
    """Whether a quadrilateral (4, 2) is a marking, and which; None where the quality benchmark lets it be."""
    overlaps = [(polygon_overlap(corners_px, true.polygon_px), true) for true in shown.markings]
    of_kind = [pair for pair in overlaps if pair[0] >= 0.5 and pair[1].kind == kind]
    if of_kind:
        return True, max(of_kind, key=lambda pair: pair[0])[1]
    share, nearest = max(overlaps, key=lambda pair: pair[0], default=(0.0, None))
    if share <= 0.05 or nearest is None:
        return (None if _is_untold(shown, kind, corners_px) else False), None
    of_own = max((share for share, true in overlaps if true.kind == kind), default=0.0)
    if nearest.kind != kind and (
        nearest.fair or (nearest.kind in SHIPPED.of_family(SYMBOL) and of_own <= 0.05)
    ):
        return False, None  # the head of an arrow is no diamond
    return None, None


def _is_untold(shown: Example, kind: str, corners_px: FloatArray) -> bool:
    """Whether a photograph's labels would not tell of such a quadrilateral."""
    if shown.unknown is None:
        return False
    mask = np.zeros(shown.unknown.shape, dtype=np.uint8)
    cv2.fillConvexPoly(mask, np.round(cv2.convexHull(corners_px.astype(np.float32))).astype(np.int32), 1)
    return kind in shown.silent or bool((shown.unknown & (mask > 0)).sum() > _UNTOLD_SHARE * mask.sum())


def side_errors(readings: Readings, m: int, corners_px: FloatArray, true: TrueMarking | None) -> FloatArray:
    """How far (4,) px the true sides lie outside those of quadrilateral ``m``; nan where nobody knows."""
    if true is None or len(true.polygon_px) != 4:
        return np.full(4, np.nan)
    turned = [np.roll(true.polygon_px[::way], shift, axis=0) for shift in range(4) for way in (1, -1)]
    nearest = min(turned, key=lambda corners: float(np.abs(corners - corners_px).sum()))
    quad = Quad(readings.fit.quad.corners[m])
    placed = readings.fit.frames.take(np.array([m])).from_image(nearest[None])[0]
    middle, true_middle = ((corners + following(corners)) / 2 for corners in (quad.corners, placed))
    return np.asarray(((true_middle - middle) * quad.normal).sum(axis=-1))


def render_to_fit(number: int, images: int, seed: int) -> tuple[int, Example]:
    """Scene ``number`` of ``images`` and what it is called: two thirds are hard, then a third is easy."""
    hard = images - images // 3
    index, difficulty = (number, 1.0) if number < hard else (number - hard, EASY)
    return index, example(index, difficulty, seed)


def render_to_judge(number: int, images: int, seed: int) -> tuple[int, Example]:
    """:func:`render_to_fit` with hardships in two of three scenes; the last ones are junctions."""
    usual = images - int(images * JUNCTIONS_SHARE)
    if number >= usual:
        return number, example(number, 1.0, seed, AT_JUNCTIONS)
    hard = usual - usual // 3
    index, difficulty = (number, 1.0) if number < hard else (number - hard, EASY)
    return index, example(index, difficulty, seed, HARDSHIPS if number % HARDSHIPS_EVERY else NONE)


def fit(evidence: FloatArray, true: BoolArray) -> tuple[FloatArray, float]:
    """Weights (F,) and bias of a logistic regression, by Newton's method on standardised features."""
    mean = evidence.mean(axis=0)
    deviation = np.maximum(evidence.std(axis=0), 1e-6)
    design = np.column_stack([(evidence - mean) / deviation, np.ones(len(evidence))])
    ridge = RIDGE * np.diag(np.append(np.ones(evidence.shape[1]), 1e-6))
    solution = np.zeros(design.shape[1])
    for _ in range(30):
        probability = 1 / (1 + np.exp(-design @ solution))
        slope = design.T @ (true - probability) - ridge @ solution
        curvature = (design * (probability * (1 - probability))[:, None]).T @ design + ridge
        solution = solution + np.linalg.solve(curvature, slope)
    weights = solution[:-1] / deviation
    return weights, float(solution[-1] - mean @ weights)


def log_loss(odds: FloatArray, true: BoolArray) -> float:
    """Mean of minus the log probability of what is the case, from log odds (N,)."""
    return float(np.log1p(np.exp(-np.where(true, 1.0, -1.0) * odds)).mean())


@dataclass(frozen=True)
class Part:
    """Scenes ``numbers`` of ``images``, seen with the network ``model``; their readings go to ``path``.

    Or else labelled photographs, ``images`` of them being renders.
    """

    numbers: range
    images: int
    model: Path
    path: Path
    photographs: LabelledImages | None = None


def gather(part: Part) -> Part:
    """Write the readings of a part of the scenes to its file, which appears whole or not at all."""
    options = DetectorOptions(max_range_m=24.0, min_confidence=0.0)
    network = Network(part.model)
    detectors = [Detector(network, replace(options, mirrored=twice)) for twice in (False, True)]
    gathered = Gathered()
    for number, photo in enumerate(part.photographs.images if part.photographs else ()):
        index = part.images + part.numbers[number]
        shown = photograph(photo, part.photographs.config, np.random.default_rng([SEED, index]))
        gathered.add(index, shown, detectors[index % MIRRORED_EVERY == 0])
    for number in part.numbers if part.photographs is None else ():
        index, shown = render_to_judge(number, part.images, SEED)
        gathered.add(index, shown, detectors[0])
        if number % MIRRORED_EVERY == 0:
            gathered.add(index, shown, detectors[1])
        if number % LIT_EVERY == 0:
            rng = np.random.default_rng([SEED, number])
            spotted, spots = lit(shown, detectors[0].road_camera(shown.camera), rng)
            gathered.add(index, spotted, detectors[0], spots)
    gathered.save(part.path)
    return part


def write_both(judge: Judge, fitted: dict[str, dict[str, object]], images: int, folder: Path) -> None:
    """Write the judge, and the weights among others, to a folder."""
    label = {"channels": CHANNELS, "features": FEATURES, "shapes": SHAPES, "images": images, "seed": SEED}
    replace_text(folder / CONFIDENCE_FILE.name, json.dumps(fitted, indent=1) + "\n")
    write_judge(judge, (len(CHANNELS), SIZE, SIZE), label, folder / JUDGE_FILE.name)


def fit_all(
    gathered: Gathered, tell: Callable[[float], None] = lambda share: None, start: Path | None = None
) -> tuple[Judge, dict[str, dict[str, object]]]:
    """The judge, and what ``confidence.json`` is to hold; prints what both are worth on images left out.

    ``tell`` is called with the share of the work that is done. A judge's file to ``start`` from has seen some
    of the images, so that what is printed is a little too good.
    """
    inputs = len(CHANNELS), len(FEATURES), len(SHAPES)
    before = None if start is None else read_judge(start, *inputs, CONFIG.width)
    has_answer = np.array([true is not None for true in gathered.true])
    true = np.array([true is True for true in gathered.true])
    fold = np.array(gathered.image) % _JUDGE_FOLDS
    spotted = np.array(gathered.lit)
    photo = np.array(gathered.photograph)
    print(f"{(true & ~spotted).sum()} of {(has_answer & ~spotted).sum()} readings true", flush=True)
    quadrilaterals = Quadrilaterals(
        np.array(gathered.views, dtype=np.float32),
        np.array(gathered.evidence, dtype=np.float32),
        one_hot(gathered.kind),
        true,
        np.where(true[:, None], np.array(gathered.side_error), np.nan).astype(np.float32),
        np.array(gathered.side_variance, dtype=np.float32),
        tuple(range(CHANNELS.index("paint_odds"), CHANNELS.index("outside"))),
        tuple(FEATURES.index(name) for name in CLAIMED),
    )
    # What is true of the images with spots has been seen without them, too.
    lessons = has_answer & ~(spotted & true)
    lessons &= true | photo | (np.random.default_rng(SEED).random(len(true)) < _FALSE_SHARE)

    def learnt_from(rows: BoolArray) -> Judge:
        chosen = np.flatnonzero(rows)
        return train_judge(
            quadrilaterals.take(np.concatenate([chosen, chosen[photo[chosen]]])), CONFIG, before
        )

    # Each is judged by odds that its own image had no part in.
    odds = np.zeros(len(true))
    side_sigma_px = np.ones((len(true), 4))
    for k in range(_JUDGE_FOLDS):
        judge = learnt_from(lessons & (fold != k))
        odds[fold == k], side_sigma_px[fold == k] = judged(judge, quadrilaterals.take(fold == k))
        tell((k + 1) / (_JUDGE_FOLDS + 2))
    _print_sides(quadrilaterals, side_sigma_px)
    seen_through = (odds < 0)[spotted & has_answer & ~true]
    print(f"seen through: {seen_through.mean():.3f} of the false claims", flush=True)
    return learnt_from(lessons), fit_among(gathered, odds)


def _print_sides(quadrilaterals: Quadrilaterals, side_sigma_px: FloatArray) -> None:
    """Whether the errors of sides of images left out are as large as stated."""
    is_known = np.isfinite(quadrilaterals.side_error)
    square = (quadrilaterals.side_error**2 / (quadrilaterals.side_variance + side_sigma_px**2))[is_known]
    alone = (quadrilaterals.side_error**2 / quadrilaterals.side_variance)[is_known]
    for name, values in (("by the fit alone", alone), ("with the judge", square)):
        inner = np.sort(values)[: int(0.95 * len(values))].mean()
        print(
            f"sides {name}: normalised squared error median {np.median(values):.2f} (honest: 0.45), mean of "
            f"the inner 95 % {inner:.2f} (honest: 0.76), beyond 9 {(values > 9).mean():.3f} (honest: 0.003)"
        )


def fit_among(gathered: Gathered, odds: FloatArray) -> dict[str, dict[str, object]]:
    """Content of ``confidence.json`` from the log odds (N,) of each proposal alone; prints its log loss."""
    # With spots of sun in it an image is no more what others look like.
    is_counted = np.array([true is not None for true in gathered.true]) & ~np.array(gathered.lit)
    true = np.array([true is True for true in gathered.true])
    fold = np.array(gathered.image) % FOLDS
    _print_worth("alone", odds[is_counted], true[is_counted])
    look = np.array(gathered.look)
    ground = np.array(gathered.ground)
    features = np.zeros((len(odds), len(AMONG)))
    for number in range(1 + look.max()):
        mine = np.flatnonzero(look == number)
        features[mine] = features_among(odds[mine], ground[mine], [gathered.kind[m] for m in mine])
    company = np.array([shape_of(kind, COMPANIES) for kind in gathered.kind])
    fitted, left_out = _fit_each(features, company, true, is_counted, fold)
    _print_worth("among others", left_out[is_counted], true[is_counted])
    return fitted


def _fit_company(company: str, features: FloatArray, true: BoolArray) -> tuple[FloatArray, float]:
    """Weights (F,) of :data:`AMONG` and bias, of a shape's features (N, F); of stop lines only odds count."""
    if company != STOP_LINE:
        return fit(features, true)
    worth = worth_of(features[:, AMONG.index("alone")], true)
    return np.where(np.array(AMONG) == "alone", worth.weight, 0.0), worth.bias


def _fit_each(
    features: FloatArray, company: np.ndarray, true: BoolArray, is_counted: BoolArray, fold: np.ndarray
) -> tuple[dict[str, dict[str, object]], FloatArray]:
    """The fit of each company to features (N, F), and log odds (N,) by fits to other images."""
    fitted: dict[str, dict[str, object]] = {}
    effect = {}
    left_out = np.zeros(len(true))
    for name in COMPANIES:
        mine = is_counted & (company == name)
        weights, bias = _fit_company(name, features[mine], true[mine])
        effect[name] = weights * features[mine].std(axis=0)
        named = dict(zip(AMONG, weights.round(4).tolist(), strict=True))
        fitted[name] = {"bias": round(bias, 4), "weights": named}
        for k in range(FOLDS):
            others = mine & (fold != k)
            these = (company == name) & (fold == k)
            weights, bias = _fit_company(name, features[others], true[others])
            left_out[these] = features[these] @ weights + bias
    print(f"{'':16s} " + " ".join(f"{name:>9s}" for name in COMPANIES))
    for row, name in enumerate(AMONG):
        print(f"{name:16s} " + " ".join(f"{effect[shape][row]:+9.2f}" for shape in COMPANIES))
    return fitted, left_out


def _print_worth(name: str, odds: FloatArray, true: BoolArray) -> None:
    """The quality of log odds (N,) on images that had no part in their fit."""
    order = np.argsort(-odds)
    false = np.cumsum(~true[order])
    true_found = np.cumsum(true[order])
    ranks = [np.searchsorted(false, count, side="right") for count in COUNTS]
    counts = ", ".join(
        f"{count} false {true_found[rank - 1]}" for count, rank in zip(COUNTS, ranks, strict=True)
    )
    print(
        f"{name}: log loss of images left out {log_loss(odds, true):.3f}; true ones at {counts}", flush=True
    )

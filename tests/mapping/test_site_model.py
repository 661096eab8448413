"""The traits of a class, and how often a place was seen, say what lies there and where."""

from dataclasses import replace

import numpy as np
import pytest

from v2hdm.association.groups import FusedGroups
from v2hdm.io.maps.corrections import ACCEPTED, Correction
from v2hdm.records import LANE_DASH
from v2hdm.site.candidates import Candidates, Counts, scatter_of, with_dissent, with_shared_errors
from v2hdm.site.hypotheses import Kind
from v2hdm.site.lengths import STANDARD_M
from v2hdm.site.markings import classify
from v2hdm.site.options import AcceptanceOptions
from v2hdm.site.parallax import Parallax
from v2hdm.site.posterior import posterior
from v2hdm.site.shapes import learn_shapes

DIAMOND = np.array([[0.6, 0.0], [0.0, 0.35], [-0.6, 0.0], [0.0, -0.35]])
DASH = np.array([[1.5, 0.06], [-1.5, 0.06], [-1.5, -0.06], [1.5, -0.06]])
END = [1, 2]
"""Two corners of DASH at one end."""


def painted(shapes, rng):
    """Markings (N, 4, 2) of these shapes, in a row, turned any way, beginning with any corner."""
    turn = rng.uniform(0, 2 * np.pi, len(shapes))
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]).transpose(2, 0, 1)
    placed = np.stack(shapes) @ rotation.transpose(0, 2, 1) + np.arange(len(shapes))[:, None, None] * [5.0, 0]
    return np.stack([np.roll(corners, int(rng.integers(4)), axis=0) for corners in placed])


def solved(true, rng, sigma_m=0.01):
    """The markings as a drive would map them: each corner off by ``sigma_m``, all of it by 2 cm more."""
    corners = true + 0.02 * rng.standard_normal((len(true), 1, 2)) + sigma_m * rng.standard_normal(true.shape)
    block = sigma_m**2 * np.eye(8) + 0.02**2 * np.kron(np.ones((4, 4)), np.eye(2))
    return Candidates(corners, np.tile(block, (len(true), 1, 1)))


def row(seed, shapes, sigma_m=0.01):
    """True markings in a row, and as a drive would map them."""
    rng = np.random.default_rng(seed)
    true = painted(shapes, rng)
    return true, solved(true, rng, sigma_m)


def well_seen(count):
    """Each place in ten images, in all of its easy views, and never as part of a symbol."""
    ten = np.full(count, 10)
    return Counts(
        ten, 4 * ten, 4 * ten, np.full(count, 7.0), ten - 2, ten - 2, np.full((count, 4), 8), 0 * ten
    )


def of_one_class(candidates, counts=None):
    return posterior(
        candidates, np.zeros(len(candidates), dtype=np.int64), counts or well_seen(len(candidates))
    )


def without(candidates, place, corners):
    """The candidates, of which one has ``corners`` that nobody saw."""
    corners_map, covariance = candidates.corners_map.copy(), candidates.covariance_m2.copy()
    corners_map[place, corners] = np.nan
    return Candidates.seen(corners_map, covariance)


def shape_rmse(corners, true):
    """Root mean square distance of corners, common shifts of a marking taken out."""
    error = corners - true
    return float(np.sqrt(np.mean(np.sum((error - error.mean(axis=1, keepdims=True)) ** 2, axis=2))))


def normalised(posterior, true):
    """Squared errors (N,) of all eight coordinates, in the stated covariance."""
    error = (posterior.candidates.corners_map - true).reshape(-1, 8, 1)
    return (error.transpose(0, 2, 1) @ np.linalg.solve(posterior.candidates.covariance_m2, error))[:, 0, 0]


@pytest.mark.parametrize("shape", [DIAMOND, DASH])
def test_markings_of_one_stencil_lend_one_another_their_accuracy(shape):
    true, candidates = row(0, [shape] * 60, 0.02)
    posterior = of_one_class(candidates)
    assert shape_rmse(posterior.candidates.corners_map, true) < 0.7 * shape_rmse(candidates.corners_map, true)
    assert normalised(posterior, true).mean() / 8 < 1.1
    assert (posterior.log_odds > 5).all()


def test_a_corner_that_nobody_saw_is_where_the_class_has_it():
    true, candidates = row(1, [DIAMOND] * 30)
    posterior = of_one_class(without(candidates, 4, [2]))
    assert np.linalg.norm(posterior.candidates.corners_map[4] - true[4], axis=1).max() < 0.08
    assert normalised(posterior, true)[4] < 20


def test_a_corner_on_a_known_line_is_found_along_it():
    true, candidates = row(2, [DASH] * 30)
    side = true[4, 1] - true[4, 0]
    long = [0, 1, 2, 3] if np.linalg.norm(side) > 1 else [1, 2, 3, 0]
    along = (true[4, long[1]] - true[4, long[0]]) / 3.0
    for corner in (long[1], long[2]):
        candidates.corners_map[4, corner] -= 1.2 * along
        rows = slice(2 * corner, 2 * corner + 2)
        candidates.covariance_m2[4, rows, rows] += 5.0**2 * np.outer(along, along)
    posterior = of_one_class(candidates)
    assert np.linalg.norm(posterior.candidates.corners_map[4] - true[4], axis=1).max() < 0.08
    assert posterior.probability[4, Kind.OF_CLASS] > 0.5


def test_a_corner_taken_for_another_edge_is_put_where_the_shape_has_it():
    true, candidates = row(3, [DIAMOND] * 40)
    candidates.corners_map[7, 2] += 0.4 * (true[7, 2] - true[7].mean(axis=0))
    posterior = of_one_class(candidates)
    assert np.linalg.norm(posterior.candidates.corners_map[7] - true[7], axis=1).max() < 0.08


def test_a_dash_of_another_length_keeps_it_where_longer_ones_tell_that_lengths_differ():
    rng = np.random.default_rng(4)
    lengths = [1.0] * 34 + [0.9, 0.92, 0.94, 1.06, 1.08, 1.1]
    true = painted([DASH * [length, 1.0] for length in lengths], rng)
    posterior = of_one_class(solved(true, rng, 0.005))
    sides = np.linalg.norm(np.diff(posterior.candidates.corners_map, axis=1), axis=2).max(axis=1)
    np.testing.assert_allclose(sides, 3.0 * np.array(lengths), atol=0.08)
    assert (normalised(posterior, true) < 25).all()


def test_a_worn_end_is_not_taken_for_the_end_of_the_paint():
    true, candidates = row(5, [DASH] * 60, 0.005)
    for worn, share in ((10, 0.07), (20, 0.12), (30, 0.16), (40, 0.22)):
        wear_off(candidates, true, worn, share, 0.03)
    posterior = of_one_class(candidates)
    error = np.linalg.norm(posterior.candidates.corners_map - true, axis=2)
    assert (error < 3 * posterior.candidates.sigma_m).all()
    assert (posterior.log_odds > 5).all()


def wear_off(candidates, true, place, share, sigma_m=0.0):
    """Take a share of its length off one end of a dash, of which images then disagree by ``sigma_m``."""
    k = int(np.argmax(np.linalg.norm(np.roll(true[place], -1, axis=0) - true[place], axis=1)))
    for corner, other in ((k, (k + 1) % 4), ((k + 3) % 4, (k + 2) % 4)):
        candidates.corners_map[place, corner] += share * (true[place, other] - true[place, corner])
        rows = slice(2 * corner, 2 * corner + 2)
        candidates.covariance_m2[place, rows, rows] += sigma_m**2 * np.eye(2)


def test_an_end_on_which_images_disagree_is_likelier_worn_than_one_on_which_they_agree():
    true, candidates = row(5, [DASH] * 60, 0.005)
    wear_off(candidates, true, 10, 0.1)
    wear_off(candidates, true, 20, 0.15, 0.05)
    counts = well_seen(60)
    counts.pointed[20, np.diagonal(candidates.covariance_m2[20])[::2] > 0.05**2] = 6
    crisp, ragged = of_one_class(candidates, counts).probability[[10, 20], Kind.WRONG_END]
    assert ragged > 0.8
    assert crisp < 0.5


def test_a_length_that_several_dashes_have_is_no_wear():
    alone, repeated = (
        solved(
            painted([DASH] * 50 + [DASH * [0.7, 1.0]] * count, rng := np.random.default_rng(6)), rng, 0.005
        )
        for count in (1, 5)
    )
    probabilities = (of_one_class(candidates).probability[50:] for candidates in (alone, repeated))
    others = [probability[:, Kind.OTHER_LENGTH] for probability in probabilities]
    assert others[1].min() > 0.98 > 0.96 > others[0].max()


def test_two_ends_that_most_views_know_to_be_hidden_are_no_other_length():
    """Both are as short, as behind boxes of one size; were it not for the views, that would be a length."""
    true, candidates = row(7, [DASH] * 50, 0.005)
    counts = well_seen(50)
    for place in (10, 20):
        before = candidates.corners_map[place].copy()
        wear_off(candidates, true, place, 0.25)
        counts.pointed[place, np.abs(candidates.corners_map[place] - before).max(axis=1) > 0.1] = 2
    unknown, with_counts = of_one_class(candidates), of_one_class(candidates, counts)
    assert unknown.probability[[10, 20], Kind.OTHER_LENGTH].min() > 0.5
    assert with_counts.probability[[10, 20], Kind.WRONG_END].min() > 0.75
    error = np.linalg.norm(with_counts.candidates.corners_map - true, axis=2)
    assert (error < 3 * with_counts.candidates.sigma_m).all()


def moved_end(candidates, place, along, slant=0.0):
    """Move one end of a dash outwards by ``along`` of its length, one of its corners by ``slant`` more."""
    corners = candidates.corners_map[place]
    k = int(np.argmax(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)))
    for corner, other, part in ((k, (k + 1) % 4, along), ((k + 3) % 4, (k + 2) % 4, along + slant)):
        corners[corner] += part * (corners[corner] - corners[other])


@pytest.mark.parametrize(("seed", "moved"), [(15, (-0.7, 0.0)), (16, (0.15, 0.04))])
def test_a_piece_of_a_dash_is_no_short_dash_and_an_end_that_runs_on_into_a_stroke_is_no_end(seed, moved):
    true, candidates = row(seed, [DASH] * 30, 0.005)
    moved_end(candidates, 12, *moved)
    posterior = of_one_class(candidates)
    assert (
        np.linalg.norm(posterior.candidates.corners_map - true, axis=2) < 3 * posterior.candidates.sigma_m
    ).all()


@pytest.mark.parametrize("seed", range(5))
def test_four_dashes_with_worn_ends_tell_that_a_fifth_is_a_piece(seed):
    """As on a worn road, where no dash but the fifth is known to a brush's width."""
    true, candidates = row(seed, [DASH] * 5, 0.01)
    for place, share in enumerate((-0.02, 0.01, 0.03, -0.01)):
        wear_off(candidates, true, place, share, 0.1)
    moved_end(candidates, 4, -0.75)
    posterior = of_one_class(candidates)
    piece_m, sigma_m = posterior.candidates.corners_map[4], posterior.candidates.sigma_m[4]
    assert (np.linalg.norm(piece_m - true[4], axis=1) < 3 * sigma_m).all()
    assert posterior.probability[4, Kind.WRONG_END] > 0.8
    assert sigma_m.max() > 0.3
    assert (posterior.probability[:4, Kind.OF_CLASS] > 0.5).all()
    assert (normalised(posterior, true) < 25).all()


DASHES = {0: STANDARD_M[LANE_DASH]}


def among_few(candidates):
    """The posterior of dashes that are too few to teach how long they are."""
    kind = np.zeros(len(candidates), dtype=np.int64)
    return posterior(candidates, kind, well_seen(len(candidates)), None, DASHES)


@pytest.mark.parametrize("others", [0, 1, 2])
def test_a_dash_that_may_have_lost_an_end_is_not_certain_beside_so_few_others(others):
    """Three of four metres are gone, and no class of three or more tells so."""
    true, candidates = row(others, [DASH] * (others + 1), 0.01)
    moved_end(candidates, others, -0.75)
    posterior = among_few(candidates)
    error_m = np.linalg.norm(posterior.candidates.corners_map - true, axis=2).max(axis=1)
    sigma_m = posterior.candidates.sigma_m.max(axis=1)
    assert sigma_m[others] > 0.6
    assert error_m[others] < 3.1 * sigma_m[others]
    assert (error_m[:others] < 0.05).all()
    assert (sigma_m[:others] < 0.15).all()
    assert (posterior.log_odds > 5).all()


@pytest.mark.parametrize("length_m", [1.0, 2.0, 3.0, 6.0])
def test_a_dash_of_a_standard_length_keeps_it_alone_and_is_known_better_beside_another(length_m):
    sigmas_m = []
    for count in (1, 2):
        true, candidates = row(3, [DASH * [length_m / 3, 1.0]] * count, 0.01)
        posterior = among_few(candidates)
        sigmas_m.append(posterior.candidates.sigma_m.max())
        assert (np.linalg.norm(posterior.candidates.corners_map - true, axis=2) < 0.05).all()
    assert 0.15 > sigmas_m[0] > sigmas_m[1]
    assert sigmas_m[1] < 0.08


def test_what_most_dashes_show_of_their_length_counts_for_more_than_standards():
    true, candidates = row(4, [DASH * [0.75 / 3, 1.0]] * 2, 0.01)
    posterior = among_few(candidates)
    assert posterior.candidates.sigma_m.max() < 0.1
    assert shape_rmse(posterior.candidates.corners_map, true) < 0.02


def test_a_marking_that_is_not_long_has_no_end_to_lose():
    _, candidates = row(5, [DIAMOND], 0.01)
    assert among_few(candidates).probability[0, Kind.WRONG_END] < 1e-6


def test_two_opposite_corners_in_a_shadow_do_not_make_another_shape():
    true, candidates = row(17, [DIAMOND] * 60, 0.01)
    shift = 0.1 * (true[12, 1] - true[12, 0])
    candidates.corners_map[12, 0] += shift
    candidates.corners_map[12, 2] -= shift
    posterior = of_one_class(candidates)
    assert (
        np.linalg.norm(posterior.candidates.corners_map - true, axis=2) < 3 * posterior.candidates.sigma_m
    ).all()


def test_two_neighbouring_corners_of_a_rhombus_leave_two_places_for_it():
    _, candidates = row(6, [DIAMOND] * 30)
    posterior = of_one_class(without(candidates, 4, [0, 1]))
    assert posterior.candidates.sigma_m[4].max() > 0.15
    assert posterior.candidates.sigma_m[[3, 5]].max() < 0.1


def test_one_end_says_nothing_of_the_other_where_lengths_differ():
    rng = np.random.default_rng(7)
    true = painted([DASH * [(1.0, 0.8)[k % 2], 1.0] for k in range(40)], rng)
    ends = np.argsort(np.linalg.norm(true[4] - true[4, 0], axis=1))[2:].tolist()
    posterior = of_one_class(without(solved(true, rng, 0.005), 4, ends))
    assert posterior.candidates.sigma_m[4].max() > 0.15


def test_a_class_may_have_several_shapes():
    rng = np.random.default_rng(8)
    true = painted([DIAMOND * (1.0, 1.4)[k % 2] for k in range(40)], rng)
    shapes = learn_shapes(solved(true, rng))
    assert len(shapes) == 2
    assert sum(shape.share for shape in shapes) == pytest.approx(1.0)


def test_a_class_of_many_shapes_is_left_as_it_was_seen_but_for_being_parallelograms():
    sizes = np.random.default_rng(8).uniform(0.5, 2.0, 12)
    true, candidates = row(9, [DIAMOND * size for size in sizes], 0.02)
    posterior = of_one_class(candidates)
    corners = posterior.candidates.corners_map
    closure = corners[:, 0] - corners[:, 1] + corners[:, 2] - corners[:, 3]
    assert np.linalg.norm(closure, axis=1).max() < 0.05
    assert shape_rmse(corners, true) < shape_rmse(candidates.corners_map, true)
    assert (posterior.log_odds > 3).all()


def test_a_worn_marking_of_known_shape_is_one_although_few_images_show_it():
    (_, candidates), counts = row(10, [DIAMOND] * 40), well_seen(40)
    counts.detected_views[7], counts.images[7] = 1, 3
    assert of_one_class(candidates, counts).log_odds[7] > 2


def odd_and_seldom():
    """Forty candidates; number 7 has no marking's shape or look, and is seen in three images of many."""
    (_, candidates), counts = row(11, [DIAMOND] * 40), well_seen(40)
    candidates.corners_map[7] += np.random.default_rng(11).normal(0, 0.25, (4, 2))
    counts.detected_views[7], counts.images[7], counts.easy_views[7] = 1, 3, 15
    counts.observations[7], counts.agreeing[7], counts.log_odds[7] = 12, 8, 1.0
    return candidates, counts


def test_what_has_no_shape_and_is_seldom_found_is_clutter():
    posterior = of_one_class(*odd_and_seldom())
    assert posterior.probability[7, Kind.CLUTTER] > 0.8
    assert (np.delete(posterior.log_odds, 7) > 5).all()


def test_what_many_images_show_as_an_arrow_is_part_of_one():
    rng = np.random.default_rng(12)
    true = painted([DASH * [(0.6 if k == 7 else 1.0), 1.0] for k in range(40)], rng)
    counts = well_seen(40)
    counts.as_symbol[7] = 8
    assert of_one_class(solved(true, rng), counts).probability[7, Kind.PART_OF_SYMBOL] > 0.9


def test_what_one_image_shows_as_an_arrow_stays_a_marking():
    rng = np.random.default_rng(13)
    counts = well_seen(40)
    counts.as_symbol[7] = 1
    assert of_one_class(solved(painted([DIAMOND] * 40, rng), rng), counts).log_odds[7] > 5


def verdict(candidates, counts=None, standing=None):
    kind, counts = np.zeros(len(candidates), dtype=np.int64), counts or well_seen(len(candidates))
    count = len(candidates)
    on_ground = Parallax(np.ones((count, 1)), np.full((count, 1, 1), 1e-4), np.full(count, 9.0))
    return classify(
        candidates, kind, ("diamond",), lambda corners_map: counts, on_ground, AcceptanceOptions(), standing
    )


def test_reasons_name_what_has_won():
    candidates, counts = odd_and_seldom()
    counts.as_symbol[3] = 40
    classified = verdict(without(candidates, 5, [0, 1, 2]), counts)
    reasons = {place: reason for place, reason in enumerate(classified.verdict) if reason is not None}
    assert set(reasons) == {3, 5, 7}
    assert reasons[3] == "part of other paint, such as an arrow or a solid line"
    assert reasons[5] == "a corner was never seen twice"
    assert reasons[7] in ("found in too few of its images", "not shaped like a marking of its class")
    assert len(classified.markings()) == 37
    assert [exclusion.reason for exclusion in classified.exclusions()] == list(reasons.values())


def test_of_two_markings_on_one_spot_the_likelier_stays():
    (_, candidates), counts = row(14, [DIAMOND] * 20), well_seen(20)
    candidates.corners_map[2] = candidates.corners_map[1] + [0.1, 0.0]
    counts.images[2] = 4
    classified = verdict(candidates, counts)
    assert [k for k, reason in enumerate(classified.verdict) if reason] == [2]
    assert classified.verdict[2] == "overlaps a better supported marking"


def test_a_shift_that_all_markings_share_speaks_against_none():
    _, candidates = row(15, [DIAMOND] * 20)
    shared = replace(
        candidates, covariance_m2=candidates.covariance_m2 + 0.4**2 * np.kron(np.ones((4, 4)), np.eye(2))
    )
    assert not any(verdict(shared).verdict)


def test_a_place_less_certain_than_others_is_no_reason_against_a_marking_of_known_shape():
    _, candidates = row(16, [DIAMOND] * 20)
    candidates.covariance_m2[3] += 0.3**2 * np.kron(np.ones((4, 4)), np.eye(2))
    assert not any(verdict(candidates).verdict)


def test_a_marking_is_left_out_where_neither_images_nor_others_of_its_class_tell_its_shape():
    rng = np.random.default_rng(16)
    true = painted([DASH] * 20, rng)
    candidates = solved(true, rng)
    candidates.covariance_m2[0, :4, :4] += 5.0**2 * np.eye(4)
    assert not any(verdict(candidates).verdict)
    assert verdict(candidates.subset([0])).verdict == ["a corner was never seen twice"]


def test_an_end_at_which_something_stands_may_lie_behind_it():
    rng = np.random.default_rng(22)
    true = painted([DASH] * 20, rng)
    candidates = solved(true, rng)
    odds = np.full((20, 4), -4.0)
    cut_ends = [(dash, cut_short(candidates, true, dash, cut)) for dash, cut in enumerate(CUTS_M)]
    for dash, end in cut_ends:
        odds[dash, end[0]] = 3.0
    posterior = verdict(candidates, standing=lambda corners_map, is_end: is_end * odds)
    assert not any(posterior.verdict)
    for dash, end in cut_ends:
        off_m = np.linalg.norm(posterior.candidates.corners_map[dash, end] - true[dash, end], axis=1)
        assert (off_m < 0.4).all()
        assert (off_m < 3 * posterior.candidates.sigma_m[dash, end]).all()
    assert (posterior.candidates.sigma_m[len(CUTS_M) :] < 0.1).all()


CUTS_M = np.linspace(0.45, 1.2, 8)


def cut_short(candidates, true, dash, cut_m):
    """Move an end of a dash inwards, which is returned as the indices of its two corners."""
    end = [1, 2] if np.linalg.norm(true[dash, 1] - true[dash, 0]) > 1 else [2, 3]
    along = true[dash, end[0]] - true[dash, end[0] - 1]
    candidates.corners_map[dash, end] -= cut_m * along / np.linalg.norm(along)
    return end


def piece_of(corners):
    """The piece that a barrier on two adjacent sides leaves in sight: .7 of one extent, .5 of the other."""
    u, v = corners[1] - corners[0], corners[3] - corners[0]
    return corners[0] + np.outer([0, 0.7, 0.7, 0], u) + np.outer([0, 0, 0.5, 0.5], v)


def test_a_diamond_that_shows_only_a_piece_between_two_sides_is_not_a_small_diamond():
    rng = np.random.default_rng(16)
    true = painted([DIAMOND] * 40, rng)
    candidates = solved(true, rng)
    candidates.corners_map[7] = piece_of(true[7])
    posterior = of_one_class(candidates)
    assert posterior.probability[7, Kind.PIECE] > 0.8
    assert normalised(posterior, true)[7] < 20


def test_diamonds_of_a_second_stencil_are_no_pieces_of_the_first():
    rng = np.random.default_rng(17)
    true = painted([DIAMOND] * 40 + [0.7 * DIAMOND] * 12, rng)
    posterior = of_one_class(solved(true, rng))
    assert (posterior.probability[:, Kind.OF_CLASS] > 0.9).all()
    assert shape_rmse(posterior.candidates.corners_map, true) < 0.02


def test_the_odd_one_of_a_class_of_few_members_is_not_sure_of_its_size():
    rng = np.random.default_rng(18)
    true = painted([DIAMOND] * 5, rng)
    candidates = solved(true, rng)
    candidates.corners_map[2] = piece_of(true[2])
    posterior = of_one_class(candidates)
    assert (normalised(posterior, true) < 25).all()
    assert (posterior.probability[[0, 1, 3, 4], Kind.OF_CLASS] > 0.8).all()


def test_sightings_that_were_outvoted_widen_the_corner_that_they_contradict():
    rng = np.random.default_rng(19)
    true = painted([DASH] * 3, rng)
    candidates = solved(true, rng, 0.02)
    many = FusedGroups(candidates.corners_map, np.tile(1e-4 * np.eye(2), (3, 4, 1, 1)), np.full((3, 4), 9))
    longer = 0.1 * (true[1, 0] - true[1].mean(axis=0)) / np.linalg.norm(true[1, 0] - true[1].mean(axis=0))
    # One sighting of a tenth of the information sees the end 10 cm farther, one a metre beyond its reach.
    widened = with_dissent(
        candidates,
        many,
        row=np.array([5, 6]),
        group=np.array([1, 2]),
        corner=np.array([0, 0]),
        seen_map=np.stack([candidates.corners_map[1, 0] + longer, candidates.corners_map[2, 0] + [2.0, 0]]),
        covariance_m2=np.tile(9e-4 * np.eye(2), (2, 1, 1)),
    )
    added = widened.covariance_m2 - candidates.covariance_m2
    assert np.trace(added[1]) == pytest.approx(0.1 * 0.1**2, rel=0.1)
    np.testing.assert_allclose(added[1][2:, 2:], 0)
    np.testing.assert_allclose(added[[0, 2]], 0)


LENGTHS_M = [2.0] * 76 + [1.3] * 6 + [2.26] * 6 + [2.74] * 4


def test_a_dash_cut_at_the_usual_length_is_uncertain_where_images_disagree_on_its_end():
    rng = np.random.default_rng(21)
    true = painted([DASH * [length / 3.0, 1.0] for length in [2.74, *LENGTHS_M]], rng)
    candidates, degrees = solved(true, rng), np.full((len(true), 4), 14.0)
    squared = rng.chisquare(14, degrees.shape) * 5 / rng.chisquare(5, degrees.shape)  # heavy tails
    one_image, counts = np.tile(1e-4 * np.eye(2), (len(true), 4, 1, 1)), well_seen(len(true))
    # Boxes stand on an end of the first, which then is as long as most, and of fourteen of these.
    odds = np.zeros((len(true), 4))
    for dash, cut_m in enumerate([0.74, *np.linspace(0.2, 1.2, 14)]):
        end = cut_short(candidates, true, dash, cut_m)
        along = (true[dash, end[0]] - true[dash, end[0] - 1]) / np.linalg.norm(true[dash, 1] - true[dash, 0])
        one_image[dash, end] += 0.1**2 * np.outer(along, along)
        squared[dash, end], counts.pointed[dash, end] = 140.0, 5
        odds[dash, end[0]] = 3.0
    fused = FusedGroups(candidates.corners_map, one_image / 8, np.full((len(true), 4), 8))
    shared = with_shared_errors(candidates, fused, scatter_of(squared, degrees))
    posterior = verdict(shared, counts, lambda corners_map, is_end: is_end * odds)
    assert posterior.candidates.sigma_m[0].max() > 3 * posterior.candidates.sigma_m[0].min()
    assert not any(posterior.verdict[15:77])


def test_a_candidate_that_lost_all_corners_lies_where_it_was_seen():
    unseen = np.full((1, 4, 2), np.nan)
    candidates = Candidates.seen(unseen, np.full((1, 8, 8), np.nan), np.array([[30.0, 4.0]]))
    np.testing.assert_array_equal(candidates.corners_map, np.broadcast_to([30.0, 4.0], (1, 4, 2)))


def test_what_was_never_seen_twice_has_no_place_to_be_missed_at_or_corrected():
    _, candidates = row(24, [DIAMOND] * 20)
    candidates = without(candidates, 5, [0, 1, 2, 3])
    counts = well_seen(20)
    for never_observed in (counts.images, counts.observations, counts.agreeing):
        never_observed[5] = 0
    places = []

    def counted(corners_map):
        places.append(corners_map)
        return counts

    at_origin = Correction(says=ACCEPTED, kind="diamond", outline_map=DIAMOND.tolist())
    on_ground = Parallax(np.ones((20, 1)), np.full((20, 1, 1), 1e-4), np.full(20, 9.0))
    options = AcceptanceOptions(corrections=[at_origin])
    classified = classify(candidates, np.zeros(20, dtype=np.int64), ("diamond",), counted, on_ground, options)
    for corners_map in places:
        assert np.flatnonzero(np.isnan(corners_map).any(axis=(1, 2))).tolist() == [5]
    assert classified.verdict[5] == "a corner was never seen twice"


def test_what_looks_unlike_its_class_and_has_another_shape_is_a_letter_and_a_worn_marking_is_none():
    true, candidates = row(22, [DIAMOND] * 60)
    candidates.corners_map[7] += 0.6 * (true[7] - true[7].mean(axis=0))
    counts = well_seen(60)
    counts.log_odds[:] += np.random.default_rng(22).normal(0.0, 1.0, 60)
    counts.log_odds[[7, 8]] = 1.8
    for never_easy in (counts.easy_views, counts.detected_views, counts.pointed):
        never_easy[7:9] = 0
    assert verdict(candidates, counts).verdict[7:9] == [
        "part of other paint, such as an arrow or a solid line",
        None,
    ]
    counts.log_odds[7] = 7.0
    assert verdict(candidates, counts).verdict[7] is None


def test_residuals_without_bound_leave_a_corner_with_a_finite_variance():
    squared, freedom = np.full((10, 4), 16.0), np.full((10, 4), 16.0)
    squared[3, 2] = np.inf
    scatter = scatter_of(squared, freedom)
    assert np.isfinite(scatter).all()
    assert scatter[3, 2] > 1e3 * scatter[0, 0]


def bend(radius_m=15.0, apart_m=6.0):
    """Dashes of two lines, ever farther beside the middle of a bend, and twelve of the straight before it."""
    dashes = []
    for side in (-1, 1):
        for k, beside_m in enumerate(np.linspace(0.8, 2.6, 10)):
            radius, angle = radius_m + side * beside_m, k * apart_m / radius_m
            turned = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
            place = [radius * np.sin(angle), radius_m - radius * np.cos(angle)]
            dashes.append(DASH * [radius / radius_m, 1.0] @ turned + place)
    return np.array(dashes + [DASH - [10.0 + apart_m * k, 0.0] for k in range(12)])


def test_dashes_of_a_bend_are_as_much_longer_as_they_stand_farther_apart():
    true = bend()
    posterior = of_one_class(solved(true, np.random.default_rng(23), 0.005))
    assert posterior.probability[:, Kind.WRONG_END].max() < 0.02
    assert np.sqrt(np.diagonal(posterior.candidates.covariance_m2, axis1=1, axis2=2)).max() < 0.05


@pytest.mark.parametrize("uneven_m", [0.0, 1.0])
def test_which_end_runs_on_follows_from_the_neighbours_of_a_line_that_is_evenly_spaced_alone(uneven_m):
    rng = np.random.default_rng(24)
    along = 6.0 * np.arange(30) + uneven_m * rng.uniform(-1, 1, 30)
    true = DASH + np.stack([along, 0 * along], axis=1)[:, None]
    candidates = solved(true, rng, 0.005)
    moved_end(candidates, 12, 0.4)
    posterior = of_one_class(candidates)
    error = np.linalg.norm(posterior.candidates.corners_map - true, axis=2)
    assert (error < 3 * posterior.candidates.sigma_m).all()
    assert (posterior.candidates.sigma_m[12].max() < 0.1) == (uneven_m == 0)

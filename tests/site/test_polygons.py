"""Polygons from outlines in images."""

import numpy as np

from tests.site.scene import ARROW
from v2hdm.site import polygons

PX_FROM_MAP = np.diag([100.0, -100.0, 1.0])
FOOT_M = 0.5  # the foot starts so far from where the prior has it, m


def test_vertices_that_no_image_shows_teach_nothing_even_before_the_fit_has_converged():
    sides = np.arange(7) != 6
    outline_px = ARROW * [100.0, -100.0]
    traces = polygons.Traces.of(
        [outline_px], [sides], np.zeros(1, dtype=int), PX_FROM_MAP[None], np.array([1e-3])
    )
    start = ARROW + np.outer(np.isin(np.arange(7), [0, 6]), [FOOT_M, 0.0])
    prior = ARROW.ravel(), 0.25 * np.eye(14)
    fitted = polygons._fit(traces, start, lambda _: prior, 2)
    assert fitted.vertices[0, 0] > ARROW[0, 0] + FOOT_M / 2
    values, directions = np.linalg.eigh(fitted.data)
    unseen = directions[:, values < 1e-9 * values.max()]
    assert unseen.shape[1] >= 2
    np.testing.assert_allclose(fitted.gradient @ unseen, 0.0, atol=1e-6)

"""A crosswalk through the whole mapping: its bars are seen under a wrong mounting, mapped and composed."""

import numpy as np

from tests.mapping.scene import SceneOptions, _placed, make_scene
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.options import MappingOptions
from v2hdm.records import Marking
from v2hdm.site.composed import composed

STREET = SceneOptions(
    length_m=24.0, turns=False, cameras=("front",), step_m=1.2, seed=3,
    false_rate=0.0, wild_rate=0.0, hidden_corner_rate=0.0, rtk_m=0.0, heading_deg=0.0, jitter_deg=0.0,
)  # fmt: skip
BAR = np.array([[-1.5, -0.25], [1.5, -0.25], [1.5, 0.25], [-1.5, 0.25]])
WAY = np.array([0.0, 0.0, 0.3])  # from the origin straight ahead
BARS = [_placed(BAR + np.array([22.0, across]), WAY) for across in np.arange(-1.5, 4.0)]


def with_bars(markings):
    """The markings of the scene that are not where the crosswalk is, and its bars."""
    middle = np.concatenate(BARS).mean(axis=0)
    clear = [m for m in markings if np.linalg.norm(m.corners_map.mean(axis=0) - middle) > 5.0]
    return [*clear, *(Marking("crosswalk_bar", bar, 0) for bar in BARS)]


def test_a_crosswalk_is_mapped_with_its_bars_as_parts():
    scene = make_scene(STREET, with_bars)
    options = MappingOptions(pose_model="heave")
    mapped = composed(run_methods(scene.drive, scene.detections, STREET.cameras, options)["Opt"].hd_map)
    (crosswalk,) = [symbol for symbol in mapped.symbols if symbol.kind == "crosswalk"]
    assert len(crosswalk.parts) == len(BARS)
    assert {m.kind for m in mapped.markings if m.id in crosswalk.parts} == {"crosswalk_bar"}
    true = _placed(np.array([[20.5, -1.75], [23.5, -1.75], [23.5, 3.75], [20.5, 3.75]]), WAY)
    off = [np.linalg.norm(np.roll(crosswalk.outline_map, k, axis=0) - true, axis=1).max() for k in range(4)]
    assert min(off) < 0.1
    assert crosswalk.covariance_m2 is not None

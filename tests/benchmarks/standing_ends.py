"""How well images tell whether an end of a dash is seen or something that stands there hides the rest.

    python -m tests.benchmarks.standing_ends [--seeds 900 912] [--out FILE]

In rendered ports with a box on the far end of every second dash at the right, the ground beyond each end is
looked at in pairs of images, as the mapping does, with true poses. Printed are, for ends at a box's foot and
for others, quantiles of the log-likelihood ratio; the share of pairs of both kinds that it ranks right; and
the logistic regression by which :mod:`v2hdm.site.standing` gets that ratio from the difference of Fisher's z.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import minimize

from tests.benchmarks.made.boxes import make_boxes
from tests.benchmarks.made.draw import draw
from tests.benchmarks.made.world import World, drive_of
from v2hdm.association.ground import Views, views_of
from v2hdm.association.sightings import Rig, frames_of
from v2hdm.geometry.planar import inside_convex
from v2hdm.records import LANE_DASH, Drive, FloatArray, Image
from v2hdm.simulate.render.scene import box_footprint
from v2hdm.site import standing

_CAMERA = "front"
LEAST_HIDDEN_M = 0.25  # length of paint behind a box from which an end counts as hidden


class ShownEnd(NamedTuple):
    """The evidence of images beyond an end of a dash."""

    seed: int
    hidden: bool
    odds: float

    @property
    def better_ground(self) -> float:
        """By how much better the ground matches than a face, in Fisher's z."""
        return (self.odds - standing._BIAS) / standing._PER_BETTER_GROUND


def grey_of(world: World, image: Image) -> np.ndarray:
    """Grey values (H, W) of an image of a made drive, rendered."""
    frame = world.frame_of(image)
    cam_from_map = world.cam_from_map(image.camera, frame, np.zeros(1))[0]
    rng = np.random.default_rng([world.recipe.seed, frame])
    rendered = world.port.renderer.render(world.lenses[image.camera], cam_from_map, rng)
    return np.asarray(rendered.image.astype(np.float32).mean(axis=2))


def shown_outlines(world: World) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Corners (4, 2) of what boxes leave in view of each dash, and lengths hidden beyond its sides."""
    feet = [box_footprint(box) for box in world.port.renderer.scene.boxes]
    for marking in world.port.hd_map.markings:
        if marking.kind != LANE_DASH:
            continue
        shown = marking.corners_map.copy()
        hidden_m = np.zeros(4)
        sides_m = np.linalg.norm(np.roll(shown, -1, axis=0) - shown, axis=1)
        for side in (int(sides_m.argmin()), (int(sides_m.argmin()) + 2) % 4):
            ends, starts = [side, (side + 1) % 4], [(side + 3) % 4, (side + 2) % 4]
            shares = np.linspace(0.0, 1.0, 301)[:, None]
            middle = marking.corners_map[starts].mean(axis=0)
            along = marking.corners_map[ends].mean(axis=0) - middle
            covered = np.any([inside_convex(foot, middle + shares * along) for foot in feet], axis=0)
            if covered[-1]:
                first = float(shares[covered.argmax(), 0])
                hidden_m[side] = (1 - first) * np.linalg.norm(along)
                shown[ends] -= (1 - first) * along
        yield shown, hidden_m


def look(seed: int) -> Iterator[ShownEnd]:
    """The ends of the dashes of a port with boxes, beyond which images tell something."""
    world = make_boxes(draw(seed, "straight"))
    drive: Drive = drive_of(world)
    frames = frames_of(drive).frame_of_image
    poses = np.stack([world.map_from_vehicle[world.frame_of(image)] for image in drive.images])
    true = np.zeros((int(frames.max()) + 1, 4, 4))
    true[frames] = poses
    rig = Rig(
        intrinsic=world.lenses[_CAMERA].intrinsic[None],
        cam_from_vehicle=world.cam_from_vehicle[_CAMERA][:1],
        map_from_vehicle=true,
    )
    views: Views = views_of(drive, (_CAMERA,))
    watch = standing.Watch(
        views, rig, (drive.cameras[_CAMERA],), lambda index: grey_of(world, drive.images[index])
    )
    outlines, hidden_m = map(np.array, zip(*shown_outlines(world), strict=True))
    sides_m = np.linalg.norm(np.roll(outlines, -1, axis=1) - outlines, axis=2)
    is_end = sides_m < sides_m.mean(axis=1, keepdims=True)
    is_end &= (hidden_m == 0) | (hidden_m > LEAST_HIDDEN_M)
    odds = watch.standing_odds(outlines, is_end)
    for dash, side in np.argwhere(odds != 0).tolist():
        yield ShownEnd(seed, bool(hidden_m[dash, side] > 0), float(odds[dash, side]))


def regression(ends: list[ShownEnd]) -> tuple[float, float]:
    """Constant and slope of the log-likelihood ratio by how much better the ground matches."""
    hidden = np.array([end.hidden for end in ends])
    design = np.column_stack([np.ones(len(ends)), [end.better_ground for end in ends]])
    weight = np.where(hidden, 0.5 / hidden.sum(), 0.5 / (~hidden).sum()) * len(ends)

    def loss(by: FloatArray) -> float:
        odds = design @ by
        return float(weight @ (np.logaddexp(0.0, odds) - hidden * odds))

    constant, slope = minimize(loss, [0.0, -1.0]).x
    return float(constant), float(slope)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", nargs=2, type=int, default=(900, 912), metavar=("FIRST", "LAST"))
    parser.add_argument("--out", type=Path, help="file for the ends, JSON")
    parsed = parser.parse_args()
    cv2.setNumThreads(1)
    ends: list[ShownEnd] = []
    for seed in range(*parsed.seeds):
        ends += look(seed)
        print(f"port {seed}: {len(ends)} ends so far", flush=True)
    if parsed.out:
        parsed.out.write_text(json.dumps([end._asdict() for end in ends]))
    odds = {hidden: np.array([end.odds for end in ends if end.hidden == hidden]) for hidden in (True, False)}
    for hidden, values in odds.items():
        shares = np.quantile(values, [0.05, 0.25, 0.5, 0.75, 0.95])
        name = "hidden by a box" if hidden else "on bare ground"
        print(f"{name:16s}{len(values):5d} ends, log-likelihood ratio {np.round(shares, 1)}")
    right = (odds[True][:, None] > odds[False]).mean()
    print(f"ranked right: {right:.3f} of the pairs; constant and slope {np.round(regression(ends), 2)}")


if __name__ == "__main__":
    main()

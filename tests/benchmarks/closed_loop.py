"""Whether a van keeps to its lane where it is steered by the localiser's pose alone.

    python -m tests.benchmarks.closed_loop --seeds 5 --km 5 [--rendered METRES] [--picture FILE]

On both ports a van (:mod:`tests.benchmarks.made.van`) is to follow the trajectory that the mapping drive's
RTK recorded. It knows no position but that of the localiser, which has a map, calibrations and an odometry
with errors, and two cameras at 10 Hz whose detections come 120 ms late. They have the statistics of the
detector on renders (:mod:`v2hdm.simulate.survey.sightings`); with ``--rendered``, so many metres of each port
are driven on images that are rendered from where the van is, and the shipped detector.

The localiser starts from a position known to 5 m and 20 deg, while a driver takes the van along slowly. As
soon as it is sure, the van drives by itself. Where it is not any more, the van brakes to a stop, which is
counted, and the driver takes it on.

Printed for each lap: the way by itself, on it the largest distance of the van's origin from the planned
path, the least way between its outline and the paint of a lane's border, how often it touched one, and the
stops.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tests.benchmarks.made.closed_loop import Lap, Site, lap, made_eyes, rendered_eyes, room_m, site_of
from tests.benchmarks.made.closed_loop_picture import draw
from tests.benchmarks.made.live import calibrated, surveyed
from tests.benchmarks.made.van import Van

PORTS = ("port1", "port2")
_LAP = 81  # stream of a seed


class Driven(NamedTuple):
    """The laps of one port."""

    site: Site
    laps: list[Lap]


def line(laps: Sequence[Lap]) -> str:
    """The figures of laps as one line."""
    left_cm = 100 * np.concatenate([part.left_m for part in laps])
    error_cm = 100 * np.concatenate([part.error_m for part in laps])
    nearest_cm = 100 * min(float(part.clearance_m.min(initial=np.inf)) for part in laps)
    rms_cm, localiser_cm = (np.sqrt(np.nanmean(values**2)) for values in (left_cm, error_cm))
    texts = [
        f"{sum(part.km for part in laps):.2f} km",
        f"from the planned path {np.abs(left_cm).max():.1f} cm at most",
        f"{rms_cm:.1f} cm RMS (localiser {localiser_cm:.1f} across)",
        f"lane borders touched {sum(part.collisions for part in laps)} times, nearest {nearest_cm:.0f} cm",
        f"stops {sum(part.stops for part in laps)}",
        f"by hand at first {max(part.by_hand_m for part in laps):.1f} m at most",
    ]
    return ", ".join(texts)


def planned_line(site: Site) -> str:
    """How near a van would come to the borders that follows its path to the millimetre."""
    rooms_m = []
    for place, yaw_rad in zip(site.path.points_map[30:-30:2], site.path.yaw_rad[30:-30:2], strict=True):
        van = Van(np.random.default_rng(0), place, float(yaw_rad))
        rooms_m.append(room_m(site, van))
    return f"the planned path itself: {site.path.length_m:.0f} m, nearest {100 * min(rooms_m):.0f} cm"


def main() -> None:
    """Print the figures of both ports."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--km", type=float, default=5.0, help="of all together")
    parser.add_argument("--rendered", type=float, metavar="METRES", help="of each port, on rendered images")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="the picture of docs/live.md, a PNG")
    parsed = parser.parse_args()
    least_km = parsed.km / parsed.seeds / len(PORTS)
    drives: list[Driven] = []
    for name in PORTS:
        for seed in range(parsed.first, parsed.first + parsed.seeds):
            site = site_of(name, seed)
            print(f"{name}, seed {seed}: {planned_line(site)}", flush=True)
            laps: list[Lap] = []
            while sum(part.km for part in laps) < least_km:
                begin_s = time.process_time()
                laps.append(_lap_of(site, (seed, len(laps)), parsed.rendered))
                cpu_s = time.process_time() - begin_s
                print(f"  lap {len(laps)}: {line(laps[-1:])}, {cpu_s:.0f} s of CPU", flush=True)
                if parsed.rendered is not None:
                    break
            drives.append(Driven(site, laps))
    print(f"all: {line([part for drive in drives for part in drive.laps])}")
    if parsed.picture is not None:
        draw([(drive.site, drive.laps) for drive in drives], parsed.picture)


def _lap_of(site: Site, number: tuple[int, int], rendered_m: float | None) -> Lap:
    """A lap with a map, calibrations and a van of its own."""
    rng = np.random.default_rng([*number, _LAP, PORTS.index(site.port.config.name)])
    true = site.port.hd_map
    hd_map = surveyed(true, np.zeros((len(true.markings), 4)), int(rng.integers(2**31)))
    lenses = {camera: item.info for camera, item in site.port.cameras.items()}
    calibrations = calibrated(lenses, site.port.cam_from_vehicle, rng)
    if rendered_m is None:
        return lap(site, made_eyes(site, rng), hd_map, calibrations, rng)
    return lap(site, rendered_eyes(site, calibrations, rng), hd_map, calibrations, rng, rendered_m)


if __name__ == "__main__":
    main()

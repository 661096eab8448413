"""How much of a site's lane graph is found, a crossing and a T, and whether other tools read it.

``python -m tests.benchmarks.lane_graph --seeds 20``: of a site whose lines are made, with errors, not mapped
from images. ``--rendered FOLDER``: of the same site as rendered images of ten drives, mapped together by the
shipped detector; renders and stages stay in FOLDER, so that a second call takes a minute.

Printed are the lanes, ways and questions found of the true ones, and false ones, whose ends are to lie within
2.5 m of the true ones. On renders lines of dashes end with their last dash, up to 6 m before the made line;
ends are compared with the paint there, and beside it with the made lines. Then what other tools say:

- lanelet2: on how many of the ten drives a route leads from their start to their end
- pyxodr: roads and junctions that it reads
- ``--checker qc_opendrive``: the issues that ASAM's checker has with the OpenDRIVE
- ``--converter PYTHON``: where ``opendrive2lanelet`` is installed for that PYTHON, how many pairs of a first
  and a last lane its lanelets lead from and to, beside those of the graph
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
import time
import xml.etree.ElementTree as ET
from pathlib import Path

import cv2
import numpy as np
from pyxodr.road_objects.network import RoadNetwork

from examples.lanes.route import route
from examples.lanes.site import Site, made_site
from tests.benchmarks.made.crossing import painted_lines, render_crossing
from tests.benchmarks.made.painted_truth import Pair, painted
from tests.topology.scenes import ENDS, LANES, UNDRIVEN, WAYS, lanes_of, matched, ways_of
from v2hdm import map_drive
from v2hdm.io.maps.formats import write_map
from v2hdm.progress import progress_lines
from v2hdm.topology.build import lane_graph
from v2hdm.topology.graph import LaneGraph

_ERRORS_M = ((0.01, 0.1), (0.03, 0.2), (0.06, 0.3))  # of lines, and by which drives wander, m
_INSIDE_M = 2.0  # way, m, that a route begins and ends inside a drive: within the first and last lane

TRUTH: dict[str, set[Pair]] = {
    "lanes": LANES,
    "ways": WAYS,
    "questions": {(ENDS[before], ENDS[after]) for before, after in UNDRIVEN},
}

_CONVERT = """
import sys, warnings; warnings.filterwarnings("ignore")
from lxml import etree
from opendrive2lanelet.opendriveparser.parser import parse_opendrive
from opendrive2lanelet.network import Network
network = Network()
network.load_opendrive(parse_opendrive(etree.parse(sys.argv[1]).getroot()))
lanelets = network.export_lanelet_network().lanelets
starts = [lanelet.lanelet_id for lanelet in lanelets if not lanelet.predecessor]
after = {lanelet.lanelet_id: lanelet.successor for lanelet in lanelets}
def ends(number, seen):
    ways = [k for k in after[number] if k not in seen]
    return {number} if not after[number] else set().union(*(ends(k, seen | {k}) for k in ways))
print(len(lanelets), sum(len(ends(start, {start})) for start in starts))
"""


def counts(places_found: list, truth: set) -> np.ndarray:
    """How many true ones were found, how many are true, and how many of those found are false."""
    places = matched(places_found, truth)
    return np.array([len(places - {None}), len(truth), len(places_found) - len(places - {None})])


def pairs(graph: LaneGraph) -> int:
    """How many pairs of a lane that none leads to and one that leads nowhere have a way between them."""
    reached = 0
    for start in range(len(graph.lanes)):
        pending, visited = [start] if not graph.before(start) else [], set()
        while pending:
            lane = pending.pop()
            if lane not in visited:
                visited.add(lane)
                pending += graph.after(lane)
        reached += sum(not graph.after(lane) for lane in visited)
    return reached


def issues(path: Path, checker: str) -> int:
    """The issues of any level that ASAM's checker has with a file."""
    config = path.with_suffix(".xml")
    config.write_text(
        f'<Config><Param name="InputFile" value="{path}"/><CheckerBundle application="xodrBundle">'
        f'<Param name="resultFile" value="{path.with_suffix(".xqar")}"/></CheckerBundle></Config>'
    )
    subprocess.run([checker, "-c", str(config)], check=True, capture_output=True, cwd=path.parent)
    return len(list(ET.parse(path.with_suffix(".xqar")).getroot().iter("Issue")))


def found_of(graph: LaneGraph) -> dict[str, list]:
    """The pairs of ends of a graph's lanes, ways, and questions on turns."""
    open_links = [(q.place_map, q.to_map) for q in graph.questions if q.subject == "connection"]
    return {"lanes": lanes_of(graph), "ways": ways_of(graph), "questions": open_links}


def scores(graph: LaneGraph, truth: dict[str, set[Pair]]) -> np.ndarray:
    """The :func:`counts` of lanes, ways and questions, a row each."""
    graph_places = found_of(graph)
    return np.array([counts(graph_places[name], pairs_of_ends) for name, pairs_of_ends in truth.items()])


def shown(table: np.ndarray) -> str:
    """The rows of :func:`scores` as a line."""
    rows = zip(TRUTH, table.tolist(), strict=True)
    return ", ".join(f"{name} {true_found}/{true} false {false}" for name, (true_found, true, false) in rows)


def foreign(site: Site, graph: LaneGraph, folder: Path, parsed: argparse.Namespace) -> list[str]:
    """Lines on how other tools read the site's map, written into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    osm, xodr, *_ = write_map(
        site.hd_map, folder, "site", ["lanelet2", "opendrive"], trajectories=site.trajectories
    )
    paths = [trajectory.map_from_vehicle[:, :2, 3] for trajectory in site.trajectories]
    routes = sum(bool(route(osm.parent, *_ends(path))) for path in paths)
    network = RoadNetwork(str(xodr), resolution=0.5)
    lines = [f"lanelet2: routes along {routes} of {len(paths)} drives"]
    lines += [f"pyxodr: {len(network.get_roads())} roads, {len(network.get_junctions())} junctions"]
    if parsed.checker:
        lines.append(f"asam-qc-opendrive: {issues(xodr.resolve(), parsed.checker)} issues")
    if parsed.converter:
        command = [parsed.converter, "-c", _CONVERT, str(xodr)]
        ran = subprocess.run(command, check=True, capture_output=True, text=True)
        lines.append(f"opendrive2lanelet: lanelets, pairs: {ran.stdout.strip()} of {pairs(graph)}")
    return lines


def _ends(path: np.ndarray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Places just inside the first and the last lane of a drive's path (N, 2)."""
    way_m = np.linalg.norm(path - path[0], axis=1)
    back_m = np.linalg.norm(path - path[-1], axis=1)
    first = path[int(np.argmax(way_m > _INSIDE_M))]
    last = path[len(path) - 1 - int(np.argmax(back_m[::-1] > _INSIDE_M))]
    return tuple(first.tolist()), tuple(last.tolist())


def made(parsed: argparse.Namespace) -> None:
    """Print the figures of the made site, by its errors."""
    for sigma_m, wander_m in _ERRORS_M:
        total = np.zeros((len(TRUTH), 3), dtype=int)
        cpu_s = 0.0
        for seed in range(parsed.seeds):
            site = made_site(seed, sigma_m, wander_m=wander_m)
            begin_s = time.process_time()
            graph = lane_graph(site.hd_map, site.trajectories)
            cpu_s += time.process_time() - begin_s
            total += scores(graph, TRUTH)
            with tempfile.TemporaryDirectory() as folder:
                lines = foreign(site, graph, Path(folder), parsed)
            print(f"  seed {seed}: {'; '.join(lines)}", flush=True)
        cpu_s /= parsed.seeds
        print(f"lines {sigma_m} m, drives {wander_m} m: {shown(total)}, {cpu_s:.2f} s a graph", flush=True)


def rendered(parsed: argparse.Namespace) -> None:
    """Print the figures of the rendered site."""
    cv2.setNumThreads(1)
    folder: Path = parsed.rendered
    drives = render_crossing(folder, progress=progress_lines(print))
    result = map_drive(
        drives, name="crossing", cache=folder / "stages", workers=1, progress=progress_lines(print)
    )
    print("\n".join(result.verdict.lines))
    judge(Site(result.map, tuple(result.drive.paths)), folder / "exports", parsed)


def judge(site: Site, folder: Path, parsed: argparse.Namespace) -> None:
    """Print the figures of a map of the rendered site, whose exports go into ``folder``."""
    graph = lane_graph(site.hd_map, site.trajectories)
    paint = painted_lines()
    by_paint = {name: painted(pairs_of_ends, paint) for name, pairs_of_ends in TRUTH.items()}
    print(f"{len(site.hd_map.markings)} markings, {len(site.hd_map.lanes)} lines")
    print(f"ends by the paint: {shown(scores(graph, by_paint))}")
    print(f"ends by the made lines: {shown(scores(graph, TRUTH))}")
    print("\n".join(foreign(site, graph, folder, parsed)))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--rendered", type=Path, metavar="FOLDER")
    parser.add_argument("--checker")
    parser.add_argument("--converter")
    parsed = parser.parse_args()
    (made if parsed.rendered is None else rendered)(parsed)


if __name__ == "__main__":
    main()

"""How much of a made site's lane graph is found, by the errors of map and drives: a crossing and a T.

``python -m tests.benchmarks.lane_graph --seeds 20 [--checker qc_opendrive] [--converter PYTHON]``: the lanes,
ways and questions found of the true ones, and false ones; the issues that ASAM's checker has with OpenDRIVE;
and, where ``opendrive2lanelet`` is installed for that PYTHON, how many pairs of a first and a last lane its
lanelets lead from and to, beside those of the graph. The site's lines are made, not mapped from images.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
import time
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from examples.lanes.site import made_site
from tests.topology.scenes import ENDS, LANES, UNDRIVEN, WAYS, lanes_of, matched, ways_of
from v2hdm.io.maps.opendrive import write_opendrive
from v2hdm.topology.build import lane_graph
from v2hdm.topology.graph import LaneGraph

_ERRORS_M = ((0.01, 0.1), (0.03, 0.2), (0.06, 0.3))  # of lines, and by which drives wander, m

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


def counts(found: list, truth: set) -> np.ndarray:
    """How many true ones were found, how many are true, and how many of those found are false."""
    places = matched(found, truth)
    return np.array([len(places - {None}), len(truth), len(found) - len(places - {None})])


def pairs(graph: LaneGraph) -> int:
    """How many pairs of a lane that none leads to and one that leads nowhere have a way between them."""
    reached = 0
    for start in range(len(graph.lanes)):
        pending, seen = [start] if not graph.before(start) else [], set()
        while pending:
            lane = pending.pop()
            if lane not in seen:
                seen.add(lane)
                pending += graph.after(lane)
        reached += sum(not graph.after(lane) for lane in seen)
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


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--checker")
    parser.add_argument("--converter")
    parsed = parser.parse_args()
    asked = {(ENDS[before], ENDS[after]) for before, after in UNDRIVEN}
    for sigma_m, wander_m in _ERRORS_M:
        totals = {name: np.zeros(3, dtype=int) for name in ("lanes", "ways", "questions")}
        checked = 0
        seconds = 0.0
        for seed in range(parsed.seeds):
            site = made_site(seed, sigma_m, wander_m=wander_m)
            begin_s = time.process_time()
            graph = lane_graph(site.hd_map, site.trajectories)
            seconds += time.process_time() - begin_s
            questions = [(q.place_map, q.to_map) for q in graph.questions if q.subject == "connection"]
            totals["lanes"] += counts(lanes_of(graph), LANES)
            totals["ways"] += counts(ways_of(graph), WAYS)
            totals["questions"] += counts(questions, asked)
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "site.xodr"
                write_opendrive(site.hd_map, path, graph)
                if parsed.checker:
                    checked += issues(path, parsed.checker)
                if parsed.converter and seed == 0:
                    command = [parsed.converter, "-c", _CONVERT, str(path)]
                    ran = subprocess.run(command, check=True, capture_output=True, text=True)
                    print("opendrive2lanelet: lanelets, pairs:", ran.stdout.strip(), "of", pairs(graph))
        figures = ", ".join(
            f"{name} {found}/{true} false {false}" for name, (found, true, false) in totals.items()
        )
        issued = f", issues {checked}" if parsed.checker else ""
        print(
            f"lines {sigma_m} m, drives {wander_m} m: {figures}{issued}, "
            f"{seconds / parsed.seeds:.2f} s a graph"
        )


if __name__ == "__main__":
    main()

"""Print the route between two places of a map's lanes, by the library that Autoware plans with.

``python examples/lanes/route.py FOLDER/map_lanelet2 X Y X Y`` takes local metres and needs ``lanelet2``.
"""

import sys
from pathlib import Path
from typing import Any

import lanelet2  # type: ignore[import-not-found,unused-ignore]
import yaml


def loaded(folder: Path) -> Any:
    """The lanelets of an export."""
    info = yaml.safe_load((folder / "map_projector_info.yaml").read_text())
    origin = info.get("map_origin", {"latitude": 0.0, "longitude": 0.0, "altitude": 0.0})
    place = lanelet2.io.Origin(origin["latitude"], origin["longitude"], origin["altitude"])
    projector = lanelet2.projection.LocalCartesianProjector(place)
    return lanelet2.io.load(str(folder / "lanelet2_map.osm"), projector)


def route(folder: Path, start: tuple[float, float], goal: tuple[float, float]) -> list[str]:
    """The lanelets of the shortest way, by id and turn; none where no way leads there."""
    lanelets = loaded(folder)
    rules = lanelet2.traffic_rules.create(
        lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Vehicle
    )
    graph = lanelet2.routing.RoutingGraph(lanelets, rules)
    ends = []
    for place in (start, goal):
        point = lanelet2.core.BasicPoint2d(*place)
        ((_, nearest),) = lanelet2.geometry.findNearest(lanelets.laneletLayer, point, 1)
        ends.append(nearest)
    way = graph.getRoute(*ends)
    if way is None:
        return []
    steps = []
    for lanelet in way.shortestPath():
        turns = "turn_direction" in lanelet.attributes  # what holds them has no get()
        steps.append(f"{lanelet.id} {lanelet.attributes['turn_direction']}" if turns else str(lanelet.id))
    return steps


if __name__ == "__main__":
    start_x, start_y, goal_x, goal_y = map(float, sys.argv[2:6])
    steps = route(Path(sys.argv[1]), (start_x, start_y), (goal_x, goal_y))
    print("\n".join(steps) or "no way leads there")

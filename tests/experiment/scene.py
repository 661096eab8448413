"""Records of made-up drives: five diamonds along a street, mapped with errors that are known."""

from typing import Any

import numpy as np

from v2hdm.experiment.plan import DriveConfig, ExperimentConfig, Site
from v2hdm.records import DIAMOND, LANE_LINE, HDMap, Lane, Marking, Truth

DIAMOND_CORNERS = np.array([[0.5, 0.0], [0.0, 0.25], [-0.5, 0.0], [0.0, -0.25]])
TRUE = DIAMOND_CORNERS + np.column_stack([5.0 + 4.0 * np.arange(5), np.full(5, 2.0)])[:, None]
CALIBRATED, ESTIMATED = "calibrated", "estimated"


def diamonds(corners: np.ndarray, lanes: tuple[Lane, ...] = ()) -> HDMap:
    return HDMap(tuple(Marking(DIAMOND, corners_of_one, 5) for corners_of_one in corners), lanes)


def shifted(metres: float, markings: int = 5) -> HDMap:
    """The first true markings, all of them too far east."""
    return diamonds(TRUE[:markings] + np.array([metres, 0.0]))


def record(port: str, seed: int | None, started_from: str, opt_m: float = 0.01) -> dict[str, Any]:
    """CNI is 2 cm off and has four of five markings, ENI 50 cm, ONI 2 cm, Opt ``opt_m``."""
    naive = {"CNI": shifted(0.02, 4), "ENI": shifted(0.5, 3), "ONI": shifted(0.02, 4)}
    maps = {
        name: {**naive, "Opt": shifted(opt_m, count), "Opt, paper": shifted(0.03, count)}
        for name, count in (("front", 4), ("rear", 4), ("both", 5))
    }
    route = np.column_stack([np.linspace(0, 25, 26), np.zeros(26)]).tolist()
    true = diamonds(TRUE, (Lane(LANE_LINE, np.array([[0.0, 1.0], [20.0, 1.0]]), 1),))
    return {
        "title": port if seed is None else f"{port} seed {seed}", "port": port, "seed": seed,
        "started_from": started_from, "route": route, "failures": [],
        "truth": Truth(true, {}, np.empty((0, 4, 4)), np.empty((0, len(TRUE))), (), {}),
        "maps": maps,
        "expected": {name: [True] * 5 for name in maps},
    }  # fmt: skip


def experiment(output: str, **changes: Any) -> ExperimentConfig:
    """An experiment on two recorded drives that are nowhere."""
    ports = {name: Site(drive=DriveConfig(path=f"absent/{name}")) for name in ("port1", "port2")}
    return ExperimentConfig(**{"ports": ports, "output": output, "workers": 1, **changes})

"""Records of made-up drives: five diamonds along a street, mapped with errors that are known."""

from typing import Any

import numpy as np

from v2hdm.experiment.drive import SETTING_FILE, recipe_file, recipe_key, setting_key, store
from v2hdm.experiment.plan import DriveConfig, ExperimentConfig, Job, Site
from v2hdm.records import DIAMOND

DIAMOND_CORNERS = np.array([[0.5, 0.0], [0.0, 0.25], [-0.5, 0.0], [0.0, -0.25]])
TRUE = DIAMOND_CORNERS + np.column_stack([5.0 + 4.0 * np.arange(5), np.full(5, 2.0)])[:, None]
CALIBRATED, ESTIMATED = "calibrated", "estimated"


def plain_map(corners: np.ndarray) -> dict[str, Any]:
    return {"kinds": [DIAMOND] * len(corners), "corners": corners.tolist(), "sightings": [5] * len(corners)}


def shifted(metres: float, markings: int = 5) -> dict[str, Any]:
    """The first true markings, all of them too far east."""
    return plain_map(TRUE[:markings] + np.array([metres, 0.0]))


def record(port: str, seed: int | None, started_from: str, opt_m: float = 0.01) -> dict[str, Any]:
    """CNI is 2 cm off and has four of five markings, ENI 50 cm, ONI 2 cm, Opt ``opt_m``."""
    naive = {"CNI": shifted(0.02, 4), "ENI": shifted(0.5, 3), "ONI": shifted(0.02, 4)}
    maps = {
        "front": {**naive, "Opt": shifted(opt_m, 4), "Opt, paper": shifted(0.03, 4)},
        "rear": {**naive, "Opt": shifted(opt_m, 4), "Opt, paper": shifted(0.03, 4)},
        "both": {**naive, "Opt": shifted(opt_m), "Opt, paper": shifted(0.03)},
    }
    field = {"median_px": [[1.0, 0.5]] * 40, "length_px": 1.2, "corners": 99}
    bins = {
        name: [[4.5, 0.01, 0.02, 0.03, 50.0], [5.5, 0.02, 0.03, 0.05, 50.0]] for name in ("CNI", "ENI", "Opt")
    }
    steps = [[2, 0.03], [5, 0.02]]
    errors = {"rotation_error_deg": 0.02, "translation_error_m": 0.01}
    far = {"rotation_error_deg": 2.0, "translation_error_m": 0.3}
    found = {"both": {"front": {"CNI": errors, "ENI": far, "Opt": errors}}}
    return {
        "port": port,
        "seed": seed,
        "cameras": {"front": camera(started_from)},
        "truth": plain_map(TRUE),
        "true_lanes": [[[0.0, 1.0], [20.0, 1.0]]],
        "route": np.column_stack([np.linspace(0, 25, 26), np.zeros(26)]).tolist(),
        "expected": {name: [True] * 5 for name in maps},
        "maps": maps,
        "lanes": {"Opt": [[[0.0, 1.01], [20.0, 1.01]]]},
        "growth": {"incremental": {"Opt": steps, "CNI": steps, "ENI": steps}},
        "extrinsics": {"ours": found, "paper": found},
        "residuals": {
            "front": {"field": {"size_px": [640, 480], "before": field, "after": field}, "range": bins}
        },
        "failures": [],
    }


def camera(started_from: str) -> dict[str, Any]:
    """A camera 2 m above the rear axle that looks 20 degrees down."""
    pitch = np.deg2rad(20.0)
    cam_from_vehicle = np.eye(4)
    cam_from_vehicle[:3, :3] = [
        [0.0, -1.0, 0.0],
        [-np.sin(pitch), 0.0, -np.cos(pitch)],
        [np.cos(pitch), 0.0, -np.sin(pitch)],
    ]
    cam_from_vehicle[:3, 3] = cam_from_vehicle[:3, :3] @ [0.0, 0.0, -2.0]
    return {
        "picture": "front.jpg",
        "info": {
            "name": "front",
            "width": 640,
            "height": 480,
            "intrinsic": [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]],
            "distortion_model": "plumb_bob",
            "distortion": [0.0] * 5,
        },
        "roi_vehicle": [[4.0, -2.0], [10.0, -2.0], [10.0, 2.0], [4.0, 2.0]],
        "initial_ipm": started_from,
        "ipm": {},
        "true_cam_from_vehicle": cam_from_vehicle.tolist(),
        "clicked_px": [[100.0, 300.0], [500.0, 320.0]],
        "surveyed_vehicle": [[5.0, 2.0], [5.0, -2.0]],
    }


def experiment(output: str, **changes: Any) -> ExperimentConfig:
    """An experiment on two recorded drives that are nowhere."""
    ports = {name: Site(drive=DriveConfig(path=f"absent/{name}")) for name in ("port1", "port2")}
    return ExperimentConfig(**{"ports": ports, "output": output, "workers": 1, **changes})


def keep(job: Job, plain: dict[str, Any]) -> None:
    """Store a record as the files of a finished drive."""
    own = ("maps", "growth", "extrinsics", "failures", "lanes", "residuals")
    store(job.folder / SETTING_FILE, setting_key(job), {k: v for k, v in plain.items() if k not in own})
    for recipe in job.options:
        maps = {
            name: {row: one for row, one in rows.items() if (row.split(", ")[1:] or ["ours"]) == [recipe]}
            for name, rows in plain["maps"].items()
        }
        found = {"maps": maps, "growth": plain["growth"].get(recipe, {}), "failures": []}
        found |= {"extrinsics": plain["extrinsics"].get(recipe, {}), "lanes": plain["lanes"]}
        found["residuals"] = plain["residuals"]
        store(job.folder / recipe_file(recipe), recipe_key(job, recipe), found)

"""The library's functions that have no stage or command: reading a map, stating a problem, rendering."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from v2hdm.doors import check_types, checked
from v2hdm.errors import MapFileError
from v2hdm.executor import open_executor
from v2hdm.io.drive import as_drive, join_drives, read_drive
from v2hdm.io.maps.reading import read_map as _read
from v2hdm.progress import Steps
from v2hdm.records import Drive, HDMap, ImageDetections
from v2hdm.settings import Processes, Tolerance
from v2hdm.store.names import map_file

if TYPE_CHECKING:  # load torch or scipy
    from v2hdm.adjust.problem import Problem
    from v2hdm.asbuilt.comparison import Comparison
    from v2hdm.mapping.options import MappingOptions
    from v2hdm.simulate.port.config import PortConfig


@checked
def read_map(path: str | Path) -> HDMap:
    """Read a map: the folder of a result, or a ``map.geojson`` or ``map.gpkg``, edited or not.

    Raises:
        MapFileError: the file is missing, damaged or in another format.
        ConfigError: what reads the format is not installed.

    >>> hd_map = read_map(result.save(folder / "mapped"))
    >>> len(hd_map.markings) == len(result.map.markings)
    True
    """
    path = Path(path)
    return _read(map_file(path))[0]


@checked
def compare_maps(
    built: HDMap,
    design: HDMap | str | Path,
    *,
    tolerance_m: Tolerance = 0.05,
    results: str | Path | None = None,
) -> Comparison:
    """Compare the paint of a map with its design: each shape is right, off, missing or not inspected.

    Args:
        built: the map.
        design: another map, or a file that holds the design: DXF, GeoJSON, GeoPackage or OpenDRIVE.
        tolerance_m: the largest offset, and difference of length or width, that conforms, m.
        results: the folder of the map's results, whose mosaic shows where paint is missing.

    Raises:
        MapFileError: the design is damaged, of another site, or in another datum.
        ConfigError: the design does not say its system, or what reads its format is not installed.

    >>> from v2hdm.asbuilt.decisions import Fate
    >>> comparison = compare_maps(result.map, result.map)
    >>> comparison.conforms, comparison.count(Fate.OFF)
    (True, 0)
    """
    from v2hdm.asbuilt.comparison import compare_with_design
    from v2hdm.asbuilt.decisions import Tolerances
    from v2hdm.asbuilt.design import design_of_map
    from v2hdm.asbuilt.ground import read_mosaic
    from v2hdm.asbuilt.reading import read_design

    if results is not None and not Path(results).is_dir():
        raise MapFileError(f"{results}: is not a result folder; give one, or leave results out")
    if isinstance(design, HDMap):
        meant = design_of_map(design, built.origin, "the design")
    else:
        meant = read_design(Path(design), built)
    mosaic = None if results is None else read_mosaic(Path(results))
    return compare_with_design(built, meant, Tolerances(tolerance_m, tolerance_m), mosaic)


@checked
def build_problem(
    drive: Drive, detections: Sequence[ImageDetections], options: MappingOptions | None = None
) -> Problem:
    """Set up the bundle adjustment of a drive: associated sightings, initial values and priors.

    Args:
        drive: the drive.
        detections: of its images.
        options: settings of association and adjustment.

    Returns:
        Cameras, frames and corners with their observations (recorded pixels, the lens undone) and priors.

    Raises:
        MappingError: there is nothing to map, or the detections belong to another drive.
        ConfigError: an option is wrong.

    >>> problem = build_problem(port, result.detections)
    >>> problem.map_from_vehicle.shape[1:], problem.cam_from_vehicle.shape
    ((4, 4), (1, 4, 4))
    >>> solve(problem).status.value
    'converged'
    """
    from v2hdm.association.sightings import check_detections
    from v2hdm.mapping.inputs import Inputs
    from v2hdm.mapping.options import MappingOptions, check_options

    options = options or MappingOptions()
    check_options(options)
    check_detections(as_drive(drive), detections)
    inputs = Inputs(drive, detections, tuple(drive.cameras), options)
    return inputs.optimiser.settle(inputs.tracks).problem


@checked
def simulate_port(
    folder: str | Path,
    config: PortConfig | None = None,
    *,
    workers: Processes = 1,
    progress: Steps | None = None,
) -> Drive:
    """Render a drive through a port, with ground truth, into a subfolder of ``folder``, unless it is there.

    Args:
        folder: parent of all rendered drives, such as ``cache``.
        config: the port; None takes a short one: 46 m, one camera with half the usual pixels.
        workers: processes to render in.
        progress: called as ``progress(done, total)`` images.

    Returns:
        The drive; a survey's drives are joined to one. Its truth is for evaluation only: mapping never
        looks at it.

    Raises:
        ConfigError: the settings do not describe a port.
        DriveError: the folder cannot be written.

    >>> drive = simulate_port(folder)
    >>> drive.name, list(drive.cameras), len(drive.images)
    ('port', ['front'], 22)
    """
    from v2hdm.simulate.survey.drive import simulated_drives

    config = config or _short_port()
    check_types(config, "config.")
    steps = progress or (lambda done, total: None)
    with open_executor(workers) as executor:
        folders = simulated_drives(config, Path(folder), executor, steps)
    return join_drives([read_drive(drive) for drive in folders])


def _short_port() -> PortConfig:
    from v2hdm.simulate.port.config import PortConfig, RouteConfig, YardConfig

    port = PortConfig(name="port", seed=11, initial_ipm="estimated")
    return replace(
        port,
        cameras={"front": replace(port.cameras["front"], width=640, height=360, focal_px=450.0)},
        route=RouteConfig(pieces=[[20.0, 0.0], [16.0, 70.0], [10.0, 0.0]], image_spacing_m=2.0),
        yard=YardConfig(parked_trucks=0, barriers=0, lamp_posts=0, moving_trucks=0, shadow_strips=1),
    )

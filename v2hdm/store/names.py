"""Names of the files in a result folder: whoever writes or reads one takes its name from here."""

from pathlib import Path

MAP = "map.geojson"  # the map in longitude and latitude, whatever other formats are exported
PROJECT = "map.qgs"  # the QGIS project over the map's GeoPackage
METRICS = "metrics.json"  # the figures, the verdict and the drive
CONFIG = "config.yaml"  # the settings that the result was made with
LOG = "run.log"  # the run's messages
REPORT = "report.html"  # the page
PAPER = "report.pdf"  # the document on paper
JOB = "job.json"  # what is stated of the survey: site, client, operator, ...
COVERAGE = "coverage.json"  # where the ground lies that the drive has seen
COVERAGE_CELLS = "coverage_cells.png"  # how often and how finely, cell by cell
VERDICT = "verdict.json"  # of the commands that make no map
EXCLUDED = "excluded.geojson"  # candidates that are not on the map, and why
CHANGES = "changes.geojson"  # what has changed since an earlier map
RESIDUALS = "residuals.csv"  # corner observations with their residuals
CHECK_POINTS = "check_points.csv"  # surveyed points that only check the map
GROUND = "ground.json"  # the surface that the drive has passed
MOSAIC = "mosaic.tif"  # the ground from above, for a GIS
MOSAIC_PICTURE = "mosaic.webp"  # the same for the page
MOSAIC_EXTENT = "mosaic.json"  # where the picture lies
COMPARISON = "mosaic_before_after.png"  # the richest place before and after the optimisation
AS_BUILT = "comparison.json"  # of v2hdm compare: what became of each shape of a design
AS_BUILT_TABLE = "comparison.csv"  # the same as a table
AS_BUILT_LAYER = "comparison.geojson"  # the same as a layer of a map
AS_BUILT_PICTURE = "comparison.png"  # the same, drawn
CALIBRATIONS = "calibration_*.yaml"  # the pattern of :func:`calibration_file`
TRAJECTORY = "trajectory.tum"  # adjusted poses of a result of one drive
TRAJECTORY_SIGMA = "trajectory_sigma.csv"  # their standard deviations
TRAJECTORIES = "trajectory*.tum"  # the pattern of these and of :func:`trajectory_files`


def map_file(path: Path) -> Path:
    """The map file of the result folder ``path``, or ``path`` itself if it is a file."""
    return path / MAP if path.is_dir() else path


def calibration_file(camera: str) -> str:
    """The calibration of a camera."""
    return f"calibration_{camera}.yaml"


def overlay_file(camera: str) -> str:
    """The picture of the map in an image of a camera."""
    return f"overlay_{camera}.png"


OVERLAYS = "overlay_*.png"  # the pattern of :func:`overlay_file`


def camera_of_overlay(path: Path) -> str:
    """The camera of a picture that has a name of :func:`overlay_file`."""
    return path.stem.removeprefix("overlay_")


def trajectory_files(session: str | None) -> tuple[str, str]:
    """The adjusted poses, and their standard deviations, of one of several sessions, or of the only one."""
    if session is None:
        return TRAJECTORY, TRAJECTORY_SIGMA
    return f"trajectory_{session}.tum", f"trajectory_{session}_sigma.csv"

"""docs/accuracy.md does what it says: control points mend a drifted map, check points only tell."""

import csv
import io
import json
import re
import shlex
import shutil
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from tests.docs.blocks import blocks
from tests.drive.example import description
from tests.ports import run_config
from v2hdm.cli.main import run as run_command
from v2hdm.errors import DriveError
from v2hdm.geometry.geodetic import geodetic_from_enu
from v2hdm.io.drive import read_drive
from v2hdm.io.drive.truth import read_truth
from v2hdm.io.trajectory import read_tum, write_tum
from v2hdm.mapping.options import MappingOptions, SurveyOptions
from v2hdm.pipeline.run import run
from v2hdm.records import Trajectory
from v2hdm.report.metrics import driven_past

(DOCUMENTED,) = blocks("docs/accuracy.md", "sh")
DRIFT_M = np.array([0.06, -0.05])
SIGMA_M = 0.005


@dataclass(frozen=True)
class Site:
    """A folder with ``drives/mysite``, whose receiver has drifted, and surveys of its painted corners."""

    folder: Path

    @property
    def drive(self):
        return self.folder / "drives/mysite"

    def config(self, output, survey):
        mapping, cache = MappingOptions(survey=survey), str(self.folder / "cache")
        return run_config(self.drive, output, mapping=mapping, all_maps=True, cache=cache)


def drifted(recorded):
    """Poses that are off by as much as 8 cm, more at the start than at the end."""
    poses = recorded.map_from_vehicle.copy()
    share = np.linspace(1.0, 0.6, len(poses))
    poses[:, :2, 3] += share[:, None] * DRIFT_M
    return Trajectory(recorded.stamp_s, poses)


def survey(corners_map, kinds, origin, check_off_m=0.0):
    """Every other point is a check point, those off by ``check_off_m`` more than their sigma."""
    rng = np.random.default_rng(8)
    measured = corners_map + SIGMA_M * rng.standard_normal(corners_map.shape)
    measured[1::2] += check_off_m
    positions = geodetic_from_enu(origin, np.column_stack([measured, np.zeros(len(measured))]))  # type: ignore[arg-type]
    rows = ["id,latitude_deg,longitude_deg,sigma_m,role,description"]
    for k, ((lat, lon, _), kind) in enumerate(zip(positions, kinds, strict=True)):
        rows.append(f"P{k},{lat:.10f},{lon:.10f},{SIGMA_M},{'check' if k % 2 else 'control'},{kind}")
    return "\n".join(rows) + "\n"


@pytest.fixture(scope="module")
def site(small_drive, tmp_path_factory):
    site = Site(tmp_path_factory.mktemp("site"))
    shutil.copytree(small_drive, site.drive)
    drive = read_drive(site.drive)
    truth = read_truth(drive)
    write_tum(drifted(read_tum(site.drive / "poses.tum")), site.drive / "poses.tum")
    noise = {"position_m": 0.062, "position_drift_m": 0.06, "position_drift_over_m": 150.0}
    with description(site.drive) as content:
        content["pose_noise"] |= noise
    driven_markings = [
        m
        for m, is_passed in zip(truth.map.markings, driven_past(drive, truth, ("front",)), strict=True)
        if is_passed
    ]
    chosen = np.random.default_rng(4).permutation(2 * len(driven_markings))[:20].tolist()
    corners = np.array([driven_markings[n // 2].corners_map[2 * (n % 2)] for n in chosen])
    kinds = [driven_markings[n // 2].kind for n in chosen]
    (site.folder / "points.csv").write_text(survey(corners, kinds, drive.origin))
    (site.folder / "moved.csv").write_text(survey(corners, kinds, drive.origin, check_off_m=-0.08))
    only_check = (site.folder / "points.csv").read_text().replace("control", "check")
    (site.folder / "check.csv").write_text(only_check)
    return site


@pytest.fixture(scope="module")
def documented(site):
    """The result of the documented command, with every map, and what it printed."""
    (command,) = DOCUMENTED.lines
    settings = ["all_maps=true", "mosaic=false", "workers=1", "output=outputs", "name=short"]
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()) as printed:
        patch.chdir(site.folder)
        assert run_command([*shlex.split(command)[1:], *settings]) in (0, 3)
    return site.folder / "outputs/short", printed.getvalue()


def figures(result):
    metrics = json.loads((result / "metrics.json").read_text())
    return dict(metrics["check_points"])


@pytest.mark.slow
def test_the_documented_command_ends_in_a_table_a_line_and_a_finding(documented):
    result, printed = documented
    with (result / "check_points.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["id"] for row in rows} == {f"P{k}" for k in range(1, 20, 2)}
    compared = [row for row in rows if row["dx_m"]]
    assert len(compared) == figures(result)["compared"] >= 6
    assert all(row["not_compared_because"] for row in rows if not row["dx_m"])
    squared = [float(row["dx_m"]) ** 2 + float(row["dy_m"]) ** 2 for row in compared]
    assert figures(result)["rmse_m"] == pytest.approx(np.sqrt(np.mean(squared)), abs=1e-4)
    assert re.search(r"check points: \d+ of 10 compared, RMSE \d", " ".join(printed.split()))
    verdict = json.loads((result / "metrics.json").read_text())["verdict"]
    passed = {finding["check"]: finding for finding in verdict["passed"]}
    assert {"check points", "survey frame", "surveyed points"} <= set(passed), verdict["findings"]


@pytest.mark.slow
def test_control_points_bring_check_points_down_to_what_map_and_survey_state(site, documented, tmp_path):
    mended = figures(documented[0])
    left = figures(run(site.config(tmp_path, SurveyOptions(file=str(site.folder / "check.csv")))).folder)
    assert left["points"] == 20
    assert left["rmse_m"] > 0.05
    assert mended["rmse_m"] < 0.5 * left["rmse_m"]
    # A drift that pose_noise knows of contradicts nothing, with control points or without.
    assert 0.3 < mended["nees"] < 2.0
    assert left["nees"] < 2.0


@pytest.mark.slow
def test_check_points_touch_no_part_of_the_map(site, documented, tmp_path):
    moved = run(site.config(tmp_path, SurveyOptions(file=str(site.folder / "moved.csv"))))
    names = ["trajectory.tum", "trajectory_sigma.csv", "excluded.geojson"]
    names += [f"maps/{path.name}" for path in (documented[0] / "maps").iterdir()]
    assert "maps/front_Opt.geojson" in names
    for name in names:
        assert (moved.folder / name).read_bytes() == (documented[0] / name).read_bytes(), name
    assert figures(moved.folder)["rmse_m"] > 0.1
    (finding,) = [candidate for candidate in moved.verdict.raised if candidate.check == "check points"]
    assert "another datum or origin" in finding.says


def test_a_survey_in_the_wrong_frame_is_refused_before_any_long_work(site, tmp_path):
    wrong = (site.folder / "points.csv").read_text().replace("latitude_deg,longitude_deg", "x_m,y_m")
    (tmp_path / "wrong.csv").write_text(wrong)
    with pytest.raises(DriveError, match=r"^[^\n]*none of its 20 .*: 20 would as latitude and longitude.*$"):
        run(site.config(tmp_path / "out", SurveyOptions(file=str(tmp_path / "wrong.csv"))))
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_control_points_that_match_no_corner_leave_the_map_in_the_frame_of_the_poses(site, tmp_path):
    unmatched = SurveyOptions(file=str(site.folder / "points.csv"), reach_m=1e-6)
    result = run(site.config(tmp_path, unmatched))
    assert "in the frame of the poses" in result.verdict.lines[0]


def test_a_survey_that_cannot_be_read_is_refused_before_the_drive_is(tmp_path):
    config = run_config(
        tmp_path / "no drive", tmp_path, mapping=MappingOptions(survey=SurveyOptions(file="none.csv"))
    )
    with pytest.raises(DriveError, match=r"none\.csv: no such file"):
        run(config)

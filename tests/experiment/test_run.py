"""An experiment's plan and figures; one that was stopped goes on, a finished one draws what it kept."""

import csv
import gzip

import cv2
import numpy as np
import pytest
from hydra import compose, initialize_config_dir

from tests.experiment.scene import CALIBRATED, ESTIMATED, TRUE, experiment, keep, plain_map, record
from tests.mapping.scene import SceneOptions, make_scene
from v2hdm.cli.compose import conf_dir, register, to_dataclass
from v2hdm.cli.main import run
from v2hdm.errors import ConfigError, DriveError
from v2hdm.experiment.drive import _content, drive_record, recipe_file, setting_key, store, stored
from v2hdm.experiment.measures import measure, residuals
from v2hdm.experiment.plan import ExperimentConfig, Site, jobs
from v2hdm.experiment.run import run_experiment
from v2hdm.experiment.summary import claims, words, write_tables
from v2hdm.mapping.methods import run_methods
from v2hdm.records import HdMap, Truth
from v2hdm.store.cache import key_of
from v2hdm.store.results import growing_folder


def composed(*overrides):
    register("experiment", ExperimentConfig)
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        return to_dataclass(compose("experiment", overrides=list(overrides)), ExperimentConfig, "")


def test_both_ports_are_driven_with_every_one_of_five_seeds():
    found = jobs(composed())
    assert {(job.port, job.seed) for job in found} == {
        (p, s) for p in ("port1", "port2") for s in range(1, 6)
    }
    assert all(job.site.simulate is not None and job.site.simulate.seed == job.seed for job in found)
    starts = {job.port: job.site.simulate.initial_ipm for job in found if job.site.simulate}
    assert starts == {"port1": "calibrated", "port2": "estimated"}
    assert len({job.folder for job in found}) == 10


def test_recipes_differ_in_what_they_are_named_for():
    options = jobs(composed())[0].options
    said = {name: (one.pose_model, one.loss, one.mode) for name, one in options.items()}
    assert (said["paper"], said["ours"]) == (("paper", "none", "batch"), ("auto", "cauchy", "batch"))
    assert said["incremental"][2] == "incremental"


def test_the_short_trial_shortens_both_routes():
    full, short = jobs(composed()), jobs(composed("+trial=short"))
    assert [job.title for job in short] == ["port1 seed 1", "port2 seed 1"]
    for job in (full[0], *short):
        assert job.site.simulate is not None
    lengths = [sum(piece[0] for piece in job.site.simulate.route.pieces) for job in (full[0], *short)]
    assert max(lengths[1:]) < 0.25 * lengths[0]


def test_a_recorded_drive_is_mapped_once_whatever_the_seeds():
    assert [job.title for job in jobs(experiment("out", seeds=[3, 4]))] == ["port1", "port2"]


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"seeds": []}, "seeds"),
        ({"seeds": [1, 1]}, "seeds"),
        ({"recipes": ["ours", "papers"]}, "papers"),
        ({"ports": {}}, "ports is empty"),
        ({"ports": {"port1": Site()}}, "ports.port1"),
        ({"ports": {"a/b": Site()}}, "a/b"),
        ({"name": ".."}, "name"),
        ({"workers": -1}, "workers"),
    ],
)
def test_what_cannot_be_mapped_is_named(changes, named):
    with pytest.raises(ConfigError, match=named):
        jobs(experiment("out", **changes))


def test_a_typo_on_the_command_line_is_one_line_that_names_the_key(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run(["experiment", "sedes=[1]"]) == 2
    error = capsys.readouterr().err
    assert (error.count("\n"), "did you mean seeds" in error) == (1, True)
    assert not list(tmp_path.iterdir())


def two_ports(opt_m=0.01):
    return [
        measure(record(port, seed, start, opt_m))
        for seed in (1, 2)
        for port, start in (("port1", CALIBRATED), ("port2", ESTIMATED))
    ]


def test_rows_hold_the_errors_that_were_put_in():
    rows = measure(record("port1", 1, CALIBRATED)).rows["both"]
    assert (rows["Opt"].markings, rows["CNI"].markings, rows["ENI"].markings) == (5, 4, 3)
    assert rows["Opt"].rmse_m == pytest.approx(0.01)
    assert rows["Opt"].bias_m == pytest.approx(0.01)
    assert rows["Opt"].spread_m == pytest.approx(0.0, abs=1e-9)
    assert (rows["Opt"].recall, rows["CNI"].recall) == (1.0, 0.8)


def test_shared_markings_are_those_that_every_method_has_mapped():
    plain = record("port1", 1, CALIBRATED)
    worse = TRUE + np.array([0.01, 0.0])
    worse[3:] += np.array([0.3, 0.0])  # the two that ENI lacks
    plain["maps"]["both"]["Opt"] = plain_map(worse)
    row = measure(plain).rows["both"]["Opt"]
    assert row.shared == 3
    assert row.shared_rmse_m == pytest.approx(0.01)
    assert row.rmse_m > 0.1


def test_errors_come_in_the_order_in_which_the_vehicle_passed():
    plain = record("port1", 1, CALIBRATED)
    shuffled = [3, 1, 4, 0, 2]
    plain["maps"]["both"]["Opt"] = plain_map(TRUE[shuffled] + 0.01)
    found = measure(plain).matched["both"]["Opt"]
    assert found.true.tolist() == [0, 1, 2, 3, 4]
    assert found.mapped.tolist() == [shuffled.index(n) for n in range(5)]


def test_claims_are_tested_where_the_start_of_the_port_allows_it():
    tested = claims(two_ports())
    assert {c.where.split(",")[0] for c in tested if "Opt / CNI" in c.text} == {"port1"}
    assert {c.where.split(",")[0] for c in tested if "ENI / Opt" in c.text} == {"port2"}
    ratio = next(c for c in tested if "ENI / Opt" in c.text)
    assert ratio.values == pytest.approx((50.0, 50.0))
    assert all(c.holds for c in tested)


def test_what_disagrees_with_the_paper_is_said_plainly():
    measured = two_ports(opt_m=0.07)
    text = words(measured, experiment("out"))
    broken = [c for c in claims(measured) if not c.holds]
    assert {c.text.rsplit(": ", 1)[1] for c in broken} == {"Opt / CNI", "ENI / Opt"}
    assert f"**{len(broken)} of {len(claims(measured))} figures disagree with the paper's claims:**" in text
    for claim in broken:
        assert f"- {claim.where}: {claim.text} is {claim.figure}, asked was {claim.limit}" in text
    assert "All 14 figures agree" in words(two_ports(), experiment("out"))


def test_a_recipe_of_which_no_map_came_is_told():
    plain = record("port1", 1, CALIBRATED)
    plain["failures"] = [["paper", "rear", "nothing to map"]]
    del plain["maps"]["rear"]["Opt, paper"]
    text = words([measure(plain)], experiment("out"))
    assert "- port1 seed 1, rear, recipe paper: nothing to map" in text


def test_tables_are_written_for_spreadsheets_and_papers(tmp_path):
    write_tables(tmp_path, two_ports())
    with (tmp_path / "results.csv").open() as stream:
        lines = list(csv.DictReader(stream))
    assert len(lines) == 4 * 3 * 5
    opt = next(line for line in lines if (line["port"], line["method"]) == ("port1", "Opt"))
    assert float(opt["RMSE (cm)"]) == pytest.approx(1.0)
    latex = (tmp_path / "results.tex").read_text()
    assert latex.startswith(r"\begin{tabular}")
    assert r"1.0 $\pm$ 0.0" in latex
    columns = {line.count("|") for line in (tmp_path / "results.md").read_text().splitlines()}
    assert len(columns) == 1
    assert "Opt, paper" in (tmp_path / "calibrations.md").read_text()


def finished(output):
    """An experiment whose drives are finished, and nowhere to be read again."""
    config = experiment(str(output))
    with growing_folder(output / config.name, "output="):
        for job, start in zip(jobs(config), (CALIBRATED, ESTIMATED), strict=True):
            keep(job, record(job.port, job.seed, start))
            cv2.imwrite(str(job.folder / "front.jpg"), np.full((480, 640, 3), 90, np.uint8))
    return config


@pytest.mark.slow
def test_finished_drives_are_never_opened_again(tmp_path):
    folder, measured = run_experiment(finished(tmp_path), "name: x\n", lambda *_: None)
    assert [one.title for one in measured] == ["port1", "port2"]
    captions = (folder / "figures.md").read_text()
    pictures = sorted(path.name for path in folder.glob("*.png"))
    of_ports = ("map", "eni_oni", "calibration", "reprojection")
    expected = {f"{kind}_{port}.png" for kind in of_ports for port in ("port1", "port2")}
    assert set(pictures) == expected | {"corners.png", "growth.png", "range.png", "bias_spread.png"}
    for name in pictures:
        assert f"![{name}]({name})" in captions
        image = cv2.imread(str(folder / name))
        assert len(np.unique(image.reshape(-1, 3), axis=0)) > 10
    assert "All 14 figures agree" in (folder / "experiment.md").read_text()


@pytest.mark.parametrize("name", ["config.yaml", "results.csv", "drives/port1/front.jpg"])
def test_a_folder_with_files_of_the_users_is_refused(tmp_path, name):
    mine = tmp_path / experiment(str(tmp_path)).name / name
    mine.parent.mkdir(parents=True)
    mine.write_text("mine")
    with pytest.raises(ConfigError, match="no results of ours"):
        run_experiment(experiment(str(tmp_path)), "", lambda *_: None)
    assert mine.read_text() == "mine"


def test_another_setting_takes_nothing_from_an_earlier_run(tmp_path):
    config = finished(tmp_path)
    config.mapping.max_range_m = 12.0
    with pytest.raises(DriveError, match="absent"):
        run_experiment(config, "", lambda *_: None)


def test_the_files_of_a_drive_make_up_its_record(tmp_path):
    job, expected = jobs(finished(tmp_path))[0], record("port1", None, CALIBRATED)
    found = drive_record(job, 1, lambda *_: None)
    assert {key: found[key] for key in expected if key != "extrinsics"} == {
        key: expected[key] for key in expected if key != "extrinsics"
    }
    assert {recipe: one for recipe, one in found["extrinsics"].items() if one} == expected["extrinsics"]


def test_only_the_recipe_that_is_missing_is_mapped_anew(tmp_path):
    config = finished(tmp_path)
    (jobs(config)[0].folder / recipe_file("incremental")).unlink()
    config.recipes = ["paper"]
    assert drive_record(jobs(config)[0], 1, lambda *_: None)["port"] == "port1"
    config.recipes = ["paper", "incremental"]
    with pytest.raises(DriveError, match="absent"):
        drive_record(jobs(config)[0], 1, lambda *_: None)


def test_a_drive_whose_files_have_changed_is_another_one(tmp_path):
    job = jobs(finished(tmp_path))[0]
    job.site.simulate, job.site.drive.path = None, str(tmp_path / "drive")
    keys = []
    for text in ("1 2 3", "1 2 4", "1 2 3"):
        (tmp_path / "drive").mkdir(exist_ok=True)
        (tmp_path / "drive" / "poses.tum").write_text(text)
        _content.cache_clear()
        keys.append(setting_key(job))
    assert keys[0] != keys[1]
    assert keys[0] == keys[2]


@pytest.mark.parametrize("damage", ["cut", "text", "other"])
def test_a_damaged_file_or_one_of_another_key_counts_as_absent(damage, tmp_path):
    path = tmp_path / "found.json.gz"
    store(path, key_of(1), {"a": 1})
    assert stored(path, key_of(1)) == {"a": 1}
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:-9])
    elif damage == "text":
        path.write_bytes(gzip.compress(b"[1]"))
    assert stored(path, key_of(2) if damage == "other" else key_of(1)) is None


def test_residuals_and_errors_fall_to_the_noise_under_the_optimised_calibration():
    """0.25 px of noise in the corners, 1.5 degrees and 0.3 m in the first IPMs."""
    scene = make_scene(SceneOptions(length_m=60.0, jitter_deg=0.02, heading_deg=0.01, rtk_m=0.002))
    methods = run_methods(scene.drive, scene.detections, ("front", "rear"))
    poses = np.array([image.map_from_vehicle for image in scene.drive.images])
    truth = Truth(HdMap(tuple(scene.markings)), scene.cam_from_vehicle, poses, np.empty((0, 0)), (), {})
    for found in residuals(scene.drive, scene.detections, methods, truth).values():
        assert found["field"]["before"]["length_px"] > 5.0
        assert found["field"]["after"]["length_px"] < 1.0
        medians_m = np.array([bin_[2] for bin_ in found["range"]["Opt"]])
        assert np.median(medians_m) < 0.03

"""An experiment's plan and figures; one that was stopped goes on, a finished one draws what it kept."""

import csv

import cv2
import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from matplotlib.colors import to_rgb

from tests.experiment.scene import CALIBRATED, ESTIMATED, TRUE, diamonds, experiment, record
from v2hdm.cli.compose import conf_dir, register, to_dataclass
from v2hdm.cli.main import run
from v2hdm.errors import ConfigError
from v2hdm.experiment.drive import drive_record, measure
from v2hdm.experiment.paper import load_paper
from v2hdm.experiment.plan import ExperimentConfig, Site, jobs
from v2hdm.experiment.run import run_experiment
from v2hdm.pipeline.config import DriveConfig
from v2hdm.report import style

PAPER = load_paper()


def rgb(method):
    return [round(255 * part) for part in to_rgb(style.METHOD[method])]


def composed(*overrides):
    register("experiment", ExperimentConfig)
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        return to_dataclass(compose("experiment", overrides=list(overrides)), ExperimentConfig, "")


def test_both_ports_are_driven_with_every_one_of_five_seeds():
    all_jobs = jobs(composed())
    assert {(job.port, job.seed) for job in all_jobs} == {
        (p, s) for p in ("port1", "port2") for s in range(1, 6)
    }
    assert all(job.site.simulate is not None and job.site.simulate.seed == job.seed for job in all_jobs)
    starts = {job.port: job.site.simulate.initial_ipm for job in all_jobs if job.site.simulate}
    assert starts == {"port1": "calibrated", "port2": "estimated"}


def test_recipes_differ_in_what_they_are_named_for():
    options = jobs(composed())[0].options
    said = {
        name: (solve_options.pose_model, solve_options.loss, solve_options.mode)
        for name, solve_options in options.items()
    }
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
    plain["maps"]["both"]["Opt"] = diamonds(worse)
    row = measure(plain).rows["both"]["Opt"]
    assert row.shared == 3
    assert row.shared_rmse_m == pytest.approx(0.01)
    assert row.rmse_m > 0.1


def test_errors_come_in_the_order_in_which_the_vehicle_passed():
    plain = record("port1", 1, CALIBRATED)
    shuffled = [3, 1, 4, 0, 2]
    plain["maps"]["both"]["Opt"] = diamonds(TRUE[shuffled] + 0.01)
    matched = measure(plain).matched["both"]["Opt"]
    assert matched.true.tolist() == [0, 1, 2, 3, 4]


def test_claims_are_tested_where_the_start_of_the_port_allows_it():
    tested = PAPER.claims(two_ports())
    assert {c.where.split(",")[0] for c in tested if "Opt / CNI" in c.text} == {"port1"}
    assert {c.where.split(",")[0] for c in tested if "ENI / Opt" in c.text} == {"port2"}
    ratio = next(c for c in tested if "ENI / Opt" in c.text)
    assert ratio.values == pytest.approx((50.0, 50.0))
    assert all(c.holds for c in tested)


def test_what_disagrees_with_the_paper_is_said_plainly():
    measured = two_ports(opt_m=0.07)
    text = PAPER.words(measured, experiment("out"))
    broken = [c for c in PAPER.claims(measured) if not c.holds]
    assert {c.text.rsplit(": ", 1)[1] for c in broken} == {"Opt / CNI", "ENI / Opt"}
    assert (
        f"**{len(broken)} of {len(PAPER.claims(measured))} figures disagree with the paper's claims:**"
        in text
    )
    for claim in broken:
        assert f"- {claim.where}: {claim.text} is {claim.figure}, asked was {claim.limit}" in text
    assert "All 14 figures agree" in PAPER.words(two_ports(), experiment("out"))


def test_a_recipe_of_which_no_map_came_is_told():
    plain = record("port1", 1, CALIBRATED)
    plain["failures"] = [["paper", "rear", "nothing to map"]]
    del plain["maps"]["rear"]["Opt, paper"]
    text = PAPER.words([measure(plain)], experiment("out"))
    assert "- port1 seed 1, rear, recipe paper: nothing to map" in text


def test_tables_are_written_for_spreadsheets_and_papers(tmp_path):
    PAPER.write_tables(tmp_path, two_ports())
    with (tmp_path / "results.csv").open() as stream:
        lines = list(csv.DictReader(stream))
    assert len(lines) == 4 * 3 * 5
    opt = next(line for line in lines if (line["port"], line["method"]) == ("port1", "Opt"))
    assert float(opt["RMSE (cm)"]) == pytest.approx(1.0)
    rows = [line for line in (tmp_path / "results.tex").read_text().splitlines() if line.endswith(r"\\")]
    assert len({line.count(" & ") for line in rows}) == 1
    assert any("Opt, paper" in line for line in rows)


def test_what_latex_would_take_for_a_command_is_a_letter_in_a_table():
    text = PAPER.latex(["port", "RMSE (cm)"], [["a_b & 5 %", "1.0 +- 0.2"], ["other", r"\x"]])
    assert r"a\_b \& 5 \% & 1.0 $\pm$ 0.2 \\" in text
    assert r"\textbackslash{}x" in text
    assert text.startswith("\\begin{tabular}{lr}\n\\toprule\nport & RMSE (cm)")
    assert text.count("\\midrule") == 2


@pytest.mark.slow
def test_an_experiment_is_tables_figures_and_text_of_its_drives(tmp_path, monkeypatch):
    starts = {"port1": CALIBRATED, "port2": ESTIMATED}
    made_up = lambda job, *_: record(job.port, job.seed, starts[job.port])  # noqa: E731
    monkeypatch.setattr("v2hdm.experiment.run.drive_record", made_up)
    folder, measured = run_experiment(experiment(str(tmp_path)), "name: x\n", lambda *_: None)
    assert [drive.title for drive in measured] == ["port1", "port2"]
    captions = (folder / "figures.md").read_text()
    pictures = sorted(path.name for path in folder.glob("*.png"))
    assert set(pictures) == {"eni_oni_port1.png", "eni_oni_port2.png", "corners.png"}
    for name in pictures:
        assert f"![{name}]({name})" in captions
        image = cv2.imread(str(folder / name))
        assert len(np.unique(image.astype(np.uint32) @ np.array([1, 256, 65536], dtype=np.uint32))) > 10
    for said, method in (("(ENI, vermillion)", "ENI"), ("(ONI, green)", "ONI")):  # and nothing else is
        assert said in captions
        painted = np.all(cv2.imread(str(folder / "eni_oni_port1.png"))[..., ::-1] == rgb(method), axis=2)
        assert painted.sum() > 100
    assert "All 14 figures agree" in (folder / "experiment.md").read_text()


@pytest.mark.parametrize("name", ["config.yaml", "results.csv"])
def test_a_folder_with_files_of_the_users_is_refused(tmp_path, name):
    mine = tmp_path / experiment(str(tmp_path)).name / name
    mine.parent.mkdir(parents=True)
    mine.write_text("mine")
    with pytest.raises(ConfigError, match="did not write"):
        run_experiment(experiment(str(tmp_path)), "", lambda *_: None)
    assert mine.read_text() == "mine"


@pytest.mark.slow
def test_a_drive_is_mapped_by_every_recipe_and_its_stages_are_kept(tiny_drive, tmp_path):
    ports = {"small": Site(drive=DriveConfig(path=str(tiny_drive)))}
    config = experiment("out", ports=ports, recipes=["paper"], cache=str(tmp_path))
    (job,) = jobs(config)
    messages: list[tuple[str, int, int]] = []
    record = drive_record(job, lambda *message: messages.append(message))
    rows = measure(record).rows["front"]
    assert set(rows) >= {"Opt", "ONI", "Opt, paper", "ONI, paper"}
    assert not record["failures"]
    assert rows["Opt"].recall > 0.8
    assert rows["Opt"].rmse_m < rows["ENI"].rmse_m
    assert ("detect", 0, len(record["route"])) in messages

    messages.clear()
    again = drive_record(job, lambda *message: messages.append(message))
    assert repr(again) == repr(record)
    assert ("detect", len(record["route"]), len(record["route"])) in messages
    assert ("detect", 0, len(record["route"])) not in messages

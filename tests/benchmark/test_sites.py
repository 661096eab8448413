"""The sites of the benchmark stay as they are, and no truth reaches a mapper."""

from pathlib import Path

import numpy as np
import pytest

from tests.ports import small_port
from v2hdm.benchmark.sites import (
    Site,
    all_sites,
    input_hash,
    reference_of,
    site_of,
    truth_hash,
    write_input,
)
from v2hdm.errors import ConfigError
from v2hdm.executor import HERE
from v2hdm.io.drive import read_drive
from v2hdm.io.drive.truth import has_truth, read_truth
from v2hdm.progress import silent
from v2hdm.report.metrics import driven_past
from v2hdm.simulate.port.config import PortConfig, SurveyConfig
from v2hdm.simulate.port.drive import folder_of_port, true_drive


def quiet(finished, total):
    """Progress that nobody sees."""


@pytest.fixture(scope="module")
def tiny():
    config = PortConfig(name="street", seed=5, survey=SurveyConfig(length_km=0.06, drives=1))
    return Site("street", "60 m of street", config, "", "")


@pytest.fixture(scope="module")
def made(tiny, tmp_path_factory):
    folder = tmp_path_factory.mktemp("benchmark") / "street"
    folder.mkdir()
    write_input(tiny, folder, folder.parent / "cache", HERE, quiet)
    return folder


def test_a_mapper_gets_a_drive_without_truth(made):
    drive = read_drive(made)
    assert drive.images
    assert drive.truth_dir is None
    assert not has_truth(drive)
    assert not [path for path in made.rglob("*") if "truth" in path.name]
    assert "truth" not in (made / "drive.yaml").read_text()


def test_equal_seeds_make_equal_drives_and_any_change_is_seen(tiny, made, tmp_path):
    again = tmp_path / "again"
    again.mkdir()
    write_input(tiny, again, tmp_path / "cache", HERE, quiet)
    assert input_hash(again) == input_hash(made)
    listing = next(again.rglob("images.txt"))
    listing.write_text(listing.read_text() + "\n")
    assert input_hash(again) != input_hash(made)


def test_the_truth_of_a_survey_is_that_of_the_drive_that_was_made(tiny, made, tmp_path):
    reference = reference_of(tiny, tmp_path, HERE, silent)
    (beside,) = (made.parent / "cache").glob("street-*")
    drive = read_drive(beside)
    truth = read_truth(drive)
    np.testing.assert_array_equal(reference.expected, driven_past(drive, truth, tuple(drive.cameras)))
    assert reference.expected.any()
    assert truth_hash(reference) == truth_hash(reference_of(tiny, tmp_path, HERE, silent))


def test_the_truth_of_a_port_needs_no_rendering(small_drive):
    rendered = read_drive(small_drive)
    written = read_truth(rendered)
    drive, truth = true_drive(small_port())
    np.testing.assert_allclose(truth.visibility, written.visibility, atol=1e-4)
    assert len(truth.map.markings) == len(written.map.markings)
    cameras = tuple(drive.cameras)
    np.testing.assert_array_equal(driven_past(drive, truth, cameras), driven_past(rendered, written, cameras))


@pytest.mark.parametrize(
    ("name", "folder"),
    [("port1", "port1-5d7a6df912"), ("port2", "port2-57071ab87e"), ("streets", "streets-533ca10983")],
)
def test_the_settings_of_a_site_stay_as_they_are(name, folder):
    assert folder_of_port(site_of(name).config, Path()).name == folder


def test_the_truth_of_the_streets_is_as_published(tmp_path):
    site = site_of("streets")
    assert truth_hash(reference_of(site, None, HERE, silent)) == site.truth_sha256


def test_every_site_has_published_hashes():
    for site in all_sites().values():
        assert len(site.input_sha256) == len(site.truth_sha256) == 64


def test_an_unknown_site_is_named():
    with pytest.raises(
        ConfigError, match="'port3': is not a site of the benchmark; choose from port1, port2, streets"
    ):
        site_of("port3")

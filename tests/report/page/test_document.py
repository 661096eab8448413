"""The document that a surveyor signs: what he looks for is in the page and on paper."""

import json
import re
from contextvars import Context
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from tests.report.page.folder import PLACES, make_result
from v2hdm.cli.main import run
from v2hdm.geometry.geodetic import Grid
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.maps.reading import read_geojson
from v2hdm.records import GeodeticOrigin, Reception
from v2hdm.report.coverage import coverage_of, write_coverage
from v2hdm.report.job import Job, StatedJob, read_job, write_job
from v2hdm.report.page.document import document, paper_text, write_page
from v2hdm.report.page.facts import read_cameras, read_facts
from v2hdm.store.files import file_digest, write_json
from v2hdm.store.results import added_to, files_of_result

HAMBURG = GeodeticOrigin(53.5, 9.9, 12.0, "ETRS89", 2015.5)
DAY_S = datetime(2026, 5, 17, 8, 30, tzinfo=UTC).timestamp()
JOB = Job(site="Quay 7", client="Port of Somewhere", operator="R. Meier", receiver="mosaic-X5, SAPOS",
          geoid="GCG2016")  # fmt: skip
AXIS_MM = 1e-3


def make_survey(folder):
    """A result on the earth, of a dated drive whose receiver says how often it was fixed."""
    drive = make_result(folder)
    result = folder / "result"
    images = [replace(image, stamp_s=DAY_S + 0.2 * n) for n, image in enumerate(drive.images)]
    dated = replace(drive, images=images, reception=Reception(200, 199, 39.5))
    with added_to(result, "RESULT"):
        hd_map = read_geojson(result / "map.geojson")
        Context().run(write_geojson, replace(hd_map, origin=HAMBURG), result / "map.geojson", None)
        write_job(result, StatedJob(JOB))
        mountings = {
            name: camera.calibration.cam_from_vehicle for name, camera in read_cameras(result).items()
        }
        write_coverage(result, coverage_of(dated, mountings))
    return result, dated


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    return make_survey(tmp_path_factory.mktemp("survey"))


def ten_things():
    """A pattern of each, as the document states it of :func:`survey`."""
    east, north = Grid("EPSG:25832", HAMBURG).positions(np.array([[*PLACES[0], 0.0]]))[0, :2]
    return {
        "CRS": r"ETRS89 / UTM zone 32N \(EPSG:25832\)",
        "datum": r"European Terrestrial Reference System 1989",
        "epoch": r"Epoch\s+2015\.5",
        "geoid": r"GCG2016; recorded heights above sea level were raised by 39\.500\s+m",
        "date": r"2026-05-17, 08:30 to 08:30 UTC",
        "RTK share": r"99\.5 % of 200 recorded",
        "GSD": r"Ground sample\s+distance\s+\d+ mm",
        "area": r"[\d,]+ m² covered by three images or more",
        "coordinates": rf"{east:.3f}\s+{north:.3f}",
        "signatures": r"Surveyor.*Signature.*Checked by.*Client",
    }


def plain(html):
    """The words of a page, without its markup and its scripts."""
    html = re.sub(r"<(script|style|svg).*?</\1>", " ", html, flags=re.DOTALL)
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", html)).replace("&#39;", "'")


def test_all_ten_things_that_a_surveyor_looks_for_are_in_the_page(survey):
    result, drive = survey
    text = write_page(result, drive).read_text()
    words = plain(text)
    # The page's script fills the table of markings.
    (data,) = re.findall(r'id="map-data">(.*?)</script>', text)
    words += " ".join(" ".join(marking["at"]) for marking in json.loads(data)["markings"])
    missing = [thing for thing, pattern in ten_things().items() if not re.search(pattern, words, re.DOTALL)]
    assert missing == []


def test_all_ten_things_that_a_surveyor_looks_for_are_on_paper(survey, tmp_path):
    pypdf = pytest.importorskip("pypdf")
    pytest.importorskip("weasyprint")
    from v2hdm.report.paper import write_paper

    result, drive = survey
    pages = [page.extract_text() for page in pypdf.PdfReader(write_paper(result, drive)).pages]
    words = re.sub(r"\s+", " ", " ".join(pages))
    missing = [thing for thing, pattern in ten_things().items() if not re.search(pattern, words, re.DOTALL)]
    assert missing == []
    assert all(len(page.splitlines()) > 3 for page in pages)


def test_what_nobody_has_stated_says_so(tmp_path):
    drive = make_result(tmp_path)
    page = document(read_facts(tmp_path / "result", drive))
    survey = dict(page.identity.survey)
    assert {survey[name] for name in ("Site", "Client", "Operator", "Receiver")} == {"not stated"}
    assert survey["Date of the drive"] == (
        "not stated: the drive's times are not dates, but 10.0 s to 10.8 s"
    )
    assert survey["RTK-fixed positions"].startswith("not stated")
    system = dict(page.identity.system)
    assert "whose place on the earth the drive does not state" in system["Horizontal CRS"]
    assert system["Epoch"] == "not stated"


def test_paper_has_every_marking_once_with_its_coordinates(survey):
    result, drive = survey
    page = document(read_facts(result, drive))
    hd_map = page.facts.hd_map
    assert [row[0] for row in page.listing.rows] == [
        str(feature.id) for feature in (*hd_map.markings, *hd_map.symbols)
    ]
    first, second = (float(cell) for cell in page.listing.rows[1][3:5])
    true = Grid("EPSG:25832", HAMBURG).positions(np.array([[*PLACES[1], 0.0]]))[0]
    assert (first, second) == pytest.approx(true[:2], abs=AXIS_MM)
    text = paper_text(result, drive)
    assert "not stated: make the report again" not in text


def test_the_appendix_alone_has_probabilities_and_none_reads_zero(survey):
    result, drive = survey
    text = paper_text(result, drive)
    before, after = text.split("<h2>Appendix</h2>")
    assert "&lt; 0.001" in after
    assert "&lt; 0.001" not in before
    assert ">0.000<" not in text


def test_no_caption_names_a_file_of_the_cache(survey):
    result, drive = survey
    for text in (write_page(result, drive).read_text(), paper_text(result, drive)):
        captions = re.findall(r"<figcaption>(.*?)</figcaption>", text, re.DOTALL)
        assert captions
        assert not [caption for caption in captions if re.search(r"cache|\.png|\.jpg|/", caption)]


def test_what_was_stated_once_stays_and_a_system_that_does_not_fit_is_one_line(tmp_path, capsys):
    result, _ = make_survey(tmp_path)
    assert run(["report", str(result), "--client", "Another"]) == 0
    assert read_job(result) == StatedJob(replace(JOB, client="Another"))
    capsys.readouterr()
    assert run(["report", str(result), "--crs", "EPSG:32633"]) == 2
    said = capsys.readouterr().err.splitlines()
    assert "EPSG:32633 is on WGS84, the map on ETRS89" in said[-1]
    assert read_job(result).crs is None
    assert run(["report", str(result), "--epoch", "1989"]) == 2
    assert "the drive's epoch is 2015.5, the report's 1989" in capsys.readouterr().err
    assert run(["report", str(result), "--site", "a\nb"]) == 2
    assert "--site: give one line of 1 to 200 letters" in capsys.readouterr().err


def test_what_is_stated_is_a_file_of_the_result_which_the_next_run_may_replace(tmp_path):
    make_result(tmp_path)
    result = tmp_path / "result"
    assert run(["report", str(result), "--site", "Quay 8"]) == 0
    assert files_of_result(result)["job.json"] == file_digest(result / "job.json")
    assert run(["report", str(result), "--site", "Quay 9", "--crs", "nowhere"]) == 2
    assert read_job(result).job.site == "Quay 8"
    assert files_of_result(result)["job.json"] == file_digest(result / "job.json")


def test_without_weasyprint_the_report_says_what_to_install(survey, capsys, monkeypatch):
    import sys

    result, _ = survey
    monkeypatch.setitem(sys.modules, "weasyprint", None)
    assert run(["report", str(result), "--pdf"]) == 2
    said = capsys.readouterr().err
    assert said == "error: --pdf needs weasyprint: install the pdf extra, pip install 'v2hdm[pdf]'\n"


def test_a_comparison_joins_the_document(survey, tmp_path):
    result, drive = survey
    finding = {"fate": "off", "class": "diamond", "id": 3, "design": "P7", "across_m": 0.072,
               "across_sigma_m": 0.004, "across_probability": 1.0}  # fmt: skip
    whole = {"lies_off": True, "shift_m": [-0.349, 0.199], "turn_deg": 0.005}
    content = {"source": "/data/quay.dxf", "counts": {"right": 3, "off": 1}, "design_as_a_whole": whole,
               "findings": [{"fate": "right", "class": "diamond"}, finding]}  # fmt: skip
    write_json(tmp_path / "comparison.json", content)
    words = plain(write_page(result, drive, comparison=tmp_path).read_text())
    assert "the paint is −34.9 cm east and 19.9 cm north of it" in words
    assert "off diamond 3 P7 across 7.2 ± 0.4 cm" in words
    assert "quay.dxf" in words
    assert "/data" not in words

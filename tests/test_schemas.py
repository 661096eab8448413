"""The schemas with which editors complete ``drive.yaml`` and run files."""

import json
from copy import deepcopy

import fastjsonschema
import pytest
import yaml

from tests.docs.blocks import ROOT, blocks, module_at
from v2hdm.cli.compose import conf_dir

SCHEMAS = conf_dir() / "schema"
ACCEPTS = {
    name: fastjsonschema.compile(json.loads((SCHEMAS / f"{name}.json").read_text()))
    for name in ("drive", "run")
}
RUN_FILES = [*sorted((ROOT / "conf" / "run").glob("*.yaml")), ROOT / "docs/own-class/run/ownport.yaml"]


def test_the_schemas_are_those_of_the_declarations():
    for path, text in module_at(ROOT / "docs" / "tools" / "schemas.py").files().items():
        assert path.read_text() == text, "declarations have changed: python docs/tools/schemas.py"


@pytest.mark.parametrize("path", RUN_FILES, ids=lambda path: path.stem)
def test_the_shipped_run_files_are_accepted(path):
    content = yaml.safe_load(path.read_text())
    assert ACCEPTS["run"](content) == content


@pytest.mark.parametrize("name", ["docs/drive-format.md", "docs/bags.md"])
def test_the_documented_drives_are_accepted(name):
    content = yaml.safe_load(blocks(name, "yaml")[0].text)
    assert ACCEPTS["drive"](content) == content


@pytest.mark.parametrize(
    ("keys", "value"),
    [
        (("mapping", "max_rnge_m"), 12.0),
        (("mapping", "max_range_m"), 0.0),
        (("mapping", "max_range_m"), "far"),
        (("mapping", "mode"), "batch"),
        (("simulate", "cameras", "front", "width"), 10),
        (("export",), "gpkg"),
    ],
)
def test_a_typo_in_a_run_file_is_refused(keys, value):
    content = yaml.safe_load((ROOT / "conf/run/port2.yaml").read_text())
    place = content
    for key in keys[:-1]:
        place = place.setdefault(key, {})
    place[keys[-1]] = value
    with pytest.raises(fastjsonschema.JsonSchemaException):
        ACCEPTS["run"](content)


@pytest.mark.parametrize(
    ("camera", "value"),
    [("mountng", {}), ("read_out_s", -0.1), ("images", {"folder": "a", "stamp": "b"}), ("camera_info", None)],
)
def test_a_typo_in_a_drive_is_refused(camera, value):
    content = deepcopy(yaml.safe_load(blocks("docs/drive-format.md", "yaml")[0].text))
    content["cameras"]["front"][camera] = value
    with pytest.raises(fastjsonschema.JsonSchemaException):
        ACCEPTS["drive"](content)

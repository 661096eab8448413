"""From a result back to its drive."""

from __future__ import annotations

from pathlib import Path

import pytest
from omegaconf import OmegaConf

from tests.drive.example import make_drive
from v2hdm import remake
from v2hdm.pipeline import RunConfig
from v2hdm.simulate import PortConfig


@pytest.mark.parametrize("cameras", [{"front"}, {"front", "rear"}])
def test_a_rendered_drive_is_found_again_with_the_cameras_of_its_run(
    cameras: set[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = OmegaConf.structured(RunConfig(simulate=PortConfig(name="port")))
    for name in {"front", "rear"} - cameras:
        del config.simulate.cameras[name]
    (tmp_path / "config.yaml").write_text(OmegaConf.to_yaml(config))
    asked: list[PortConfig] = []

    def rendered(port: PortConfig, *_: object) -> Path:
        asked.append(port)
        return tmp_path / "drive"

    (tmp_path / "drive").mkdir()
    make_drive(tmp_path / "drive")
    monkeypatch.setattr(remake, "rendered_drive", rendered)
    remake.drive_of_result(tmp_path)
    assert set(asked[0].cameras) == cameras

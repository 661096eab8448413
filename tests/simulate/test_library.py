"""A port from one call: by name or by settings, rendered once."""

from pathlib import Path

import pytest

from tests.simulate.conftest import tiny_port
from v2hdm.cli.config import compose_run_file, conf_dir, to_dataclass
from v2hdm.errors import ConfigError, DriveError
from v2hdm.pipeline import RunConfig
from v2hdm.simulate import simulate_port
from v2hdm.simulate.port import drive


def test_a_port_is_rendered_once_per_seed_and_has_its_truth(tmp_path: Path) -> None:
    first, again = (simulate_port(tiny_port(), tmp_path) for _ in range(2))
    other = simulate_port(tiny_port(), tmp_path, seed=5)
    assert first.root == again.root != other.root
    assert first.truth_dir is not None
    assert len(first.images) == 22


@pytest.mark.parametrize("name", ["port1", "port2"])
def test_a_shipped_port_is_that_of_its_run_file(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rendered = []
    monkeypatch.setattr(drive, "render_drive", lambda config, *_: rendered.append(config))
    with pytest.raises(DriveError, match="no such drive"):
        simulate_port(name, tmp_path)
    composed = compose_run_file(conf_dir() / "run" / f"{name}.yaml", "map", RunConfig, [])
    assert rendered == [to_dataclass(composed, RunConfig, "").simulate]


def test_an_unknown_port_is_one_line_that_lists_the_shipped_ones(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no port 'port3'; choose from port1, port2"):
        simulate_port("port3", tmp_path)

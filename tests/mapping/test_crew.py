"""What is parted among visits and workers comes out as in one piece."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest

from tests.adjust.site import site
from tests.mapping.scene import SceneOptions, make_scene
from v2hdm.adjust import SolveOptions, solve
from v2hdm.adjust.parts import Local, Team, choice
from v2hdm.errors import ConfigError
from v2hdm.io.drive import join_drives
from v2hdm.mapping.crew import Alone
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.options import MappingOptions, check_options
from v2hdm.mapping.results import MethodResult
from v2hdm.records import Drive, FloatArray, ImageDetections

_Result = TypeVar("_Result")
SAME_M = 1e-9


class ByPost(Alone):
    """A crew to which all work is posted, as to another process; notes what it was."""

    def __init__(self) -> None:
        self.begun: list[str] = []
        self.teams: list[int] = []

    def begin(self, work: Callable[[], _Result]) -> Callable[[], _Result]:
        self.begun.append(getattr(work, "func", work).__name__)
        result = pickle.dumps(pickle.loads(pickle.dumps(work))())
        return lambda: pickle.loads(result)

    def team(self, parts: int) -> Team:
        self.teams.append(parts)
        return Local()


def two_visits(root: Path) -> tuple[Drive, list[ImageDetections]]:
    """Two drives through one yard, joined; ``root`` is where they would lie."""
    options = SceneOptions(length_m=50.0, cameras=("front",), seed=21)
    scenes = [make_scene(options), make_scene(replace(options, seed=22))]
    drives = [replace(one.drive, name=str(n), root=root / str(n)) for n, one in enumerate(scenes)]
    count = len(drives[0].images)
    later = [replace(one, image=one.image + count) for one in scenes[1].detections]
    return join_drives(drives), [*scenes[0].detections, *later]


@pytest.fixture(scope="module")
def visits(tmp_path_factory: pytest.TempPathFactory) -> tuple[Drive, list[ImageDetections]]:
    return two_visits(tmp_path_factory.mktemp("visits"))


def mapped(visits: tuple[Drive, list[ImageDetections]], how: str, **given: Any) -> dict[str, MethodResult]:
    return run_methods(*visits, ("front",), MappingOptions(adjustment=how, pose_model="heave"), **given)


def corners(methods: dict[str, MethodResult]) -> FloatArray:
    return np.array([one.corners_map for one in methods["Opt"].hd_map.markings])


@pytest.fixture(scope="module")
def together(visits: tuple[Drive, list[ImageDetections]]) -> dict[str, MethodResult]:
    return mapped(visits, "together")


def test_a_crew_links_each_visit_by_itself_and_the_map_is_the_same_to_the_last_bit(
    visits: tuple[Drive, list[ImageDetections]], together: dict[str, MethodResult]
) -> None:
    crew = ByPost()
    methods = mapped(visits, "together", crew=crew)
    assert crew.begun.count("_link") >= 2 * 2
    assert not crew.teams
    for name, one in methods.items():
        assert repr(one.hd_map) == repr(together[name].hd_map), name
    assert (corners(methods) == corners(together)).all()


def test_the_visits_adjusted_in_parts_make_the_same_map(
    visits: tuple[Drive, list[ImageDetections]], together: dict[str, MethodResult]
) -> None:
    crew = ByPost()
    methods = mapped(visits, "parts", crew=crew)
    assert set(crew.teams) == {2}
    assert corners(methods) == pytest.approx(corners(together), abs=SAME_M)
    one, other = (each["Opt"].calibrations["front"].cam_from_vehicle for each in (methods, together))
    assert one == pytest.approx(other, abs=SAME_M)


def test_a_problem_is_parted_where_that_is_less_work(monkeypatch: pytest.MonkeyPatch) -> None:
    options = SolveOptions(coarse=False)
    asked: list[int] = []

    def team(parts: int) -> Team:
        asked.append(parts)
        return Local()

    def shares(visits: int) -> tuple[float, float]:
        problem = site(visits, 40, 40)
        return choice.cost_in_parts(problem, options), choice.cost_together(problem, options)

    # Visits of one stretch: together all their frames couple, in parts each visit is one part more.
    (few_parted, few), (many_parted, many) = shares(2), shares(6)
    assert many_parted < 4 * few_parted
    assert many > 12 * few
    crowd, chain = site(6, 40, 40), site(2, 60, 50, every_m=0.5)
    assert choice.cost_in_parts(chain, options) > choice.cost_together(chain, options)
    choice.adjust(chain, options, "auto", team)
    assert asked == []
    monkeypatch.setattr(choice, "_WORTH_WORKERS", 2 * choice.cost_in_parts(crowd, options))
    choice.adjust(crowd, options, "auto", team)
    assert asked == []
    monkeypatch.setattr(choice, "_WORTH_WORKERS", 0.0)
    found = choice.adjust(crowd, options, "auto", team)
    assert asked == [6]
    assert found.corners_map == pytest.approx(solve(crowd, options).corners_map, abs=SAME_M)
    choice.adjust(crowd, options, "together", team)
    choice.adjust(site(1, 30, 0), options, "parts", team)
    choice.adjust(site(2, 30, 10), replace(options, solver="lm"), "parts", team)
    assert asked == [6]


def test_an_adjustment_that_there_is_not_is_refused() -> None:
    with pytest.raises(ConfigError, match="adjustment is 'apart'; choose from auto, together, parts"):
        check_options(MappingOptions(adjustment="apart"))
    with pytest.raises(ConfigError, match="works on the CPU"):
        check_options(MappingOptions(adjustment="parts", device="cuda"))

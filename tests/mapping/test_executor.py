"""Work that is shared out among workers comes out as in one process."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest

from tests.mapping.scene import SceneOptions, make_scene
from v2hdm.executor import InProcess
from v2hdm.io.drive import join_drives
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.options import MappingOptions
from v2hdm.mapping.results import MethodResult
from v2hdm.records import Drive, FloatArray, ImageDetections

_Result = TypeVar("_Result")


class ByPost(InProcess):
    """A executor to which all work is posted, as to another process; notes what it was."""

    def __init__(self) -> None:
        self.begun: list[str] = []

    def begin(self, work: Callable[[], _Result]) -> Callable[[], _Result]:
        self.begun.append(getattr(work, "func", work).__name__)
        result = pickle.dumps(pickle.loads(pickle.dumps(work))())
        return lambda: pickle.loads(result)


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


def mapped(visits: tuple[Drive, list[ImageDetections]], **given: Any) -> dict[str, MethodResult]:
    return run_methods(*visits, ("front",), MappingOptions(pose_model="heave"), **given)


def corners(methods: dict[str, MethodResult]) -> FloatArray:
    return np.array([one.corners_map for one in methods["Opt"].hd_map.markings])


@pytest.fixture(scope="module")
def together(visits: tuple[Drive, list[ImageDetections]]) -> dict[str, MethodResult]:
    return mapped(visits)


def test_an_executor_links_each_visit_by_itself_and_the_map_is_the_same_to_the_last_bit(
    visits: tuple[Drive, list[ImageDetections]], together: dict[str, MethodResult]
) -> None:
    executor = ByPost()
    methods = mapped(visits, executor=executor)
    assert executor.begun.count("_link") >= 2 * 2
    for name, one in methods.items():
        assert repr(one.hd_map) == repr(together[name].hd_map), name
    assert (corners(methods) == corners(together)).all()

"""Work that is shared out among workers comes out as in one process."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np

from tests.mapping.scene import SceneOptions, make_scene
from v2hdm.executor import InProcess
from v2hdm.io.drive import join_drives
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.options import MappingOptions


class ByPost(InProcess):
    """An executor to which all work is posted, as to another process; notes what it was."""

    def __init__(self) -> None:
        self.begun: list[str] = []

    def begin(self, work):
        self.begun.append(getattr(work, "func", work).__name__)
        result = pickle.dumps(pickle.loads(pickle.dumps(work))())
        return lambda: pickle.loads(result)


def test_an_executor_links_each_visit_by_itself_and_the_map_is_the_same_to_the_last_bit(tmp_path):
    options = SceneOptions(length_m=50.0, cameras=("front",), seed=21)
    scenes = [make_scene(options), make_scene(replace(options, seed=22))]
    drives = [replace(one.drive, name=str(n), root=tmp_path / str(n)) for n, one in enumerate(scenes)]
    count = len(drives[0].images)
    seen = [*scenes[0].detections, *(replace(d, image=d.image + count) for d in scenes[1].detections)]
    given = join_drives(drives), seen, ("front",), MappingOptions(pose_model="heave")
    executor = ByPost()
    methods, together = run_methods(*given, executor=executor), run_methods(*given)
    assert executor.begun.count("_link") >= 2 * 2
    for name, one in methods.items():
        assert repr(one.hd_map) == repr(together[name].hd_map), name
    theirs, ours = ([one.corners_map for one in m["Opt"].hd_map.markings] for m in (together, methods))
    np.testing.assert_array_equal(ours, theirs)

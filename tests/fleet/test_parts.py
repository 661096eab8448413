"""The parts of a site on Ray: actors one of which is killed in the middle make the map of one process."""

from __future__ import annotations

import os
import signal
from typing import Any

import numpy as np
import pytest

from tests.adjust.site import site
from v2hdm.adjust import SolveOptions, solve
from v2hdm.adjust.parts import Local, solve_in_parts

pytest.importorskip("ray", reason="ray, the extra 'fleet', is not installed")


def test_a_site_by_actors_one_of_which_is_killed_is_that_of_one_process(ray: Any) -> None:
    from v2hdm.fleet.parts import RayTeam

    class Mortal(RayTeam):
        evaluations = 0

        def ask(self, question, bases, *arguments):
            self.evaluations += question == "evaluate"
            if question == "evaluate" and self.evaluations == 3:
                self.killed = ray.get(self.actors[0].process.remote())
                os.kill(self.killed, signal.SIGKILL)
            return super().ask(question, bases, *arguments)

    problem, options = site(3, 40, 12), SolveOptions(coarse=False)
    team = Mortal(2, 0.1)
    solution = solve_in_parts(problem, options, team)
    assert ray.get(team.actors[0].process.remote()) != team.killed
    here, whole = solve_in_parts(problem, options, Local()), solve(problem, options)
    for name in ("corners_map", "cam_from_vehicle", "map_from_vehicle"):
        assert (getattr(solution, name) == getattr(here, name)).all(), name
        assert np.abs(getattr(solution, name) - getattr(whole, name)).max() < 1e-9
    for actor in team.actors:
        ray.kill(actor)

"""Sets of cameras mapped here or by processes side by side: the same results, log and cache."""

import logging
import pickle
from collections import Counter
from dataclasses import dataclass, field

import pytest

from v2hdm.executor import HERE, Executor
from v2hdm.mapping.options import MappingOptions
from v2hdm.mapping.results import MethodResult
from v2hdm.pipeline import stages
from v2hdm.pipeline.context import Context
from v2hdm.pipeline.stages import MappedSet, map_camera_sets
from v2hdm.progress import silent
from v2hdm.records import HDMap
from v2hdm.store.cache import StageCache
from v2hdm.survey.run import Survey


@dataclass
class Images:
    """A stand-in for a drive's detections: so many markings in one image."""

    markings: list[int]


@dataclass
class Cameras:
    cameras: dict[str, int] = field(default_factory=lambda: {"front": 1, "left": 2, "rear": 3})


def mapped(work, job):
    method = "CNI" if job.stated else "Opt"
    logging.getLogger("v2hdm.mapping").info("%s with %s", method, job.name)
    return MappedSet({method: MethodResult(method, job.cameras, HDMap((), (), None))})


@pytest.fixture
def elsewhere(monkeypatch):
    """What processes have mapped, in their order, and executors; what reaches one is pickled."""
    jobs = []

    class Elsewhere(Executor):
        workers = 2

        def outcomes(self, stage, job_list, progress, at_once):
            assert at_once == 2
            for number, job in enumerate(job_list):
                jobs.append((job.name, job.stated))
                stage_there, job = pickle.loads(pickle.dumps((stage, job)))
                yield number, pickle.loads(pickle.dumps(stage_there.work(job, silent)))

    monkeypatch.setattr(stages._Work, "_map", mapped)
    return jobs, {1: HERE, 2: Elsewhere()}


def mapped_sets(cache, executor, detections, compare=True):
    survey = Survey(MappingOptions(), ())
    context = Context(StageCache(cache), executor=executor)
    return map_camera_sets(Cameras(), "drive", [detections], survey, None, context, compare=compare)


def test_a_drive_is_mapped_with_all_cameras_alone_unless_sets_are_compared(elsewhere, tmp_path):
    jobs, executors = elsewhere
    mapped = mapped_sets(tmp_path, executors[2], Images([0] * 5000), compare=False)
    assert list(mapped) == ["all"]
    assert list(mapped["all"].methods) == ["Opt"]
    assert mapped["all"].methods["Opt"].cameras == ("front", "left", "rear")
    assert jobs == []


@pytest.mark.parametrize(("workers", "count"), [(1, 5000), (2, 3), (2, 5000)])
def test_large_drives_are_mapped_by_processes_the_longest_job_first(
    workers, count, elsewhere, tmp_path, caplog
):
    caplog.set_level(logging.INFO, "v2hdm")
    jobs, executors = elsewhere
    mapped = mapped_sets(tmp_path, executors[workers], Images([0] * count))
    assert list(mapped) == ["front", "left", "rear", "all"]
    assert [list(of_set.methods) for of_set in mapped.values()] == 4 * [["CNI", "Opt"]]
    assert mapped["all"].methods["Opt"].cameras == ("front", "left", "rear")
    in_order = [(name, stated) for stated in (False, True) for name in ("all", "front", "left", "rear")]
    assert jobs == (in_order if workers * count == 10_000 else [])
    # What stands for processes logs here, too.
    lines = {f"{method} with {name}" for name in mapped for method in ("Opt", "CNI")}
    assert Counter(caplog.messages) == dict.fromkeys(lines, 2 if jobs else 1)
    caplog.clear()
    jobs.clear()
    assert mapped_sets(tmp_path, executors[3 - workers], Images([0] * count)) == mapped
    assert not jobs
    assert Counter(caplog.messages) == dict.fromkeys(lines, 1)


def test_a_run_that_was_stopped_maps_only_what_it_had_not(elsewhere, tmp_path, monkeypatch):
    jobs, executors = elsewhere

    def fails(work, job):
        if job.stated:
            raise KeyboardInterrupt
        return mapped(work, job)

    monkeypatch.setattr(stages._Work, "_map", fails)
    with pytest.raises(KeyboardInterrupt):
        mapped_sets(tmp_path, HERE, Images([0] * 5000))
    monkeypatch.setattr(stages._Work, "_map", mapped)
    mapped_sets(tmp_path, executors[2], Images([0] * 5000))
    assert jobs == [(name, True) for name in ("all", "front", "left", "rear")]

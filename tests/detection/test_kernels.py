"""The compiled kernels do what numpy does, and where there are none numpy does it."""

import os
import shutil
import subprocess
import sys
from dataclasses import replace
from importlib.machinery import EXTENSION_SUFFIXES

import cv2
import numpy as np
import pytest

from tests.detection.pictures import (
    LENSES,
    bar,
    diamond,
    make_camera,
    output_of,
    patches_of,
    picture,
    to_image,
)
from tests.docs.blocks import ROOT
from v2hdm import __version__, native
from v2hdm.catalogue import PAINT_CLASSES, SHIPPED
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.evidence import CHANNELS, rectified_views
from v2hdm.detection.lanes.boundaries import _STATES, _forward_backward
from v2hdm.detection.lanes.chains import find_chains
from v2hdm.detection.lanes.lines import trace_lanes
from v2hdm.detection.quads.blobs import Blob, find_blobs
from v2hdm.detection.quads.fit import fit_quadrilaterals
from v2hdm.detection.quads.lattice import lay_grid, lay_lattice
from v2hdm.detection.quads.patch import ImageQuads, LensFrames
from v2hdm.detection.quads.propose import Proposal, open_sides
from v2hdm.detection.quads.state import State
from v2hdm.geometry.planar import Quad, order_corners
from v2hdm.records import DIAMOND, LANE_DASH, STOP_LINE

compiled = pytest.mark.skipif(native.kernels() is None, reason=native.which_runs())


def twice(function):
    """The results of a function with the kernels, and with numpy alone."""
    by_kernels = function()
    with native.numpy_alone():
        return by_kernels, function()


class Scene:
    """Random markings on a random picture of them, and quadrilaterals near their sides."""

    def __init__(self, seed, lens="plumb_bob"):
        rng = np.random.default_rng(seed)
        camera = make_camera(lens)
        self.view = RoadCamera(camera, 16)
        ahead_m = np.arange(5.0, 17.0, 2.5)
        shapes = [
            bar(x, rng.uniform(-2, 2), rng.uniform(0.5, 2), rng.uniform(0.12, 0.4), rng.uniform(0, 180))
            if rng.random() < 0.5
            else diamond(x, rng.uniform(-2, 2), rng.uniform(0.8, 1.4), 0.7, rng.uniform(0, 180))
            for x in ahead_m
        ]
        self.image = picture(camera, shapes, seed=seed)
        true_px = np.stack([order_corners(to_image(camera, shape)) for shape in shapes])
        self.start = true_px + 0.7 * rng.standard_normal(true_px.shape)
        odds = rng.normal(0, 0.5, (self.image.shape[0] // 2, self.image.shape[1] // 2)).astype(np.float32) - 4
        for outline in true_px:
            cv2.fillConvexPoly(odds, np.round(outline / 2).astype(np.int32), 4.0)
        self.patches = patches_of(self.image, self.view, output_of(odds), self.start)
        self.frames = LensFrames.about(self.view, self.start)

    def state(self):
        count = len(self.start)
        quad = Quad(self.frames.from_image(self.start))
        return State.at(quad, np.full(count, 0.8), 0.8, np.full((count, 8), 2.0), self.frames)


@compiled
@pytest.mark.parametrize("seed", range(4))
def test_a_step_is_the_same_compiled_and_in_numpy(seed):
    scene = Scene(seed)
    grid = lay_grid(scene.patches, scene.frames, scene.start)
    for lattice, paint in (
        (lay_lattice(scene.patches, scene.frames, scene.start), None),
        (grid.lattice, grid.paint),
    ):

        def step(lattice=lattice, paint=paint):
            state = scene.state()
            return state, state.settle(lattice, 1, paint)

        (state, system), (state_too, system_too) = twice(step)
        size = np.abs(system_too.information).max(axis=(1, 2), keepdims=True)
        np.testing.assert_allclose(system.information / size, system_too.information / size, atol=2e-4)
        # A table of OpenCV's is read to a thirty-second of its cells.
        for name in ("scatter", "inliers"):
            np.testing.assert_allclose(
                getattr(system, name), getattr(system_too, name), rtol=3e-3, err_msg=name
            )
        np.testing.assert_allclose(system.side_step, system_too.side_step, atol=3e-3)
        for name in ("corners", "blur_px", "contrast", "expected_contrast", "light", "slope"):
            np.testing.assert_allclose(
                getattr(state, name), getattr(state_too, name), atol=3e-3, err_msg=name
            )


@compiled
@pytest.mark.parametrize("lens", sorted(LENSES))
def test_the_same_pixels_are_looked_at_compiled_and_in_numpy(lens):
    scene = Scene(3, lens)
    # One marking is partly outside of the image, one so large that its pixels are thinned.
    scene.start[0] += [scene.view.info.width - scene.start[0, 0, 0], 0.0]
    scene.start[1] = np.array([[-150, 90], [140, 120], [150, -60], [-140, -90]]) + scene.start[1].mean(axis=0)

    def lattices():
        grid = lay_grid(scene.patches, scene.frames, scene.start)
        return grid.lattice, lay_lattice(scene.patches, scene.frames, scene.start)

    for lattice, lattice_too in zip(*twice(lattices), strict=True):
        np.testing.assert_array_equal(lattice.count, lattice_too.count)
        is_used = np.arange(lattice.use.shape[1]) < lattice.count
        for name, array in vars(lattice).items():
            array_too = getattr(lattice_too, name)
            assert (array.shape, array.dtype) == (array_too.shape, array_too.dtype), name
            if array.shape[-1] == is_used.shape[-1]:
                shown = np.broadcast_to(
                    is_used.reshape(len(is_used), *[1] * (array.ndim - 2), -1), array.shape
                )
                array, array_too = array[shown], array_too[shown]
            np.testing.assert_allclose(array, array_too, atol=2e-5, err_msg=name)


@compiled
@pytest.mark.parametrize("lens", sorted(LENSES))
def test_corners_are_the_same_compiled_and_in_numpy(lens):
    scene = Scene(7, lens)
    cut = open_sides(scene.start, scene.view)

    def fit():
        fitted = fit_quadrilaterals(scene.patches, scene.view, scene.start, cut)
        return (
            fitted.corners_px,
            np.sqrt(np.diagonal(fitted.covariance_px(), axis1=1, axis2=2)),
            fitted.statistics,
        )

    (corners_px, sigma_px, statistics), (corners_px_too, sigma_px_too, statistics_too) = twice(fit)
    np.testing.assert_allclose(corners_px, corners_px_too, atol=0.01)
    np.testing.assert_allclose(sigma_px, sigma_px_too, rtol=0.02)
    np.testing.assert_allclose(statistics, statistics_too, atol=0.05)


@compiled
@pytest.mark.parametrize("seed", range(4))
def test_the_same_crossings_are_linked_compiled_and_in_numpy(seed):
    rng = np.random.default_rng(seed)
    v_px = np.repeat(np.arange(700.0, 300.0, -8.0), 4)
    lines = np.array([200.0, 400.0, 700.0, 900.0]) + np.outer(np.arange(50), rng.uniform(-6, 6, 4))
    points_px = np.column_stack([lines.ravel() + rng.normal(0, 2, 200), v_px])[rng.random(200) < 0.8]
    odds = rng.normal(1.5, 2.0, len(points_px))
    chains, chains_too = twice(lambda: find_chains(points_px, odds))
    assert [chain.tolist() for chain in chains] == [chain.tolist() for chain in chains_too]
    assert len(chains) > 3


@compiled
@pytest.mark.parametrize("seed", range(4))
def test_paint_is_traced_alike_compiled_and_in_numpy(seed):
    """The mask is random, framed by no paint, with branches that meet and part."""
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.standard_normal((60, 50)).astype(np.float32), (0, 0), 3.0) * 20
    level = cv2.copyMakeBorder(noise, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=-1.0)
    blob = Blob({"lane_line": 0.9}, level, np.array([400.0, 500.0]), 2, np.zeros((0, 2)))
    piece = Proposal(blob, 0, {"lane_line": 0.9}, np.zeros((0, 2)), None, 0.0)
    view = RoadCamera(make_camera(), 16)
    traced, traced_too = twice(lambda: trace_lanes([(piece, 0.9)], view, 0.05, 20.0))
    assert len(traced) == len(traced_too) > 1
    for lane, lane_too in zip(traced, traced_too, strict=True):
        np.testing.assert_allclose(lane.points_px, lane_too.points_px, atol=1e-9)


@compiled
@pytest.mark.parametrize("seed", range(3))
def test_pieces_of_paint_are_found_alike_compiled_and_in_numpy(seed):
    rng = np.random.default_rng(seed)
    odds = cv2.GaussianBlur(rng.standard_normal((120, 160)).astype(np.float32), (0, 0), 3.0) * 30 - 1
    kinds = rng.normal(0, 2, (len(PAINT_CLASSES), 60, 80)).astype(np.float32)
    (blobs, owner), (blobs_too, owner_too) = twice(lambda: find_blobs(output_of(odds, kinds)))
    assert len(blobs) == len(blobs_too) > 5
    assert any(blob.parts for blob in blobs)
    np.testing.assert_array_equal(owner, owner_too)
    for blob, blob_too in zip(blobs, blobs_too, strict=True):
        for kind, score in blob.class_score.items():
            assert score == pytest.approx(blob_too.class_score[kind], abs=1e-6)
        np.testing.assert_allclose(blob.outline_px, blob_too.outline_px, atol=1e-5)
        np.testing.assert_array_equal(blob.level, blob_too.level)
        assert (blob.parts, blob.traced) == (blob_too.parts, blob_too.traced)


@compiled
@pytest.mark.parametrize("lens", sorted(LENSES))
def test_lenses_are_undone_alike_compiled_and_in_numpy(lens):
    view = RoadCamera(make_camera(lens), 16)
    points_px = np.random.default_rng(0).uniform(-500, 2000, (200, 2))
    points_px[:3] = [[np.nan, 5.0], [np.nan, np.nan], [1e300, -1e300]]
    with np.errstate(invalid="ignore", over="ignore"):
        pinhole_px, pinhole_px_too = twice(lambda: view.undistort(points_px))
    np.testing.assert_allclose(pinhole_px[3:], pinhole_px_too[3:], rtol=1e-12)
    recorded_px, recorded_px_too = twice(lambda: view.distort(pinhole_px[3:]))
    np.testing.assert_allclose(recorded_px, recorded_px_too, rtol=1e-12)
    np.testing.assert_array_equal(np.isfinite(pinhole_px), np.isfinite(pinhole_px_too))


@compiled
def test_boundaries_end_alike_compiled_and_in_numpy():
    rng = np.random.default_rng(0)
    likelihood = rng.normal(0, 1.5, (3, 40, _STATES))
    step_m = rng.uniform(0.1, 2.0, (3, 39))
    (states, total), (states_too, total_too) = twice(lambda: _forward_backward(likelihood, step_m))
    np.testing.assert_allclose(states, states_too, atol=1e-12)
    np.testing.assert_allclose(total, total_too, rtol=1e-12)


def test_a_corner_far_from_the_image_asks_for_no_more_pixels_than_the_image_has():
    scene = Scene(3, "plumb_bob")
    scene.start[0, 2] = [20_000.0, 160.0]
    lattice = lay_lattice(scene.patches, scene.frames, scene.start)
    height, width = scene.image.shape[:2]
    assert lattice.use.shape[1] < (height + 400) * (width + 400)


@compiled
def test_arrays_that_do_not_belong_together_are_refused():
    scene = Scene(0)
    lattice = lay_lattice(scene.patches, scene.frames, scene.start)
    state = scene.state()
    state.contrast = state.contrast[:-1]
    with pytest.raises(ValueError, match="contrast: of another shape"):
        state.settle(lattice, 1)
    state = scene.state()
    state.slope = state.slope.astype(np.float32)
    with pytest.raises(ValueError, match="slope: of another type"):
        state.settle(lattice, 1)


def _told(folder, *program, **environment):
    """The output of a new process, with the package from a folder."""
    environment = {native.SWITCH: "1", "PYTHONPATH": str(folder), **environment}
    process = subprocess.run(
        [sys.executable, *program], cwd=folder, env=os.environ | environment,
        capture_output=True, text=True, timeout=60, check=True,
    )  # fmt: skip
    return process.stdout + process.stderr


LOAD = "from v2hdm.detection.detector import Detector; Detector.load(); Detector.load()"


@pytest.fixture(scope="module")
def copied(tmp_path_factory):
    """A folder with the package as it comes where nothing could be compiled."""
    folder = tmp_path_factory.mktemp("copied")
    shutil.copytree(
        ROOT / "v2hdm", folder / "v2hdm", ignore=shutil.ignore_patterns("_kernels*", "__pycache__")
    )
    for name in ("hatch_build.py", "pyproject.toml", "README.md", "LICENSE", "conf", "examples"):
        (shutil.copytree if (ROOT / name).is_dir() else shutil.copy)(ROOT / name, folder / name)
    return folder


def test_without_kernels_numpy_detects_and_one_line_says_so(copied):
    assert _told(copied, "-c", LOAD) == (
        "nothing is compiled: detection runs in numpy, at half the speed, and mapping first compiles for "
        "some 20 s; with a C++ compiler, install v2hdm again\n"
    )
    assert _told(copied, "-m", "v2hdm", "--version").endswith("numpy and numba (nothing is compiled)\n")


def test_numpy_that_was_asked_for_is_not_complained_about(copied):
    assert _told(ROOT, "-c", LOAD, V2HDM_NATIVE="0") == ""
    assert _told(ROOT, "-m", "v2hdm", "--version", V2HDM_NATIVE="0").endswith(
        "numpy and numba (V2HDM_NATIVE is 0)\n"
    )


def test_kernels_of_another_processor_are_not_loaded_and_the_line_says_why(copied, tmp_path):
    shutil.copytree(copied / "v2hdm", tmp_path / "v2hdm")
    suffix = next(s for s in EXTENSION_SUFFIXES if s.endswith("so"))
    (tmp_path / "v2hdm" / "native" / f"_kernels{suffix}").write_bytes(b"\x7fELF of another processor")
    answer = _told(tmp_path, "-c", LOAD)
    assert answer.startswith("the compiled kernels do not load (")
    assert answer.count("\n") == 1


@compiled
def test_kernels_older_than_their_sources_are_not_used(copied, tmp_path):
    shutil.copytree(ROOT / "v2hdm", tmp_path / "v2hdm", ignore=shutil.ignore_patterns("__pycache__"))
    with (tmp_path / "v2hdm" / "native" / "src" / "settle.cpp").open("a") as source:
        source.write("// changed\n")
    assert _told(tmp_path, "-m", "v2hdm", "--version").endswith(
        "(the compiled kernels are older than their sources)\n"
    )


def test_a_compiler_that_fails_does_not_fail_the_install(copied, tmp_path):
    program = f"from hatchling import build; print(build.build_wheel({str(tmp_path)!r}))"
    answer = _told(copied, "-c", program, CXX="false", CC="false")
    assert "v2hdm: detection will run in numpy, nothing was compiled: Command '['false'" in answer
    assert answer.count("\n") == 2
    assert [path.name for path in tmp_path.iterdir()] == [f"v2hdm-{__version__}-py3-none-any.whl"]


@compiled
def test_what_was_compiled_is_found_where_the_working_directory_is_no_place_of_modules():
    program = "import runpy; print(runpy.run_path('hatch_build.py')['compile_kernels']())"
    assert "_kernels" in _told(ROOT, "-c", program, PYTHONSAFEPATH="1")  # as pipx installs


@compiled
@pytest.mark.parametrize("lens", sorted(LENSES))
def test_pictures_for_the_judge_are_the_same_compiled_and_in_numpy(lens):
    scene = Scene(5, lens)
    # One marking is partly outside of the image.
    scene.start[0] += [scene.view.info.width - scene.start[0, 0, 0], 0.0]
    output = scene.patches.output
    kinds = np.random.default_rng(5).normal(size=output.kinds.shape).astype(np.float32)
    scene.patches.output = replace(output, kinds=kinds)
    quads = ImageQuads.of(scene.view, scene.start)
    ground = Quad(scene.view.unproject(scene.start))
    readings = [(m, kind) for m in range(len(scene.start)) for kind in (DIAMOND, LANE_DASH, STOP_LINE)]

    def views():
        return rectified_views(scene.patches, quads, ground, readings, SHIPPED)

    (views, first_side), (views_too, first_side_too) = twice(views)
    np.testing.assert_array_equal(first_side, first_side_too)
    assert views[:, CHANNELS.index("outside")].any()
    # A code that lies between two is rounded to either: of 1,000 pixels one, by one code.
    np.testing.assert_allclose(np.mean(np.abs(views - views_too)), 0.0, atol=1e-5)
    np.testing.assert_allclose(views, views_too, atol=0.05)

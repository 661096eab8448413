"""Paint of own classes in a rendered port: where it is stated, labelled, and nothing else moved."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.simulate.conftest import tiny_port
from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.errors import ConfigError
from v2hdm.geometry.planar import signed_area
from v2hdm.simulate.port import drive
from v2hdm.simulate.port.build import build_port
from v2hdm.simulate.port.config import PaintConfig, PortConfig, StencilConfig

PAD = [[-0.6, -0.3], [-0.6, 0.3], [0.6, 0.3], [0.6, -0.3]]
"""Clockwise on purpose."""

T = [
    [[0.35, -0.5], [0.5, -0.5], [0.5, 0.5], [0.35, 0.5]],
    [[-0.5, -0.075], [0.36, -0.075], [0.36, 0.075], [-0.5, 0.075]],
]
STENCILS = {"pad": StencilConfig(shapes_m=[PAD], spacing_m=8.0), "parking_t": StencilConfig(shapes_m=T)}


def test_own_quadrilaterals_are_true_markings_and_symbols_are_paint() -> None:
    port = build_port(PortConfig(paint=PaintConfig(stencils=STENCILS)))
    paints = [paint.kind for paint in port.renderer.scene.paints]
    pads = [marking.corners_map for marking in port.hd_map.markings if marking.kind == "pad"]
    assert len(pads) == paints.count("pad") > 40
    assert paints.count("parking_t") > 60
    assert paints.count("parking_t") % 2 == 0
    assert "parking_t" not in {marking.kind for marking in port.hd_map.markings}
    assert all(signed_area(corners) == pytest.approx(0.72) for corners in pads)
    centres = np.array([corners.mean(axis=0) for corners in pads])
    others = np.array([m.corners_map.mean(axis=0) for m in port.hd_map.markings if m.kind == "diamond"])
    assert np.linalg.norm(centres[:, None] - others, axis=2).min() > 1.6


def test_a_port_with_stencils_is_otherwise_the_same() -> None:
    plain, stencilled = build_port(tiny_port()), build_port(tiny_port(paint=PaintConfig(stencils=STENCILS)))
    before, after = plain.renderer.scene.paints, stencilled.renderer.scene.paints
    assert len(after) > len(before)
    for one, other in zip(before, after, strict=False):
        assert replace(one, polygon_map=0) == replace(other, polygon_map=0)  # type: ignore[arg-type]
        np.testing.assert_array_equal(one.polygon_map, other.polygon_map)


def test_own_paint_has_labels_after_those_of_the_shipped_classes() -> None:
    port = build_port(tiny_port(paint=PaintConfig(stencils=STENCILS)))
    shown = np.unique([port.picture("front", frame).labels for frame in range(3)])
    assert 1 + len(PAINT_CLASSES) in shown
    assert shown.max() <= len(PAINT_CLASSES) + 2


@pytest.mark.parametrize(
    ("stencils", "words"),
    [
        ({"diamond": StencilConfig(shapes_m=[PAD])}, "stencils.diamond: there is a class"),
        ({"pad": StencilConfig(shapes_m=[])}, "stencils.pad.shapes_m"),
        ({"pad": StencilConfig(shapes_m=[PAD[:2]])}, "stencils.pad.shapes_m"),
        ({"pad": StencilConfig(shapes_m=[[*PAD[:3], [0.0, 0.2]]])}, "convex"),
        ({"pad": StencilConfig(shapes_m=[[*PAD[:3], [float("nan"), 0.2]]])}, "convex"),
        ({"pad": StencilConfig(shapes_m=[PAD], spacing_m=0.5)}, "stencils.pad.spacing_m"),
    ],
)
def test_stencils_that_cannot_be_painted_are_refused(stencils: dict[str, StencilConfig], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        build_port(tiny_port(paint=PaintConfig(stencils=stencils)))


def test_ports_without_stencils_keep_their_folder_in_the_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drive, "render_drive", lambda *_: None)
    plain = drive.rendered_drive(PortConfig(), tmp_path, 1, lambda done, total: None)
    stencilled = PortConfig(paint=PaintConfig(stencils=STENCILS))
    assert plain.name == "port1-5152c55c71"
    assert drive.rendered_drive(stencilled, tmp_path, 1, lambda done, total: None) != plain

"""Common style of all figures: colours by role."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from v2hdm.records import BEST, FloatArray
from v2hdm.store.files import whole_file

OKABE_ITO = {
    "orange": "#e69f00",
    "sky": "#56b4e9",
    "green": "#009e73",
    "yellow": "#f0e442",
    "blue": "#0072b2",
    "vermillion": "#d55e00",
    "purple": "#cc79a7",
}
"""Colours safe for colour-blind readers: Okabe and Ito, Color Universal Design, 2008."""

PAINT = "#dfe4e8"  # filling of true markings
GRID = "#e6eaed"
TRUTH = "#9aa4ad"
ROUTE = "#c9d3da"
WORDS = {"CNI": "orange", "ENI": "vermillion", BEST: "blue", "ONI": "green"}
"""Colour name of each method, the same in every figure."""

METHOD = {method: OKABE_ITO[colour] for method, colour in WORDS.items()}

RC: dict[Any, Any] = {
    "font.family": "sans-serif",
    "text.parse_math": False,  # a $ in a name is a letter
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#59636b",
    "axes.labelcolor": "#2d3439",
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "xtick.color": "#59636b",
    "ytick.color": "#59636b",
    "legend.frameon": False,
}


@contextmanager
def figure(path: Path, width_in: float, height_in: float, dpi: int = 110) -> Iterator[Figure]:
    """A figure that is saved atomically to ``path`` at the end of the block."""
    with mpl.rc_context(RC):
        fig = Figure(figsize=(width_in, height_in), dpi=dpi, layout="constrained", facecolor="white")
        canvas: Any = FigureCanvasAgg(fig)
        yield fig
        with whole_file(path) as partial:
            canvas.print_png(partial)  # savefig draws twice, the layout first


def draw_arrows(
    axes: Axes, places: FloatArray, arrows: FloatArray, longest: float, span: float, **look: Any
) -> None:
    """Draw arrows (N, 2) at places (N, 2), the ``longest`` spanning ``span``, with a key in px above."""
    if not len(places):  # matplotlib cannot draw a key without arrows
        return
    longest = max(longest, 1e-3)
    x, y = places.T
    dx, dy = arrows.T
    scale = longest / span
    drawn = axes.quiver(x, y, dx, dy, angles="xy", scale_units="xy", scale=scale, **look)
    power = 10.0 ** np.floor(np.log10(longest))
    key_px = max(step for step in (1, 2, 5) if step * power <= longest * (1 + 1e-9)) * power
    size = {"size": mpl.rcParams["font.size"] - 1}
    axes.quiverkey(drawn, 0.88, 1.06, key_px, f"{key_px:g} px", labelpos="W", fontproperties=size)

"""The errors of a localisation over time, as a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from v2hdm.records import FloatArray

_PANELS = (("ahead", 100.0, "cm"), ("to the left", 100.0, "cm"), ("heading", float(np.degrees(1.0)), "deg"))
_KNOWN, _LOST, _BAND = "#0072b2", "#d55e00", "#bbbbbb"


def save_errors(
    path: Path, stamp_s: FloatArray, error: FloatArray, sigma: FloatArray, known: np.ndarray
) -> None:
    """Draw errors (F, 3) beside the recorded poses as PNG.

    Bands are two standard deviations (F, 3) of estimate and recorded pose together. ``known`` (F,) says in
    which frames the vehicle knows where it is; the others are drawn as crosses.
    """
    figure = Figure(figsize=(9, 6), layout="constrained")
    FigureCanvasAgg(figure)
    time_s = stamp_s - stamp_s[0]
    axes = figure.subplots(3, 1, sharex=True)
    for k, (axis, (name, factor, unit)) in enumerate(zip(axes, _PANELS, strict=True)):
        band = 2 * factor * sigma[:, k]
        axis.fill_between(time_s, -band, band, color=_BAND, alpha=0.6, lw=0, label="two sigmas, of both")
        axis.plot(time_s[known], factor * error[known, k], ".", ms=3, color=_KNOWN, label="localised")
        if not known.all():
            axis.plot(time_s[~known], factor * error[~known, k], "x", ms=4, color=_LOST, label="lost")
        limit = 1.2 * float(np.percentile(np.abs(factor * error[:, k]), 99)) + 1e-9
        axis.set_ylim(-max(limit, 2 * float(np.median(band))), max(limit, 2 * float(np.median(band))))
        axis.set_ylabel(f"{name}, {unit}")
        axis.grid(alpha=0.3)
    axes[0].legend(loc="upper right", ncols=3, fontsize=8)
    axes[0].set_title("Localised by the map's markings, less the recorded pose")
    axes[-1].set_xlabel("time, s")
    figure.savefig(path, dpi=110)

"""The figures of an experiment, each with the caption that says what to see in it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from v2hdm.experiment.figures.curves import save_balance, save_boxes, save_growth, save_ranges
from v2hdm.experiment.figures.site import save_calibration, save_fields, save_map, save_shift
from v2hdm.experiment.measures import Measured
from v2hdm.experiment.plan import Job


def save_figures(
    folder: Path,
    todo: Sequence[Job],
    records: Sequence[Mapping[str, Any]],
    measured: Sequence[Measured],
    progress: Callable[[int, int], None],
) -> dict[str, str]:
    """Draw all figures into a folder; figures of single drives show the first seed of each port.

    ``progress`` is called with how many figures are drawn, of how many.

    Returns:
        By file name the caption of each figure that could be drawn.
    """
    first: dict[str, int] = {}
    for number, one in enumerate(measured):
        first.setdefault(one.port, number)
    work: dict[str, Callable[[Path], str | None]] = {}
    for port, n in first.items():
        record, one, pictures = records[n], measured[n], todo[n].folder
        work[f"map_{port}.png"] = partial(save_map, record=record, measured=one)
        work[f"eni_oni_{port}.png"] = partial(save_shift, record=record, measured=one)
        work[f"calibration_{port}.png"] = partial(save_calibration, record=record, pictures=pictures)
        work[f"reprojection_{port}.png"] = partial(save_fields, record=record)
    work["corners.png"] = partial(save_boxes, firsts=[measured[n] for n in first.values()])
    work["growth.png"] = partial(save_growth, records=records)
    work["range.png"] = partial(save_ranges, records=records)
    work["bias_spread.png"] = partial(save_balance, measured=measured)
    captions = {}
    for done, (name, draw) in enumerate(work.items()):
        progress(done, len(work))
        caption = draw(folder / name)
        if caption is None:
            (folder / name).unlink(missing_ok=True)
        else:
            captions[name] = caption
    progress(len(work), len(work))
    return captions

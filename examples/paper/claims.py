"""The paper's claims against what was measured, and the experiment's text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import numpy as np

from v2hdm import __version__
from v2hdm.experiment.drive import Measured
from v2hdm.experiment.plan import RECIPES, ExperimentConfig

from .tables import by_port, common_rows, finite, markdown, results_table


class _Ratio(NamedTuple):
    """A claim on how many times as far off the map of one method is as that of another."""

    text: str
    above: str
    below: str
    sign: str
    limit: float
    starts_from: str | None  # the IPM that a port must start from to test it; None for any


_RATIOS = (
    _Ratio("the optimisation is as good as a manual calibration", "Opt", "CNI", "<=", 1.1, "calibrated"),
    _Ratio("it repairs a borrowed calibration", "ENI", "Opt", ">=", 10.0, "estimated"),
    _Ratio("its IPM serves as well as the manual one", "ONI", "CNI", "<=", 1.2, None),
)


@dataclass(frozen=True)
class Claim:
    """One claim against the figures of a port and camera set: by seed, and over the shared markings."""

    text: str
    where: str
    limit: str
    values: tuple[float, ...]
    holds: bool
    shared: tuple[float, ...] = ()

    @property
    def figure(self) -> str:
        """The mean over the seeds and, where there are several, the range that they span."""
        return _with_range(self.values)


def claims(measured: Sequence[Measured]) -> list[Claim]:
    """The paper's claims held against every port and set of cameras that can test them."""
    tested_claims = []
    for port, drives in by_port(measured).items():
        started = drives[0].started_from
        ratios = [ratio for ratio in _RATIOS if ratio.starts_from in (None, started)]
        for cameras, ratio in product(drives[0].rows, ratios):
            methods = (ratio.above, ratio.below)
            pairs = [(rows[ratio.above], rows[ratio.below]) for rows in common_rows(drives, cameras, methods)]
            values = finite(upper.rmse_m / lower.rmse_m for upper, lower in pairs)
            shared = finite(upper.shared_rmse_m / lower.shared_rmse_m for upper, lower in pairs)
            mean = float(np.mean(values)) if values else float("nan")
            holds = mean <= ratio.limit if ratio.sign == "<=" else mean >= ratio.limit
            text = f"{ratio.text}: {ratio.above} / {ratio.below}"
            limit = f"{ratio.sign} {ratio.limit:g}"
            tested_claims.append(Claim(text, f"{port}, {cameras}", limit, values, holds, shared))
        tested_claims += _more_with_more(port, drives)
    return [claim for claim in tested_claims if claim.values]


def _more_with_more(port: str, drives: Sequence[Measured]) -> list[Claim]:
    """All cameras together map more markings than the best of them alone: the ratio is above one."""
    sets = list(drives[0].rows)
    if len(sets) < 2:
        return []
    values = []
    for drive in drives:
        counts = [drive.rows[cameras]["Opt"].markings for cameras in sets if "Opt" in drive.rows[cameras]]
        if len(counts) == len(sets) and max(counts[:-1]):
            values.append(counts[-1] / max(counts[:-1]))
    text = f"{sets[-1]} cameras map more markings than one: Opt, {sets[-1]} / the best one alone"
    return [Claim(text, f"{port}, {sets[-1]}", "> 1", tuple(values), bool(values and np.mean(values) > 1))]


def words(measured: Sequence[Measured], config: ExperimentConfig) -> str:
    """The text in Markdown."""
    tested = claims(measured)
    holds = ("**no**", "yes")
    lines = [
        [claim.text, claim.where, claim.limit, claim.figure, _with_range(claim.shared), holds[claim.holds]]
        for claim in tested
    ]
    return filled(
        "experiment.md",
        config=config,
        version=__version__,
        drives=", ".join(drive.title for drive in measured),
        recipes=RECIPES,
        tested=tested,
        broken=[claim for claim in tested if not claim.holds],
        claims_table=markdown(["claim", "where", "asked", "measured", "on shared markings", "holds"], lines),
        failures=[(drive.title, *failure) for drive in measured for failure in drive.failures],
        results_table=markdown(*results_table(measured)),
    )


def filled(template: str, **values: Any) -> str:
    """The text of a template of this folder."""
    templates = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).with_name("templates")),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    return templates.get_template(template).render(**values)


def _with_range(values: Sequence[float]) -> str:
    if not values:
        return "-"
    mean = f"{np.mean(values):.2f}"
    return f"{mean} ({min(values):.2f} to {max(values):.2f})" if len(values) > 1 else mean

"""``v2hdm compare RESULT DESIGN``: the paint of a map against its design (docs/as-built.md)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from v2hdm.cli.arguments import kinds_of, log_to_terminal, result_of
from v2hdm.cli.command import Command, need_installed
from v2hdm.errors import EXIT_FAILED_VERDICT, ConfigError

if TYPE_CHECKING:
    from v2hdm.asbuilt.comparison import Finding
    from v2hdm.asbuilt.decisions import Tolerances
    from v2hdm.asbuilt.misfit import Misfit
    from v2hdm.asbuilt.reading import Source
    from v2hdm.records import HDMap


def _run(arguments: Sequence[str]) -> int:
    """Compare a map with a design or with rules; 0 if all of it conforms, 3 if not."""
    parser = COMMAND.parser()
    parser.add_argument(
        "map", type=Path, metavar="RESULT", help="result folder of v2hdm map, or its map file"
    )
    design = "design: .dxf, .geojson, .gpkg, .xodr, an earlier result; or rules: .csv"
    parser.add_argument("design", type=Path, metavar="DESIGN", help=design)
    place = "largest offset that conforms, m, along and across each marking (default: 0.05)"
    parser.add_argument("--tolerance", type=float, default=0.05, metavar="M", help=place)
    size = "largest difference of length and width that conforms, m (default: as --tolerance)"
    parser.add_argument("--size-tolerance", type=float, metavar="M", help=size)
    system = "system of the design's coordinates, such as EPSG:25832, or local for the map's frame"
    parser.add_argument("--crs", metavar="NAME", help=system)
    parser.add_argument(
        "--unit", metavar="NAME", help="unit of a drawing that states none: m, cm, mm, ft, us-ft, in"
    )
    kinds = "what a name in the design is, such as MARK_02=lane_dash; may be repeated"
    parser.add_argument(
        "--class", dest="kinds", action="append", default=[], metavar="NAME=CLASS", help=kinds
    )
    parser.add_argument("--output", type=Path, metavar="DIR", help="default: outputs/<result>-compared")
    parsed = parser.parse_args(arguments)
    need_installed("scipy")
    from v2hdm.asbuilt.decisions import Tolerances
    from v2hdm.asbuilt.reading import Source
    from v2hdm.asbuilt.writing import summary_lines, write_comparison
    from v2hdm.io.maps.reading import read_map
    from v2hdm.settings import TOLERANCE_M
    from v2hdm.store.names import map_file

    log_to_terminal()
    size_m = parsed.tolerance if parsed.size_tolerance is None else parsed.size_tolerance
    for option, value in (("--tolerance", parsed.tolerance), ("--size-tolerance", size_m)):
        if not TOLERANCE_M.holds(value):
            limits = f"from {TOLERANCE_M.least:g} to {TOLERANCE_M.most:g}"
            raise ConfigError(f"{option} {value:g}: is not a tolerance in m; give one {limits}")
    source = Source(parsed.crs, parsed.unit, kinds_of(parsed.kinds))
    path = map_file(parsed.map)
    hd_map = read_map(path)[0]
    tolerance = Tolerances(parsed.tolerance, size_m)
    compared = _comparison_of(hd_map, path.parent, parsed.design, tolerance, source)
    name = path.parent.resolve().name if parsed.map.is_dir() else path.stem
    folder = parsed.output or Path("outputs") / f"{name}-compared"
    maker = f"v2hdm compare of {path.resolve()} with {parsed.design.resolve()}"
    settings = {"map": str(parsed.map), "design": str(parsed.design), "tolerance": parsed.tolerance}
    with result_of(folder, maker, settings) as unfinished:
        write_comparison(unfinished, hd_map, compared.findings, compared.misfit, str(parsed.design))
    lines = summary_lines(compared.findings, compared.misfit, str(parsed.design))
    print("\n".join([*lines, f"results in {folder}"]))
    return 0 if compared.conforms else EXIT_FAILED_VERDICT


class _Compared(NamedTuple):
    """The findings, the misfit of the whole design, and whether everything conforms."""

    findings: Sequence[Finding]
    misfit: Misfit | None  # None against rules
    conforms: bool


def _comparison_of(
    hd_map: HDMap, folder: Path, path: Path, tolerance: Tolerances, source: Source
) -> _Compared:
    from v2hdm.asbuilt.comparison import compare_with_design
    from v2hdm.asbuilt.decisions import Fate
    from v2hdm.asbuilt.ground import read_mosaic
    from v2hdm.asbuilt.reading import classes_of, read_design
    from v2hdm.asbuilt.rules import compare_with_rules, read_rules

    if path.suffix.lower() == ".csv":
        findings = compare_with_rules(hd_map, read_rules(path, classes_of(hd_map)))
        return _Compared(findings, None, not any(finding.fate is Fate.OFF for finding in findings))
    comparison = compare_with_design(
        hd_map, read_design(path, hd_map, source), tolerance, read_mosaic(folder)
    )
    return _Compared(comparison.findings, comparison.misfit, comparison.conforms)


COMMAND = Command("v2hdm compare", "Compare a map with the design of its site, or with rules.", _run)

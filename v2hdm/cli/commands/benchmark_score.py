"""``v2hdm benchmark score RESULT SITE``: any tool's map against the truth (docs/benchmark.md)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.arguments import add_site, log_to_terminal, steps_of
from v2hdm.cli.command import Command, need_installed


def _run(arguments: Sequence[str]) -> None:
    """Score a map."""
    parser = COMMAND.parser()
    parser.add_argument("map", type=Path, metavar="RESULT", help="GeoJSON, or a result folder of v2hdm map")
    add_site(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of lines")
    system = "system of the coordinates, such as EPSG:32651, or local for metres from the site's origin"
    parser.add_argument("--crs", metavar="NAME", help=system)
    kinds = "what a name in the file is, such as dashed=lane_dash; may be repeated"
    parser.add_argument(
        "--class", dest="kinds", action="append", default=[], metavar="NAME=CLASS", help=kinds
    )
    where = "folder that keeps the truth once it is made (default: cache)"
    parser.add_argument("--cache", type=Path, default=Path("cache"), metavar="DIR", help=where)
    parsed = parser.parse_args(arguments)
    need_installed("torch")
    from v2hdm.asbuilt.reading import Source
    from v2hdm.benchmark.scoring import score_map, table_of
    from v2hdm.benchmark.sites import reference_of, site_of, truth_hash
    from v2hdm.benchmark.submissions import read_content, read_submission
    from v2hdm.cli.arguments import kinds_of
    from v2hdm.executor import HERE

    log_to_terminal()
    site = site_of(parsed.site, parsed.way)
    kind_of = kinds_of(parsed.kinds)
    read_content(parsed.map)  # before the truth is made, which takes a minute
    steps_of("make the truth")(0, 1)
    reference = reference_of(site, parsed.cache, HERE, lambda task, done, total: None)
    submission = read_submission(parsed.map, reference.truth.map, Source(parsed.crs, None, kind_of))
    score = score_map(submission, reference, site.name)
    digest = truth_hash(reference)
    is_published = digest == site.truth_sha256
    if parsed.json:
        print(json.dumps({**score.as_json(), "truth_sha256": digest, "truth_is_published": is_published}))
        return
    print("\n".join(table_of(score)))
    if site.truth_sha256 and not is_published:
        print(f"truth: sha256 {digest}, not as published ({site.truth_sha256}); say so with these figures")


COMMAND = Command(
    "v2hdm benchmark score",
    "Score the map of any tool against the truth of a benchmark.",
    _run,
)

"""``v2hdm mosaic RESULT``: the ground from above, as a GeoTIFF and as pictures before and after.

docs/mosaic.md describes it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.main import parser_of


def run(arguments: Sequence[str]) -> None:
    """Add the mosaic to a result."""
    parser = parser_of("mosaic")
    parser.add_argument("result", type=Path, help="result folder of v2hdm map")
    parser.add_argument(
        "--drive", type=Path, help="the drive's folder (default: where it was when it was mapped)"
    )
    parser.add_argument(
        "--resolution", type=float, metavar="M", help="side of a pixel on the ground (default: 0.02 m)"
    )
    parser.add_argument("--device", default="cpu", help="cpu or cuda (default: cpu)")
    parsed = parser.parse_args(arguments)
    import torch  # noqa: F401  # its absence is reported before that of what is built on it

    from v2hdm.pipeline.mosaic import mosaic_of_result

    for line in mosaic_of_result(parsed):
        print(line)

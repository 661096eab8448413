"""``v2hdm labels RESULT``: the map in every image of its drive, as labels to train from.

docs/labels.md describes it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.main import parser_of, result_of, steps_of


def run(arguments: Sequence[str]) -> None:
    """Write ``instances.json``, in COCO's format."""
    parser = parser_of("labels")
    parser.add_argument("result", type=Path, help="result folder of v2hdm map")
    parser.add_argument("--output", type=Path, metavar="DIR", help="labels (outputs/<drive>-labels)")
    parser.add_argument("--drive", type=Path, help="the drive's folder (default: where it was when mapped)")
    parser.add_argument("--range", type=float, metavar="M", default=16.0, help="farthest label (16)")
    parsed = parser.parse_args(arguments)
    from v2hdm.io.drive.of_result import single_drive_of
    from v2hdm.labels import FILE, write_labels

    drive = single_drive_of(parsed.result, parsed.drive, "labels are")
    folder = parsed.output or Path("outputs") / f"{drive.name}-labels"
    made = f"v2hdm labels of {parsed.result.resolve()}"
    with result_of(folder, made, {"result": str(parsed.result), "range_m": parsed.range}) as unfinished:
        found = write_labels(parsed.result, drive, unfinished, parsed.range, steps_of("label images"))
    print(
        f"{found['shown']} labels in {found['images']} images, {found['unsure']} of unsure visibility; "
        f"{found['hidden']} markings are hidden where they would be\n"
        f"labels in {folder}: python -m train labels=map data.coco={folder / FILE} "
        f"data.coco_images={drive.root}"
    )

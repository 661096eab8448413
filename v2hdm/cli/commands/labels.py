"""``v2hdm labels RESULT`` (docs/labels.md)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.arguments import add_result, result_of, steps_of
from v2hdm.cli.command import Command


def _run(arguments: Sequence[str]) -> None:
    """Write ``instances.json``, the map in every image of its drive, in COCO's format."""
    parser = COMMAND.parser()
    add_result(parser)
    parser.add_argument("--output", type=Path, metavar="DIR", help="folder (default: outputs/<drive>-labels)")
    parser.add_argument("--range", type=float, metavar="M", default=16.0, help="farthest label (default: 16)")
    parsed = parser.parse_args(arguments)
    from v2hdm.io.drive import single_drive_of
    from v2hdm.labels import FILE, write_labels

    drive = single_drive_of(parsed.result, parsed.drive, "labels are")
    folder = parsed.output or Path("outputs") / f"{drive.name}-labels"
    maker = f"v2hdm labels of {parsed.result.resolve()}"
    with result_of(folder, maker, {"result": str(parsed.result), "range_m": parsed.range}) as unfinished:
        counts = write_labels(parsed.result, drive, unfinished, parsed.range, steps_of("label images"))
    print(
        f"{counts['shown']} labels in {counts['images']} images, {counts['unsure']} of uncertain visibility; "
        f"{counts['hidden']} markings are hidden there\n"
        f"labels in {folder}: python -m train labels=map data.coco={folder / FILE} "
        f"data.coco_images={drive.root}"
    )


COMMAND = Command(
    "v2hdm labels", "Label a result's markings in every image of its drive, for training.", _run
)

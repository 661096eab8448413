"""Whether a map teaches its own detector: two drives of a site whose paint the shipped network hardly knows.

    python -m tests.benchmarks.self_training runs/self [--minutes 15] [--paint wear=0.45 dirt=0.4]

renders both drives, each with its own markings, light and errors, maps them with the shipped network, makes
labels of the first one's map (``v2hdm labels``), trains on these, exports, and maps the second drive anew. No
person labels anything, and nothing of the second drive is learnt. It prints recall and false markings of
both. What is there already is not made again.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[2]
ROUTE = "[[30.0,0.0],[23.0,90.0],[25.0,0.0]]"
SEEDS = {"taught": 31, "unseen": 32}


def run(*command: str) -> None:
    """Run a command of ours, or end with what it says."""
    print("$", *command, flush=True)
    subprocess.run([sys.executable, "-m", *command], cwd=ROOT, check=True)


def mapped(folder: Path, name: str, drive: str, paint: Sequence[str], model: str | None = None) -> Path:
    """The result of mapping one of the two drives, by the shipped network or another one."""
    result = folder / name
    if not (result / "metrics.json").is_file():
        run(
            "v2hdm", "map", "+run=port2", f"name={name}", f"output={folder}", f"cache={folder / 'cache'}",
            f"simulate.name={drive}", f"simulate.seed={SEEDS[drive]}", f"simulate.route.pieces={ROUTE}",
            "simulate.route.image_spacing_m=1.5", *(f"simulate.paint.{override}" for override in paint),
            "workers=1", *([f"detector.model={model}"] if model else []),
        )  # fmt: skip
    return result


def taught(folder: Path, result: Path, minutes: float) -> Path:
    """The network that has learnt from the labels of a map, exported."""
    (drive,) = (folder / "cache").glob("taught-*")
    labels, training, model = folder / "labels", folder / "training", folder / "taught.onnx"
    if not labels.is_dir():
        run("v2hdm", "labels", str(result), "--output", str(labels))
    if not model.is_file():
        run(
            "train", "labels=map", "start=models/marking_net.onnx", f"data.coco={labels / 'instances.json'}",
            f"data.coco_images={drive}", f"minutes={minutes}", "learning_rate=5e-4", "ema_updates=100",
            f"output={training}",
        )  # fmt: skip
        run("export", f"checkpoint={training / 'last.pt'}", f"output={model}")
    return model


def row(name: str, result: Path) -> str:
    """A line of the table: recall of each class, and false markings."""
    figures = json.loads((result / "metrics.json").read_text())
    of_all = figures["results"]["both"]["Opt"]
    recall = ", ".join(
        f"{kind} {counts['recall']:.2f} of {counts['expected']}"
        for kind, counts in of_all["by_class"].items()
        if counts["expected"]
    )
    verdict = figures["verdict"]["status"]
    return f"{name:28s} recall {of_all['recall']:.3f} ({recall}), {of_all['false_markings']} false, {verdict}"


def main() -> None:
    """Map, teach, map again; print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--minutes", type=float, default=15.0)
    parser.add_argument("--paint", nargs="*", default=["wear=0.45", "dirt=0.4"])
    parsed = parser.parse_args()
    folder = parsed.folder.resolve()
    first = mapped(folder, "first", "taught", parsed.paint)
    before = mapped(folder, "before", "unseen", parsed.paint)
    after = mapped(folder, "after", "unseen", parsed.paint, str(taught(folder, first, parsed.minutes)))
    for name, result in (("taught, shipped network", first), ("unseen, shipped network", before)):
        print(row(name, result))
    print(row("unseen, after the first map", after))


if __name__ == "__main__":
    main()

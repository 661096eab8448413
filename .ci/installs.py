"""Each extra keeps what the documents promise: ``make installs`` installs the wheel and tries it.

The wheel is built once. The base install and ``[map]`` have an environment each; ``[map,ros]``,
``[map,video]``, ``[map,text]`` and ``[map,pdf]`` stand on ``[map]``. A page, or a section, begins with what
it needs; the first command there with each word of :data:`PROMISES` runs in the environment with just that,
on the small drive of the documents' tests, which the first command of ``[map]`` renders and maps. The
documents' tests run all commands.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
from environments import Environment

from tests.docs.blocks import ROOT, blocks, document
from tests.docs.sandbox import furnish
from tests.docs.smaller import SMALL_PORT, smaller
from v2hdm.cli.main import all_commands

_NEEDS = re.compile(r"\*Needs `pip install '?\.(?:\[([a-z,]+)\])?'?`")
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]

PROMISES = {
    "docs/detect.md": ("detect",),
    "docs/calibration.md": ("calibrate points", "calibrate ground", "calibrate compare"),
    "docs/exports.md": ("--format csv", "--format kalibr"),
    "docs/cache.md": ("cache list",),
    "docs/check.md": ("check",),
    "docs/living-map.md": ("localize",),
    "docs/report.md": ("v2hdm report", "v2hdm mosaic"),
    "docs/bags.md": ("check site",),
    "docs/benchmark.md": ("benchmark make",),
}
"""Words by document: the first line of its blocks with each of them is run, in each environment."""

MAP_PORT = f"v2hdm map +run=port2 workers=1 mosaic=false {' '.join(map(repr, SMALL_PORT))}"

FIRST = f"{MAP_PORT} all_maps=true"
"""Makes the drive and the result on which all other commands work."""

MORE = {
    "": (
        "v2hdm export map.geojson --format geojson --output exported",
        "v2hdm detect film.mp4 --limit 1",
        "v2hdm --version",
    ),
    "map": (
        "v2hdm export map.geojson --format lanelet2",
        "v2hdm experiment --cfg job",
        "python -c 'import v2hdm.paper, v2hdm.experiment.run'",
        "v2hdm detect images --limit 1",
    ),
    "map,ros": (
        "v2hdm check site --list-topics",
        "v2hdm detect site --limit 1",
        "v2hdm export map.geojson --format mcap",
    ),
    "map,video": (
        "v2hdm check drives/film --no-ground --workers 1 --output outputs/film-check",
        "v2hdm detect drives/film --limit 1",
    ),
    "map,text": (
        "python -c 'from v2hdm.words.recogniser import load_recogniser; assert load_recogniser(1)'",
        MAP_PORT,
    ),
    "map,pdf": ("v2hdm report outputs/port2 --pdf",),
}
"""Commands, by extras, for work that no page shows as a short command of its own."""

MISSING = "needs [a-z0-9_.]+: install the [a-z]+ extra, pip install 'v2hdm\\[[a-z]+\\]'"


def lines_of(extras: str) -> list[str]:
    """The commands that the documents promise with just these extras."""
    lines = []
    for page, words in PROMISES.items():
        run = [block for block in blocks(page, "sh") if block.not_run_because is None]
        listed = [(line, _needs(page, block.line)) for block in run for line in block.lines]
        for word in words:
            chosen = [one for one in listed if "v2hdm" in one[0] and word in one[0]]
            assert chosen, f"{page}: none of its commands has {word}"
            lines += [_small(line) for line, needs in chosen if needs == extras][:1]
    return [*dict.fromkeys(lines), *MORE[extras]]


def _needs(page: str, line: int) -> str:
    """The extras that a page's text before a line says last."""
    said = _NEEDS.findall("\n".join(document(page).splitlines()[: line - 1]))
    assert said, f"{page}:{line}: nothing before it says what it needs"
    return said[-1]


def _small(line: str) -> str:
    program, *rest = line.split()
    if program == "python":
        return line
    return " ".join([program, *smaller(rest)])


def prepare(folder: Path) -> None:
    """Lay out what the documents' commands name beside a map, and a drive with a video."""
    furnish(folder)
    film = folder / "drives" / "film"
    shutil.copytree(folder / "drives" / "mysite", film)
    images = sorted((film / "front" / "images").iterdir())
    size = cv2.imread(str(images[0])).shape[1::-1]
    writer = cv2.VideoWriter(str(film / "front.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10, size)
    for image in images:
        writer.write(cv2.imread(str(image)))
    writer.release()
    stamps = [
        line.split()[0] for line in (film / "front" / "images.txt").read_text().splitlines() if line[0] != "#"
    ]
    (film / "times.txt").write_text("\n".join(stamps) + "\n")
    described = (film / "drive.yaml").read_text()
    video = "images: {video: front.mp4, stamps: times.txt}"
    (film / "drive.yaml").write_text(described.replace("images: front/images.txt", video))
    shutil.copy(film / "front.mp4", folder / "film.mp4")


def tried(name: str, environment: Environment, lines: list[str], here: Path) -> int:
    """Run lines in an environment; how many failed."""
    failed = 0
    for line in lines:
        began = time.perf_counter()
        done = environment.run(line, here)
        good = done.returncode in (0, 3) and "Traceback" not in done.stderr
        failed += not good
        shown = line if len(line) < 90 else f"{line[:87]}..."
        print(
            f"{'ok  ' if good else 'FAIL'} {time.perf_counter() - began:5.1f} s  [{name}]  {shown}",
            flush=True,
        )
        if not good:
            print(done.stdout[-2000:], done.stderr[-4000:], sep="\n", flush=True)
    return failed


def missing(environment: Environment, here: Path) -> int:
    """Run what the base install cannot do: each is one line that names an extra; how many are not."""
    failed = 0
    for name, command in all_commands().items():
        if command.extra is None or name == "calibrate ground":  # which the base install can do
            continue
        arguments = {"calibrate points": "points.csv --intrinsics camera_info.yaml"}
        given = {
            "map": "+run=port2",
            "simulate": "+run=port2",
            "experiment": "",
            "fleet": "a.yaml",
            "check": "drives/mysite",
            "benchmark make": "streets out",
            "benchmark score": "map.geojson streets",
        }
        words = arguments.get(name) or given.get(name, "outputs/port2")
        words += " outputs/friday" * (name in ("calibrate compare", "compare"))
        words += " drives/mysite" * (name == "localize")
        done = environment.run(f"v2hdm {name} {words}", here)
        good = done.returncode == 2 and re.fullmatch(f"error: v2hdm {name} {MISSING}\n", done.stderr)
        failed += not good
        print(f"{'ok  ' if good else 'FAIL'} missing  {done.stderr.strip()[-300:]}", flush=True)
    return failed


def main() -> int:
    """Try all environments; the number of what failed."""
    with TemporaryDirectory(prefix="v2hdm-installs-") as scratch:
        here, wheels, packages = (Path(scratch) / name for name in ("here", "wheels", "packages"))
        here.mkdir()
        build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
        subprocess.run([*build, "--disable-pip-version-check", "-w", wheels, ROOT], check=True)
        (wheel,) = wheels.glob("*.whl")
        mapping = Environment.new(Path(scratch) / "map", wheel, "map")
        if failed := tried("map", mapping, [FIRST], here):
            return failed
        prepare(here)
        base = Environment.new(Path(scratch) / "base", wheel)
        failed = tried("base", base, lines_of(""), here) + missing(base, here)
        failed += tried("map", mapping, lines_of("map"), here)
        ros = mapping.beside(packages / "ros", *EXTRAS["ros"])
        failed += tried("map,ros", ros, lines_of("map,ros"), here)
        video = mapping.beside(packages / "video", *EXTRAS["video"])
        failed += tried("map,video", video, lines_of("map,video"), here)
        text = mapping.beside(packages / "text", *EXTRAS["text"])
        failed += tried("map,text", text, lines_of("map,text"), here)
        pdf = mapping.beside(packages / "pdf", *EXTRAS["pdf"])
        failed += tried("map,pdf", pdf, lines_of("map,pdf"), here)
    print(f"{failed} failed" if failed else "every promise is kept")
    return failed


if __name__ == "__main__":
    sys.exit(min(main(), 1))

"""Settings that cannot be, of every door that Hydra configures."""

from collections.abc import Iterator
from dataclasses import fields as fields_of
from dataclasses import is_dataclass
from pathlib import Path

from tests.faults.judge import Case, Prepare
from tests.faults.making import (
    both,
    drive,
    write,
)
from tests.faults.texts import YAML_TEXTS
from v2hdm.pipeline.config import PortConfig, RunConfig


def _plainly(lines: str) -> dict[str, str]:
    """Settings that an error repeats: of ``data.width=7`` it says ``width is 7``, of words in quotes."""
    pairs = [(line, *line.split("=")) for line in lines.split()]
    return {line: f"{key.rpartition('.')[2]} is '?{value}" for line, key, value in pairs}


SETTINGS = _plainly(
    "workers=-1 device=tpu mode=x mapping.max_range_m=nan mapping.max_range_m=inf mapping.max_range_m=0 "
    "mapping.rounds=0 mapping.loss=x mapping.pose_model=x mapping.lanes.min_images=-1 detector.threads=0 "
    "detector.blur_px=99 detector.max_range_m=-1 detector.min_score=nan detector.border_px=-3 "
    "detector.lane_step_m=-1 drive.max_gap_s=-1 drive.max_gap_s=nan"
) | {
    "workers=99999999999999999999": "workers is",
    "workers=many": "workers=many",
    "name=../x": "path separator",
    "name=..": "begins with a dot",
    "'name=\"a/b\"'": "path separator",
    "+mapping.known_sizes.by_class_m={squid: [1.0, 0.7]}": "there is no such class",
    "+mapping.known_sizes.by_class_m={diamond: [1.0]}": "by_class_m",
    "+mapping.known_sizes.by_class_m={diamond: [.nan, 1.0]}": "by_class_m",
    "detector.model=nowhere.onnx": "nowhere.onnx",
    "export=[pdf]": "pdf",
    "maping.max_range_m=1": "did you mean mapping",
    "drive": "is not key=value",
    "+run=port9": "port9",
    "drive.path=straße": "needs quotes",
    "mapping=null": "mapping",
    "drive.cameras=front": "drive.cameras",
    "--config-name=x": "no option --config-name=x",
}
SIMULATED = _plainly(
    "simulate.seed=-1 simulate.cameras.front.width=0 simulate.cameras.front.width=100000 "
    "simulate.route.image_spacing_m=0 simulate.route.speed_mps=nan "
    "simulate.exposure.full_well_electrons=0 simulate.yard.barriers=-5"
) | {
    "simulate.name=../x": "path separator",
    "+simulate.cameras.both=${simulate.cameras.front}": "results of all",
}
TRAINING = _plainly(
    "batch=0 batch=-4 data.width=7 data.width=0 data.height=100 data.reservoir=0 data.views_per_render=0 "
    "data.workers=-1 data.kerbs=nan data.labelled_share=2 learning_rate=nan learning_rate=-1 learning_rate=0 "
    "weight_decay=inf minutes=-1 minutes=nan minutes=inf steps=0 warmup=1 ema_updates=0 threads=0 seed=-1 "
    "checkpoint_minutes=0 net.head_width=0 loss.dice=-1 validation.images=-1"
) | {
    "data.width=1024": "data.width x data.height",
    "net.widths=[8]": "net.widths",
    "net.widths=[]": "net.widths",
    "device=abacus": "device=abacus",
    "start=nowhere.pt": "nowhere.pt",
    "catalogue=nowhere.yaml": "nowhere.yaml",
    "data.coco=nowhere.json": "nowhere.json",
}
AREAS = _plainly("steps=0 sky=2 threads=0 render_share=nan render_views=-1 seed=-1") | {
    "classes=[]": "name one class or more",
    "start=nowhere.pt": "nowhere.pt",
    "data.coco=nowhere.json": "nowhere.json",
}
SCORES = {
    "seed=1": "start",
    "start=nowhere.pt": "nowhere.pt",
}
EXPORTS = _plainly("opset=3 opset=99 tolerance=nan int8.frames=0 int8.bounds.kinds_agree=7") | {
    "checkpoint=nowhere.pt": "nowhere.pt",
    "precision=int4": "precision",
    "output=a.pt": "inputs",
}


def measures(options: object, below: str = "") -> Iterator[str]:
    """The keys of all settings that are numbers with a fraction, also of those that are added later."""
    for field in fields_of(options):
        value = getattr(options, field.name)
        if is_dataclass(value):
            yield from measures(value, f"{below}{field.name}.")
        elif isinstance(value, float):
            yield below + field.name


SIGNED = ("start_s", "sun_azimuth_deg", "sun_elevation_deg", "moving_offset_m")


def numbers() -> Iterator[Case]:
    """No measure is NaN, and none but an angle or a time is negative."""
    for options, below, run in (
        (RunConfig(), "", ("drive.path=drive",)),
        (PortConfig(), "simulate.", ("+run=port2",)),
    ):
        for key in measures(options, below):
            last = key.rpartition(".")[2]
            for value in ("nan",) if last in SIGNED else ("nan", "-1e-3"):
                words = (*run, "workers=1", f"{key}={value}")
                yield Case(f"number: {key}={value}", "v2hdm map", words, drive(), last)


def settings() -> Iterator[Case]:
    """Settings of the doors that Hydra configures."""
    for line, says in SETTINGS.items():
        words = (line.strip("'"), "workers=1") if "workers" not in line else (line,)
        yield Case(f"map {line}", "v2hdm map", ("drive.path=drive", *words), drive(), says)
    for line, says in SIMULATED.items():
        yield Case(f"map {line}", "v2hdm map", ("+run=port2", "workers=1", line), both(), says)
    for line, says in TRAINING.items():
        end = () if line.startswith(("minutes", "steps")) else ("steps=1",)
        words = (line, *end) if line.startswith("validation") else (line, *end, "validation.images=0")
        yield Case(f"train {line}", "train.__main__", words, both(), says)
    for line, says in AREAS.items():
        yield Case(f"areas {line}", "train.areas.__main__", (line,), both(), says)
    for line, says in SCORES.items():
        yield Case(f"score {line}", "train.score", (line,), both(), says)
    for line, says in EXPORTS.items():
        words = [
            setting
            for setting in ("checkpoint=a.pt", "output=b.onnx")
            if setting.split("=")[0] != line.split("=")[0]
        ]
        yield Case(f"export {line}", "export.__main__", (*words, line), write("a.pt", "x"), says)
    run = ("drive.path=drive", "--config-dir", "conf", "+run=mine", "workers=1")
    for name, (text, says) in YAML_TEXTS.items():
        if name in ("empty", "only a comment"):
            continue
        header = b"# @package _global_\n" if name not in ("utf-16",) else b""
        data = text.encode() if isinstance(text, str) else text
        says = says if "expected" not in says else "mine|list|dict|config"
        yield Case(
            f"run file: {name}", "v2hdm map", run, _run_file(header + data), f"{says}|mine.yaml|configuration"
        )
    yield Case("run file without its header", "v2hdm map", run, _run_file(b"name: x\n"), "@package _global_")


def _run_file(data: bytes) -> Prepare:
    def prepare(root: Path) -> None:
        drive()(root)
        (root / "conf" / "run").mkdir(parents=True)
        (root / "conf" / "run" / "mine.yaml").write_bytes(data)

    return prepare

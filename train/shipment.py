"""Ship a trained network as the detector's own: export, classifier, lane score, manifest, in this order.

Each step leaves its files in a folder of ``runs/`` named by all that they depend on: the network, the numbers
of renders and the code. A run that was stopped finds there what it has done; after a change it begins anew.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
from rich.console import Console

from export.class_rows import add_classes
from export.config import ExportConfig, Precision
from export.console import run as export
from export.manifest import record
from export.source import read_source
from train import fit_judge, fit_lane_score
from train.bar import Share, share_of_work
from train.checkpoint import load_checkpoint
from train.config import DataConfig
from train.exported import read_exported
from train.fit_judge import Gathered
from train.labels import LabelledImages, read_labels
from v2hdm.detection import weights
from v2hdm.errors import ConfigError
from v2hdm.executor import open_executor
from v2hdm.store.files import whole_file

_ROOT = Path(__file__).resolve().parents[1]
_CODE = ("v2hdm", "models", "train", "export")
_FLOAT_FILE = _ROOT / "models" / "marking_net.onnx"
_KEPT_FILES = {
    "network": (weights.NETWORK_FILE.name,),
    "judge": (weights.JUDGE_FILE.name, weights.CONFIDENCE_FILE.name),
    "lane_score": (weights.LANE_SCORE_FILE.name,),
}
_LEAST_IMAGES = 100
"""Fewer renders leave some fifth of them without a marking of some class."""

_PART_IMAGES = 25
"""Renders that one process looks at in one go: what a kill loses at most, per process."""

_EXPORTED = 0.05  # share of the time that has passed after the export, about
_GATHERED = 0.6  # share after the judge's examples
_JUDGED = 0.85  # share after the judge's fit
_LANES_SEEN = 0.99  # share after the lane score's examples


@dataclass(frozen=True, kw_only=True)
class Order:
    """A shipment; its fields are the arguments of :mod:`train.ship`."""

    source: Path
    into: Path | None = None
    precision: str = "int8"
    keep: Sequence[str] = ()
    judge_images: int = 1650
    lane_images: int = 450
    workers: int = 0
    labels: Path | None = None

    @property
    def network(self) -> Path:
        """The checkpoint or exported file that ``source`` stands for."""
        return self.source / "best.pt" if self.source.is_dir() else self.source

    @property
    def folder(self) -> Path:
        """Where the files go."""
        return self.into or weights.FOLDER

    @property
    def float_file(self) -> Path:
        """Where the network of float32 goes."""
        return _FLOAT_FILE if self.into is None else self.into / _FLOAT_FILE.name

    @property
    def command(self) -> str:
        """The command that this is, without folders of this machine: users read it in the manifest."""
        source = self.source.resolve()
        here = Path.cwd()
        shown = source.relative_to(here) if source.is_relative_to(here) else source.name
        options = f" --keep {' '.join(self.keep)}" if self.keep else ""
        options += f" --labels {self.labels.name}" if self.labels else ""
        images = f"--judge-images {self.judge_images} --lane-images {self.lane_images}"
        return f"python -m train.ship {shown} --precision {self.precision} {images}{options}"


def ship(order: Order, tell: Share) -> Path:
    """Export, fit, and put the files in place; returns the folder that they are in.

    Raises:
        ConfigError: The network cannot be read, a kept file is not there, or there are too few renders.
        DetectorError: The exported file would not do what the network does.
    """
    _check(order)
    folder = Path("runs") / f"ship-{_state(order)}"
    folder.mkdir(parents=True, exist_ok=True)
    for name in (file for part in order.keep for file in _KEPT_FILES[part] if part != "network"):
        _copy(order.folder / name, folder / name)
    _export(order, folder, tell)
    if not (folder / weights.JUDGE_FILE.name).is_file():
        _fit_judge(order, folder, tell)
    if not (folder / weights.LANE_SCORE_FILE.name).is_file():
        _fit_lane_score(order, folder, tell)
    tell(_LANES_SEEN, "putting the files in place")
    record(list(weights.COMMANDS), order.command, folder)
    weights.check_weights(folder)
    if (folder / _FLOAT_FILE.name).is_file():
        _copy(folder / _FLOAT_FILE.name, order.float_file)
    for name in (*weights.COMMANDS, weights.MANIFEST_FILE.name):
        _copy(folder / name, order.folder / name)
    shutil.rmtree(folder)
    return order.folder


def ship_on_terminal(order: Order) -> None:
    """:func:`ship` with a bar over all of its steps."""
    with share_of_work(Console(stderr=True), "reading") as tell:
        folder = ship(order, tell)
        tell(1.0, "done")
    print(f"{folder}: network, judge and lane score of {order.source}")


def _check(order: Order) -> None:
    if not order.network.is_file():
        raise ConfigError(f"no network at {order.network}: train one with `python -m train`, or name another")
    for option, images in (("judge", order.judge_images), ("lane", order.lane_images)):
        if images < _LEAST_IMAGES:
            raise ConfigError(f"--{option}-images {images}: give {_LEAST_IMAGES} or more")
    if "network" in order.keep and order.precision != Precision.int8.value:
        raise ConfigError("--keep network keeps a rounded file: leave out --precision, or --keep network")
    for name in (file for part in order.keep for file in _KEPT_FILES[part]):
        if not (order.folder / name).is_file():
            raise ConfigError(f"{order.folder / name}: no such file to keep; leave out --keep to fit it")


def _state(order: Order) -> str:
    """A name for all that the files depend on."""
    said = f"{order.precision} {order.judge_images} {order.lane_images} {sorted(order.keep)}"
    digest = hashlib.sha256(said.encode() + order.network.read_bytes())
    for name in (file for part in order.keep for file in _KEPT_FILES[part]):
        digest.update((order.folder / name).read_bytes())
    for package in _CODE:
        for path in sorted((_ROOT / package).rglob("*.py")) + sorted((_ROOT / package).rglob("*.yaml")):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def _export(order: Order, folder: Path, tell: Share) -> None:
    """Write the network that runs on the vehicle and, unless it was rounded before, that of float32."""
    network = folder / weights.NETWORK_FILE.name
    source = order.network
    if network.is_file():
        return
    if source.suffix == ".onnx" and read_exported(source).label.get("precision", "float32") != "float32":
        _copy(source, network)
        return
    tell(0.0, "exporting the network")
    export(ExportConfig(checkpoint=str(source), output=str(folder / _FLOAT_FILE.name)))
    if "network" in order.keep:
        tell(_EXPORTED, "adding the network's classes to the rounded file")
        add_classes(order.folder / weights.NETWORK_FILE.name, order.float_file, read_source(source), network)
        return
    config = ExportConfig(checkpoint=str(source), output=str(network), precision=Precision[order.precision])
    print(export(config, lambda share, doing: tell(_EXPORTED * share, f"exporting the network: {doing}")))


def _fit_judge(order: Order, folder: Path, tell: Share) -> None:
    network = folder / weights.NETWORK_FILE.name
    parts = [
        fit_judge.Part(numbers, order.judge_images, network, folder / f"{k}.npz")
        for k, numbers in enumerate(_in_parts(order.judge_images))
    ]
    if (labels := _labels(order, tell)) is not None:
        parts += [
            fit_judge.Part(
                numbers,
                order.judge_images,
                network,
                folder / f"photographs{k}.npz",
                replace(labels, images=labels.images[numbers.start : numbers.stop]),
            )
            for k, numbers in enumerate(_in_parts(len(labels.images)))
        ]
    left = [part for part in parts if not part.path.is_file()]
    finished = len(parts) - len(left)

    def take(_: object) -> None:
        nonlocal finished
        finished += 1
        share = _EXPORTED + (_GATHERED - _EXPORTED) * finished / len(parts)
        tell(share, f"judge: {finished * _PART_IMAGES} images seen")

    tell(_EXPORTED, "judge: looking at images")
    with open_executor(order.workers, isolated=True) as executor:
        executor.share_out(fit_judge.gather, left, cv2.setNumThreads, (1,), take)

    def learnt(share: float) -> None:
        tell(_GATHERED + (_JUDGED - _GATHERED) * share, "judge: learning")

    learnt(0.0)
    judge, confidence = fit_judge.fit_all(
        Gathered.load([part.path for part in parts]), learnt, _judge_before(order, network)
    )
    fit_judge.write_both(judge, confidence, order.judge_images, folder)


def _judge_before(order: Order, network: Path) -> Path | None:
    """The judge of the same network that is to be replaced, to learn on from it, if there is one."""
    judge, before = (order.folder / name for name in (weights.JUDGE_FILE.name, weights.NETWORK_FILE.name))
    is_same = judge.is_file() and before.is_file() and before.read_bytes() == network.read_bytes()
    return judge if is_same else None


def _labels(order: Order, tell: Share) -> LabelledImages | None:
    """The photographs that the training learnt from, if any."""
    source = order.labels or order.network
    if source.suffix == ".onnx":
        return None
    data = DataConfig(**load_checkpoint(source / "best.pt" if source.is_dir() else source).config["data"])
    if data.coco is None or data.coco_camera is None:
        return None
    return read_labels(data, tell=lambda share, doing: tell(_EXPORTED, doing))


def _fit_lane_score(order: Order, folder: Path, tell: Share) -> None:
    network = folder / weights.NETWORK_FILE.name
    parts = [
        fit_lane_score.Part(numbers, order.lane_images, network) for numbers in _in_parts(order.lane_images)
    ]
    images: list[fit_lane_score.Seen] = []

    def take(images_of_part: list[fit_lane_score.Seen]) -> None:
        images.extend(images_of_part)
        share = _JUDGED + (_LANES_SEEN - _JUDGED) * len(images) / order.lane_images
        tell(share, f"lane score: {len(images)} renders seen")

    tell(_JUDGED, "lane score: looking at renders")
    with open_executor(order.workers, isolated=True) as executor:
        executor.share_out(fit_lane_score.see, parts, cv2.setNumThreads, (1,), take)
    fit_lane_score.write(fit_lane_score.fit_to(images), folder)


def _in_parts(images: int) -> list[range]:
    return [range(k, min(k + _PART_IMAGES, images)) for k in range(0, images, _PART_IMAGES)]


def _copy(source: Path, destination: Path) -> None:
    try:
        with whole_file(destination) as partial:
            shutil.copyfile(source, partial)
    except OSError as error:
        raise ConfigError(f"{destination}: cannot be written ({error.strerror})") from None

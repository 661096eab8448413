"""Digests of everything that a run is made of: drives by the content of their images, files by theirs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from v2hdm.detection.options import DetectorOptions
from v2hdm.errors import DriveError
from v2hdm.pipeline.config import RunConfig, run_name
from v2hdm.records import Drive, Image
from v2hdm.store.cache import key_of
from v2hdm.store.files import file_digest


@dataclass(frozen=True)
class Contents:
    """SHA-256 of image files, by path."""

    digests: Mapping[Path, str]

    @classmethod
    def of(cls, drives: Iterable[Drive]) -> Contents:
        """Digests of all images of some drives; raises DriveError where one cannot be read."""
        try:
            return cls({image.path: file_digest(image.path) for drive in drives for image in drive.images})
        except OSError as failure:
            raise DriveError(f"{failure.filename}: cannot be read ({failure.strerror})") from None

    def of_images(self, images: Iterable[Image]) -> list[str]:
        """Digests of some images, in their order."""
        return [self.digests[image.path] for image in images]

    def key(self, drive: Drive) -> str:
        """The key of a drive: its records and the content of its images."""
        return key_of(drive, self.of_images(drive.images))


def model_key(options: DetectorOptions) -> str | None:
    """SHA-256 of the network that a detector uses, None for the shipped one, which is code."""
    return None if options.model is None else file_digest(Path(options.model))


def base_files(path: Path) -> tuple[Path, tuple[Path, ...], Path]:
    """The map, trajectories and exclusions of an earlier map, given as a folder or its ``map.geojson``."""
    hd_map = path / "map.geojson" if path.is_dir() else path
    return hd_map, tuple(sorted(hd_map.parent.glob("trajectory*.tum"))), hd_map.parent / "excluded.geojson"


def made_of_drives(paths: Sequence[str]) -> str:
    """Name the maker of a result of the drives at these paths."""
    return f"v2hdm map of {', '.join(paths)}"


def result_key(config: RunConfig, drives: Sequence[Drive], contents: Contents, code: str) -> str:
    """The key of a run's whole result: all that it depends on, and nothing else; ``code`` is the code's."""
    asked = replace(
        config, name=run_name(config), output="", cache="", cache_gb=0.0, resume=True,
        workers=0, drive=replace(config.drive, path=None, cache=""),
    )  # fmt: skip
    files: list[Path] = []
    if config.map.base is not None:
        hd_map, trajectories, excluded = base_files(Path(config.map.base))
        files += [hd_map, *trajectories, excluded]
    named = (config.mapping.survey.file, config.map.corrections, config.report.background)
    files += [Path(one) for one in named if one is not None]
    truths = [drive.truth_dir for drive in drives if drive.truth_dir is not None]
    files += [path for truth in truths for path in sorted(truth.rglob("*"))]
    read = [(str(path), file_digest(path)) for path in files if path.is_file()]
    of_drives = [contents.key(drive) for drive in drives]
    roots = [drive.root.resolve() for drive in drives]
    return key_of(code, asked, model_key(config.detector), roots, of_drives, read)

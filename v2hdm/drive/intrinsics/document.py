"""A calibration file as its text and, where it is YAML, JSON or XML, as entries."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from v2hdm.errors import DriveError
from v2hdm.files import read_text


@dataclass(frozen=True)
class Document:
    """One calibration file: its ``text``, and the ``entries`` at its top, none where it is plain text."""

    path: Path
    text: str
    entries: dict[str, Any]


class _Loader(yaml.SafeLoader):
    """Takes OpenCV's matrices for the entries that they are."""


def _matrix(loader: _Loader, node: yaml.Node) -> dict[Any, Any]:
    if not isinstance(node, yaml.MappingNode):
        raise yaml.constructor.ConstructorError(None, None, "a matrix without rows, cols and data", None)
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def read_document(path: Path) -> Document:
    """Read the file at ``path``.

    Raises:
        DriveError: it is missing, no text, or damaged.
    """
    if path.is_dir():
        raise DriveError(f"{path}: is a folder; name the calibration file in it")
    text = read_text(path, DriveError)
    start = text.lstrip("\ufeff \t\r\n")
    if start.startswith("<"):
        return Document(path, text, _of_xml(path, start))
    if start.startswith("{"):
        return Document(path, text, _of_json(path, start))
    if path.suffix.lower() == ".txt" or not start:
        return Document(path, text, {})
    return Document(path, text, _of_yaml(path, start))


def _of_yaml(path: Path, text: str) -> dict[str, Any]:
    try:
        # OpenCV 4 and others begin their files with a directive that YAML 1.1 refuses.
        parts = list(yaml.load_all(text.removeprefix("%YAML:1.0"), _Loader))
    except yaml.YAMLError as failure:
        mark = getattr(failure, "problem_mark", None)
        line = f" line {mark.line + 1}:" if mark is not None else ""
        problem = getattr(failure, "problem", None) or "not readable"
        raise DriveError(f"{path}:{line} YAML syntax error: {problem}; restore the file") from None
    except RecursionError:
        raise DriveError(f"{path}: nested too deep; restore the file") from None
    # What `ros2 topic echo` writes ends with a second, empty document.
    parts = [part for part in parts if part is not None]
    if len(parts) != 1:
        raise DriveError(f"{path}: {len(parts)} YAML documents; leave one of them in it")
    return parts[0] if isinstance(parts[0], dict) else {}


def _of_json(path: Path, text: str) -> dict[str, Any]:
    try:
        content = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as failure:
        line = f" line {failure.lineno}:" if isinstance(failure, json.JSONDecodeError) else ""
        raise DriveError(f"{path}:{line} JSON syntax error; restore the file") from None
    return content if isinstance(content, dict) else {}


def _of_xml(path: Path, text: str) -> dict[str, Any]:
    if "<!" in text.replace("<!--", ""):
        raise DriveError(f"{path}: holds XML declarations, which no calibration has; restore the file")
    try:
        root = ET.fromstring(text)
    except ET.ParseError as failure:
        raise DriveError(f"{path}: line {failure.position[0]}: XML syntax error; restore the file") from None
    if root.tag != "opencv_storage":
        raise DriveError(f"{path}: expected OpenCV's <opencv_storage>, got <{root.tag}>; name another file")
    return {node.tag: _xml_value(node) for node in root}


def _xml_value(node: ET.Element) -> object:
    if node.get("type_id") == "opencv-matrix":
        entry: dict[str, object] = {child.tag: _scalar(child.text) for child in node}
        entry["data"] = (node.findtext("data") or "").split()
        return entry
    return _scalar(node.text)


def _scalar(text: str | None) -> object:
    """A number where it is one, else the text without the quotes that OpenCV puts around it."""
    words = (text or "").strip()
    try:
        return float(words)
    except ValueError:
        return words.strip('"')

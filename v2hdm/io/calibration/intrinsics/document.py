"""A calibration file as its text and, where it is YAML, JSON or XML, as entries."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from v2hdm.errors import DriveError
from v2hdm.io.texts import parse_json, parse_yaml, read_text


@dataclass(frozen=True)
class Document:
    """One calibration file: its ``text``, and the ``entries`` at its top, none where it is plain text."""

    path: Path
    text: str
    entries: dict[str, Any]


_XML = re.compile(r"<[?!\w]")
"""How XML begins; YAML may begin with ``<<``."""

_END_OF_MESSAGE = re.compile(r"\n---\s*$")
"""What ``ros2 topic echo`` writes ends with a second, empty document."""


def read_document(path: Path) -> Document:
    """Read the file at ``path``.

    Raises:
        DriveError: it is missing, no text, or damaged.
    """
    if path.is_dir():
        raise DriveError(f"{path}: is a folder; name the calibration file in it")
    text = read_text(path, DriveError)
    start = text.lstrip("\ufeff \t\r\n")
    if _XML.match(start):
        return Document(path, text, _of_xml(path, start))
    if start.startswith("{"):
        return Document(path, text, _of_json(path, start))
    if path.suffix.lower() == ".txt" or not start:
        return Document(path, text, {})
    return Document(path, text, _of_yaml(path, start))


def _of_yaml(path: Path, text: str) -> dict[str, Any]:
    # OpenCV 4 begins its files with a directive that YAML 1.1 refuses; its tag says no more than the keys.
    plain = text.removeprefix("%YAML:1.0").replace("!!opencv-matrix", "")
    content = parse_yaml(_END_OF_MESSAGE.sub("\n", plain), str(path), DriveError)
    return content if isinstance(content, dict) else {}


def _of_json(path: Path, text: str) -> dict[str, Any]:
    content = parse_json(text, str(path), DriveError)
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
        entry["data"] = [_scalar(word) for word in (node.findtext("data") or "").split()]
        return entry
    return _scalar(node.text)


def _scalar(text: str | None) -> object:
    """A number where it is one, else the text without the quotes that OpenCV puts around it."""
    words = (text or "").strip()
    try:
        return float(words)
    except ValueError:
        return words.strip('"')

"""A background from the web: tiles of an XYZ or WMTS address in Web Mercator, fetched for the page.

The page itself asks nobody but this server, so that no other one learns its address. What is fetched is
passed on if it is an image, and is decoded by the browser alone.
"""

from __future__ import annotations

import re
import urllib.error
import urllib.request
from dataclasses import dataclass
from http.client import HTTPException
from typing import NamedTuple
from urllib.parse import urlsplit

import numpy as np

from v2hdm.errors import ConfigError
from v2hdm.records import GeodeticOrigin

_TIMEOUT_S = 5.0  # time for a tile, s: an address that takes longer does not serve a person who pans
_MOST_BYTES = 4_000_000  # of a tile
_PROBED_LEVEL = 16  # of the tile that is fetched first: tiles of 600 m, which all services have
_FINEST = 24  # level of tiles, of 2 m
_IMAGES = {b"\x89PNG\r\n": "image/png", b"\xff\xd8\xff": "image/jpeg", b"RIFF": "image/webp"}
"""Types of images by how their files begin."""
_NAMES = {"tilematrix": "z", "tilecol": "x", "tilerow": "y"}  # of WMTS, for those of XYZ
_PLACE = re.compile(r"\{(-?\w+)\}")
_AGENT = "v2hdm-view"


class Tile(NamedTuple):
    """The file of a tile and its type."""

    content: bytes
    type: str


@dataclass(frozen=True)
class TileSource:
    """An address with places for level, column and row: ``{z}``, ``{x}`` and ``{y}``, or WMTS' names."""

    template: str

    @classmethod
    def of(cls, address: str, origin: GeodeticOrigin | None) -> TileSource:
        """The source at an address that answers; raises ConfigError, without the secrets of the address."""
        parts = urlsplit(address)
        names = [_name(place) for place in _PLACE.findall(address)]
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise ConfigError("--background: give an address that begins with https:// or http://")
        if parts.username or parts.password:
            raise ConfigError("--background: leave user and password out of the address; use a key")
        if not {"z", "x"} <= set(names) or not {"y", "-y"} & set(names):
            raise ConfigError(
                f"--background {parts.hostname}: lacks the places of a tile; write {{z}}, {{x}} and {{y}} "
                "into it (for WMTS {TileMatrix}, {TileCol} and {TileRow}, in Web Mercator)"
            )
        unknown = sorted(set(names) - {"z", "x", "y", "-y"})
        if unknown:
            raise ConfigError(
                f"--background {parts.hostname}: {{{unknown[0]}}}: write its value into the address"
            )
        if origin is None:
            raise ConfigError(
                "--background: this map has no position on the earth; state the origin in drive.yaml"
            )
        source = cls(address)
        source.fetch(_PROBED_LEVEL, *tile_at(origin.longitude_deg, origin.latitude_deg, _PROBED_LEVEL))
        return source

    @property
    def host(self) -> str:
        """Where the tiles come from, for messages."""
        return urlsplit(self.template).hostname or ""

    def fetch(self, level: int, column: int, row: int) -> Tile:
        """A tile; raises ConfigError where the address gives none."""
        count = 1 << level
        if not (0 <= level <= _FINEST and 0 <= column < count and 0 <= row < count):
            raise ConfigError(f"--background: there is no tile {level}/{column}/{row}")
        numbers = {"z": level, "x": column, "y": row, "-y": count - 1 - row}
        address = _PLACE.sub(lambda match: str(numbers[_name(match[1])]), self.template)
        request = urllib.request.Request(address, headers={"User-Agent": _AGENT})
        try:
            with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as answer:
                content: bytes = answer.read(_MOST_BYTES + 1)
        except urllib.error.HTTPError as error:
            error.close()
            raise ConfigError(f"--background {self.host}: answers {error.code}; check the address") from None
        except (OSError, HTTPException, ValueError):
            raise ConfigError(
                f"--background {self.host}: does not answer within {_TIMEOUT_S:.0f} s; check the address and "
                "the network, or leave it out"
            ) from None
        kind = next((name for begin, name in _IMAGES.items() if content.startswith(begin)), None)
        if kind is None or len(content) > _MOST_BYTES:
            raise ConfigError(f"--background {self.host}: its tile is not a PNG, JPEG or WebP; check it")
        return Tile(content, kind)


def _name(place: str) -> str:
    return _NAMES.get(place.lower(), place)


def tile_at(longitude_deg: float, latitude_deg: float, level: int) -> tuple[int, int]:
    """Column and row of the tile of a level that shows a place."""
    count = 1 << level
    north = np.arcsinh(np.tan(np.deg2rad(latitude_deg))) / np.pi
    return int((longitude_deg / 360 + 0.5) * count), int((1 - north) / 2 * count)

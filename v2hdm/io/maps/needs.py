"""Packages that only some formats need."""

from __future__ import annotations

import importlib
from typing import Any

from v2hdm.errors import ConfigError

EXTRA = "gis"
"""Optional dependencies of this project that hold them."""


def need(package: str, file_format: str) -> Any:
    """The module ``package``, of which a part may be named with dots.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        return importlib.import_module(package)
    except ModuleNotFoundError as error:
        missing = package.split(".")[0]
        if error.name != missing:
            raise
        raise ConfigError(
            f"the format {file_format} needs {missing}: install the {EXTRA} extra, "
            f"pip install 'v2hdm[{EXTRA}]'"
        ) from None

"""Optional libraries, which an extra of the install brings."""

from __future__ import annotations

import importlib
from types import ModuleType

from v2hdm.errors import V2hdmError


def need(module: str, extra: str, purpose: str, error: type[V2hdmError]) -> ModuleType:
    """The optional ``module``, imported; where it is absent, ``error`` names the ``extra`` that brings it."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as missing:
        if missing.name is None or missing.name.split(".")[0] != module.split(".")[0]:
            raise
    raise error(
        f"{purpose} needs {module.split('.')[0]}: install the {extra} extra, pip install 'v2hdm[{extra}]'"
    )

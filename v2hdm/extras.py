"""Optional libraries, which an extra of the install brings."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
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


@contextmanager
def of_extra(extra: str, purpose: str) -> Iterator[None]:
    """Within, a library that is missing is one line, an ImportError that names the extra which brings it."""
    try:
        yield
    except ModuleNotFoundError as missing:
        if (missing.name or "v2hdm").split(".")[0] == "v2hdm":
            raise
        raise ModuleNotFoundError(
            f"{purpose} needs {missing.name}: install the {extra} extra, pip install 'v2hdm[{extra}]'",
            name=missing.name,
        ) from None

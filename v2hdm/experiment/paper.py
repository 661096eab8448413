"""Where the paper's claims, tables, figures and words lie: ``examples/paper``, in a wheel ``v2hdm/paper``."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

_NAME = "v2hdm.paper"
_PACKAGE = Path(__file__).resolve().parents[1]  # the folder of v2hdm


def load_paper() -> Any:
    """The module of that folder, under one name wherever it lies."""
    if _NAME not in sys.modules:
        shipped = _PACKAGE / "paper"
        folder = shipped if shipped.is_dir() else _PACKAGE.parent / "examples" / "paper"
        spec = importlib.util.spec_from_file_location(
            _NAME, folder / "__init__.py", submodule_search_locations=[str(folder)]
        )
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[_NAME] = module
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[_NAME]
            raise
    return sys.modules[_NAME]

"""Benchmarks, which no other test runs: each name of ours that they import is there."""

import ast
import importlib
from importlib.util import find_spec
from pathlib import Path

import pytest

OURS = ("v2hdm", "tests", "train", "models", "export", "examples")
BENCHMARKS = sorted(Path(__file__).parent.glob("*.py"))


def imports_of(path: Path) -> list[tuple[str, str]]:
    """Modules of ours and the names that a file imports of them, within functions too."""
    nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    statements = [node for node in nodes if isinstance(node, ast.ImportFrom) and node.module]
    of_ours = [node for node in statements if str(node.module).split(".")[0] in OURS]
    return [(str(node.module), alias.name) for node in of_ours for alias in node.names]


def is_there(module: str, name: str) -> bool:
    """Whether a module has a name, or a module of this name below it."""
    try:
        loaded = importlib.import_module(module)
    except ModuleNotFoundError as error:
        # Of the extra bench, which is not installed here.
        return str(error.name).split(".")[0] not in OURS
    return hasattr(loaded, name) or find_spec(f"{module}.{name}") is not None


@pytest.mark.parametrize("path", BENCHMARKS, ids=lambda path: path.stem)
def test_every_name_that_a_benchmark_imports_is_there(path):
    missing = [(module, name) for module, name in imports_of(path) if not is_there(module, name)]
    assert not missing

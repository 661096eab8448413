"""The fenced blocks of the documents, for all tests of what the documents say."""

import importlib.util
import re
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).parents[2]

_FENCE = re.compile(r"^```(\w+)([^\n]*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_TITLE = re.compile(r'title="([^"]+)"')
_NOT_RUN = re.compile(r"\A(?:#!.*\n)?# not run by the tests: (\S.*)\n")


@dataclass(frozen=True)
class Block:
    """A fenced block: of which document, its first line there, language, title ("" for none) and text."""

    document: str
    line: int
    language: str
    title: str
    text: str

    @property
    def not_run_because(self) -> str | None:
        """The reason, which a reader sees too, for which the tests do not run it."""
        marked = _NOT_RUN.match(self.text)
        return marked.group(1) if marked else None

    @property
    def lines(self) -> list[str]:
        """Its commands, a line each: comments and continuations are gone."""
        joined = re.sub(r"\\\n\s*", "", self.text)
        stripped = [re.sub(r"(^|\s)#\s.*$", "", line).strip() for line in joined.splitlines()]
        return [line for line in stripped if line and not line.startswith("#")]


def document(name: str) -> str:
    """The text of a document, by its path in the repository."""
    return (ROOT / name).read_text(encoding="utf-8")


def blocks(name: str, *languages: str) -> list[Block]:
    """The blocks of a document in their order, of the ``languages`` if any are named."""
    text = document(name)
    blocks_of_page = []
    for fence in _FENCE.finditer(text):
        language, info, body = fence.groups()
        title = _TITLE.search(info)
        line = text.count("\n", 0, fence.start()) + 2
        blocks_of_page.append(Block(name, line, language, title.group(1) if title else "", body))
    return [block for block in blocks_of_page if not languages or block.language in languages]


def documents() -> list[str]:
    """The README and the pages of ``docs/``."""
    return ["README.md", *(f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md")))]


def module_at(path: Path) -> ModuleType:
    """The module of a file outside of any package."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module

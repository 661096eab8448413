"""An extension of mkdocstrings for the library's page: examples are shown as code, settings in a table."""

from __future__ import annotations

import re
from importlib import import_module
from typing import Any

from griffe import Attribute, Class, Extension, Object

from v2hdm.settings import ANY_NUMBER, Setting, settings_of

_EXAMPLE = re.compile(r"^>>> .*(?:\n.+)*", re.MULTILINE)


class ApiPages(Extension):
    """Changes docstrings and types before they are shown."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Put a fence around each example, which begins with ``>>>`` and ends with a blank line."""
        if obj.docstring is not None:
            obj.docstring.value = _EXAMPLE.sub(r"```pycon\n\g<0>\n```", obj.docstring.value)

    def on_class(self, *, cls: Class, **_: Any) -> None:
        """List the settings that a dataclass declares beside their types."""
        declared = {name: member for name, member in cls.members.items() if isinstance(member, Attribute)}
        if not any("Annotated" in str(attribute.annotation) for attribute in declared.values()):
            return
        settings = settings_of(getattr(import_module(cls.module.path), cls.name))
        if cls.docstring is not None:
            rows = [
                f"    {name}: {_meaning(setting)}" for name, setting in settings.items() if setting.meaning
            ]
            cls.docstring.value += "\n\nAttributes:\n" + "\n".join(rows)
        for name in declared.keys() & settings.keys():
            hint = settings[name].hint
            declared[name].annotation = hint.__name__ if isinstance(hint, type) else str(hint)


def _meaning(setting: Setting) -> str:
    if setting.allowed == ANY_NUMBER:
        return setting.meaning
    return f"{setting.meaning.rstrip('.')}; {setting.allowed}."

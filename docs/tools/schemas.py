"""Write ``conf/schema/``, with which editors complete ``drive.yaml`` and run files.

Both follow from the declarations in the library, the dataclasses that its readers check such files by.
"""

from __future__ import annotations

import json
import types
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any, Union, get_args, get_origin

from v2hdm.io.description import DriveDescription
from v2hdm.pipeline.config import RunConfig
from v2hdm.settings import NO_KEY, Within, settings_of

FOLDER = Path(__file__).parents[2] / "conf" / "schema"
_PLAIN = {str: "string", int: "integer", float: "number", bool: "boolean", type(None): "null"}
_REFERENCE = r"^(\$\{.+\}|\?\?\?)$"  # of OmegaConf, in place of a number or a boolean

Schema = dict[str, Any]


def drive_schema() -> Schema:
    """The schema of ``drive.yaml``."""
    return _document("A drive of V2HDM: drive.yaml", DriveDescription, is_run=False)


def run_schema() -> Schema:
    """The schema of run files, which set some of the keys of a run."""
    schema = _document("A run of V2HDM: a run file", RunConfig, is_run=True)
    schema["properties"]["defaults"] = {"type": "array", "description": "other run files to begin with."}
    return schema


def _document(title: str, declared: type[Any], is_run: bool) -> Schema:
    head = {"$schema": "http://json-schema.org/draft-07/schema#", "title": title}
    return {**head, **_object(declared, is_run)}


def _object(declared: type[Any], is_run: bool) -> Schema:
    """The schema of a mapping; run files may leave out whatever they do not change."""
    settings = settings_of(declared)
    properties = {}
    required = []
    for key in fields(declared):
        if key.metadata == NO_KEY:
            continue
        setting = settings[key.name]
        properties[key.name] = {
            **_value(setting.hint, setting.allowed, is_run),
            **({"description": setting.meaning} if setting.meaning else {}),
            **_default(key),
        }
        if key.default is MISSING and key.default_factory is MISSING:
            required.append(key.name)
    schema: Schema = {"type": "object", "properties": properties, "additionalProperties": False}
    return schema if is_run or not required else {**schema, "required": required}


def _value(hint: Any, allowed: Within, is_run: bool) -> Schema:
    """The schema of a value of some type."""
    if hint is Any:
        return {}
    if is_dataclass(hint):
        assert isinstance(hint, type)
        return _object(hint, is_run)
    if get_origin(hint) in (Union, types.UnionType):
        choices = [_value(choice, allowed, is_run) for choice in get_args(hint)]
        return {"anyOf": choices}
    if get_origin(hint) is list:
        return {"type": "array", "items": _value(get_args(hint)[0], allowed, is_run)}
    if get_origin(hint) is dict:
        return {"type": "object", "additionalProperties": _value(get_args(hint)[1], allowed, is_run)}
    if isinstance(hint, type) and issubclass(hint, Enum):
        return {"enum": [choice.value for choice in hint]}
    plain: Schema = {"type": _PLAIN[hint]}
    if hint in (int, float):
        plain |= _range(allowed)
    if is_run and hint in (int, float, bool):
        plain |= {"type": [_PLAIN[hint], "string"], "pattern": _REFERENCE}
    return plain


def _range(allowed: Within) -> Schema:
    schema: Schema = {}
    if abs(allowed.least) != float("inf"):
        schema["exclusiveMinimum" if allowed.open else "minimum"] = allowed.least
    if allowed.most != float("inf"):
        schema["maximum"] = allowed.most
    if allowed.step is not None:
        schema["multipleOf"] = allowed.step
    return schema


def _default(key: Field[Any]) -> Schema:
    """The default of a key, where it is plain."""
    value = key.default if key.default_factory is MISSING else key.default_factory()
    if value is MISSING or is_dataclass(value) or isinstance(value, dict):
        return {}
    return {"default": value.value if isinstance(value, Enum) else value}


def files() -> dict[Path, str]:
    """The content of every file of the folder."""
    schemas = {"drive.json": drive_schema(), "run.json": run_schema()}
    return {FOLDER / name: json.dumps(schema, indent=1) + "\n" for name, schema in schemas.items()}


if __name__ == "__main__":
    for path, text in files().items():
        path.write_text(text, encoding="utf-8")

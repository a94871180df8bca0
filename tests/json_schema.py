"""As much of JSON Schema (2020-12) as docs/schemas/ uses; an unknown keyword is an error."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

SCHEMAS: Final = Path(__file__).parent.parent / "docs" / "schemas"
_TYPES: Final[dict[str, tuple[type, ...]]] = {
    "object": (dict,), "array": (list, tuple), "string": (str,), "boolean": (bool,), "null": (type(None),),
    "integer": (int,), "number": (int, float),
}  # fmt: skip
_KEYWORDS: Final = {
    "$schema", "$defs", "$ref", "title", "description", "type", "enum", "properties", "required", "items",
    "additionalProperties", "anyOf",
}  # fmt: skip


def problems(name: str, value: object, part: str | None = None) -> list[str]:
    """What is wrong about `value` by the schema docs/schemas/NAME.json, or a part of it."""
    schema = json.loads((SCHEMAS / f"{name}.json").read_text())
    names = schema.get("$defs", {})
    return list(_check(value, names[part] if part else schema, names, "$"))


def _check(value: Any, schema: Mapping[str, Any], names: Mapping[str, Any], where: str) -> Iterator[str]:
    assert schema.keys() <= _KEYWORDS, f"{where}: {schema.keys() - _KEYWORDS} is not implemented"
    if "$ref" in schema:
        yield from _check(value, names[schema["$ref"].removeprefix("#/$defs/")], names, where)
    if "anyOf" in schema:
        found = [list(_check(value, each, names, where)) for each in schema["anyOf"]]
        if all(found):
            yield from min(found, key=len)
    wanted = schema.get("type", [])
    wanted = [wanted] if isinstance(wanted, str) else wanted
    if wanted and not any(_is(value, kind) for kind in wanted):
        yield f"{where} is {value!r}, not {' or '.join(wanted)}"
    if "enum" in schema and value not in schema["enum"]:
        yield f"{where} is {value!r}, none of {schema['enum']}"
    if isinstance(value, dict):
        known = schema.get("properties", {})
        yield from (f"{where}.{key} is missing" for key in schema.get("required", ()) if key not in value)
        for key, each in value.items():
            if key in known:
                yield from _check(each, known[key], names, f"{where}.{key}")
            elif schema.get("additionalProperties") is False:
                yield f"{where}.{key} is not in the schema"
    if isinstance(value, list | tuple) and "items" in schema:
        for number, each in enumerate(value):
            yield from _check(each, schema["items"], names, f"{where}[{number}]")


def _is(value: object, kind: str) -> bool:
    return isinstance(value, _TYPES[kind]) and (kind == "boolean" or not isinstance(value, bool))

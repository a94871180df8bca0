"""Values against the JSON Schemas in docs/schemas."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final

import jsonschema

SCHEMAS: Final = Path(__file__).parent.parent / "docs" / "schemas"


def problems(name: str, value: object, part: str | None = None) -> list[str]:
    """What is wrong about `value` by the schema docs/schemas/NAME.json, or a part of it."""
    schema = json.loads((SCHEMAS / f"{name}.json").read_text())
    if part is not None:
        schema = {**schema["$defs"][part], "$defs": schema["$defs"]}
    jsonschema.Draft202012Validator.check_schema(schema)
    errors = jsonschema.Draft202012Validator(schema).iter_errors(json.loads(json.dumps(value)))
    return [f"{error.json_path}: {error.message}" for error in errors]

# SPDX-License-Identifier: Apache-2.0
"""JSON texts as both kinds of connection carry them: one object, bounded, strict JSON without NaN."""

from __future__ import annotations

import json
import math
from typing import Any, Final, NoReturn

from bota_ethercat.errors import BadMessageError

JsonObject = dict[str, Any]

MAX_JSON_DEPTH: Final = 32  # maximum nesting of objects and arrays


def encode_json_text(message: JsonObject) -> bytes:
    """Compact JSON text. ValueError for NaN and infinities, which JSON lacks."""
    return json.dumps(message, separators=(",", ":"), allow_nan=False).encode("ascii")


def finite(value: Any) -> Any:
    """`value` with null in place of NaN and infinities, at any depth."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def parse_json_object(text: bytes) -> JsonObject:
    """The JSON object in `text`; BadMessageError if it is anything else."""
    try:
        decoded = text.decode("utf-8")
    except UnicodeDecodeError as error:
        raise BadMessageError(f"the message is not UTF-8: {error.reason} at byte {error.start}") from None
    try:
        value = json.loads(decoded, parse_constant=_no_constant, parse_float=_finite_float)
    except RecursionError:
        raise BadMessageError("the message is nested too deeply") from None
    except json.JSONDecodeError as error:
        raise BadMessageError(f"the message is not valid JSON: {error}") from None
    except ValueError as error:
        raise BadMessageError(f"the message has a number that cannot be used: {error}") from None
    if not isinstance(value, dict):
        raise BadMessageError("the message must be an object, not another JSON value")
    if decoded.count("[") + decoded.count("{") > MAX_JSON_DEPTH and _depth(value) > MAX_JSON_DEPTH:
        raise BadMessageError(f"the message is nested more than {MAX_JSON_DEPTH} deep")
    return value


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no JSON number")


def _finite_float(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:20]} is too large")
    return value


def _depth(value: object) -> int:
    """How many containers are in each other."""
    level, depth = [value], 0
    while level := [item for item in level if isinstance(item, dict | list)]:
        depth += 1
        level = [inner for item in level for inner in (item.values() if isinstance(item, dict) else item)]
    return depth

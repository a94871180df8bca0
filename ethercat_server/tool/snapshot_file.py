"""The snapshot file: all readable objects of one sensor as JSON, with its identity."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

from ethercat_server.errors import UsageError
from ethercat_server.sensor.objects.dictionary import OBJECTS, Access, ObjectEntry
from ethercat_server.sensor.objects.search import BY_ADDRESS
from ethercat_server.sensor.sensor import Identity
from protocol.errors import SettingError
from protocol.settings import SettingValue, check_settings
from protocol.text.json_text import finite

_FORMAT: Final = "ethercat-sensor snapshot"
_VERSION: Final = 1
_CONFIGURATION: Final = range(0x8000, 0x8011)
"""Objects of the configuration: not the factory calibration, outputs or commands."""

RESTORABLE: Final[tuple[ObjectEntry, ...]] = tuple(
    row for row in OBJECTS if row.access is not Access.RO and row.index in _CONFIGURATION and not row.setting
)
"""Objects that are restored as they are; settings are restored as settings."""


class Snapshot(NamedTuple):
    """The content of a file, validated."""

    identity: Identity
    settings: dict[str, SettingValue]
    objects: dict[tuple[int, int], bytes]
    """Only those that can be restored."""


def text_of(content: Mapping[str, Any]) -> str:
    """The text of a file."""
    whole = finite({"format": _FORMAT, "version": _VERSION, **content})
    return json.dumps(whole, indent=1, allow_nan=False) + "\n"


def read_snapshot(path: Path) -> Snapshot:
    """Read and validate a file; UsageError if it is no snapshot."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror}") from None
    except (ValueError, RecursionError):
        raise UsageError(f"{path} is not a snapshot: it is not valid JSON") from None
    if not isinstance(content, dict) or (content.get("format"), content.get("version")) != (
        _FORMAT,
        _VERSION,
    ):
        raise UsageError(
            f"{path} is not a snapshot of version {_VERSION}: make one with ethercat-sensor snapshot"
        )
    try:
        identity = Identity(
            str(content["model"]), int(content["serial"]), str(content["hardware"]), str(content["firmware"])
        )
        settings = check_settings(dict(content["settings"]))
        rows = [(int(row["index"], 16), row["subindex"], row.get("hex")) for row in content["objects"]]
        held = {(index, sub): bytes.fromhex(text) for index, sub, text in rows if text is not None}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise UsageError(f"the snapshot {path} is damaged ({error!r}): make a new one") from None
    except SettingError as error:
        raise UsageError(f"the snapshot {path}: {error}") from None
    wanted = {row.address: held[row.address] for row in RESTORABLE if row.address in held}
    for address, data in wanted.items():
        if len(data) != BY_ADDRESS[address].type.size:
            raise UsageError(
                f"the snapshot {path} is damaged: object 0x{address[0]:04X}:{address[1]} has the wrong size"
            )
    return Snapshot(identity, settings, wanted)

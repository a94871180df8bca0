# SPDX-License-Identifier: Apache-2.0
"""The wire protocol between server and clients, sans-IO: standard library only, no sockets, no threads.

`framing` bytes to messages and back, `control` requests and replies, `accounting` what frames are and what is
missing, `pdo` the process data, `settings` the sensor's settings, `sensor_choice` how a sensor is named,
`address` HOST:PORT, `errors` every exception. `text` has JSON and untrusted text, `sensor` what the sensor's
values mean, `program` what programs do alike. Only `client`, which nothing else here loads, opens sockets.
"""

from __future__ import annotations

TYPE_CHECKING = False  # without `typing`: until `program.start` is loaded, Ctrl-C is a traceback
if TYPE_CHECKING:
    from typing import Any

    from bota_ethercat.client import Client, Condition, NoSampleError, Reading, connect

__all__ = ["Client", "Condition", "NoSampleError", "Reading", "connect"]


def __getattr__(name: str) -> Any:
    """What `client` has, loaded when it is asked for: the server needs none of it."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib  # noqa: PLC0415 - the server needs none of it

    return getattr(importlib.import_module("bota_ethercat.client"), name)

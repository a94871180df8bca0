"""A scripted server that streams and answers `status`, and what the node's /diagnostics say."""

from __future__ import annotations

import queue
import time
from typing import Any

from bota_ethercat.text.json_text import JsonObject
from tests.bridge.conftest import PATIENCE_S, Listener
from tests.bridge.scripted_server import description

RATE_HZ = 100
SETTINGS: JsonObject = {"sinc_length": 512, "fir": False, "acceleration_range_g": 2}


def streaming_description() -> JsonObject:
    """What a server says whose sensor gives RATE_HZ samples a second."""
    content = description()
    content["sensors"][0].update(rate_hz=RATE_HZ, settings=dict(SETTINGS))
    return content


def status(lost_samples: int = 0, mode: str = "locked") -> JsonObject:
    """A `status` reply's content."""
    spread = {"p50": 10.0, "p99": 20.0, "p999": 30.0, "max": 40.0}
    clock = {"mode": mode, "period_us": 10000.0, "offset_ppm": 1.0, "uncertainty_us": 5.0}
    return {
        "ok": True, "cycles": 1, "missed_deadlines": 2, "lost_frames": 3, "wake_us": spread,
        "exchange_us": spread, "uptime_s": 4.0, "clients": [],
        "last_10s": {"wake_us": spread, "exchange_us": spread, "age_us": [spread]},
        "sensors": [{"sensor": 0, "lost_samples": lost_samples, "recoveries": 1, "clock": clock}],
    }  # fmt: skip


class Diagnostics:
    """The node's /diagnostics: each array as {short name: status}."""

    def __init__(self, listener: Listener) -> None:
        from diagnostic_msgs.msg import DiagnosticArray

        self._prefix = f"{listener.tag}/bridge: "
        self._arrays: queue.Queue[Any] = listener.subscribe(DiagnosticArray, "diagnostics")

    def next(self) -> dict[str, Any]:
        """The next array."""
        array = self._arrays.get(timeout=PATIENCE_S)
        assert all(status.name.startswith(self._prefix) for status in array.status)
        return {status.name.removeprefix(self._prefix): status for status in array.status}

    def forget(self) -> None:
        """Forget what has come."""
        while not self._arrays.empty():
            self._arrays.get()

    def until(self, *words: str, **levels: int) -> dict[str, Any]:
        """The first array in which these statuses have these levels and their messages hold these words.

        A busy machine loses samples of its own accord: the same levels can have another cause.
        """
        deadline = time.monotonic() + PATIENCE_S
        while True:
            array = self.next()
            found = {name: array[name].level[0] for name in levels}
            said = " ".join(array[name].message for name in levels)
            if found == levels and all(word in said for word in words):
                return array
            texts = {name: status.message for name, status in array.items()}
            assert time.monotonic() < deadline, f"waited in vain for {levels} {words}; last: {texts}"


def values(status: Any) -> dict[str, str]:
    """A status's values."""
    return {value.key: value.value for value in status.values}

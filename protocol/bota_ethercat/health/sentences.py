# SPDX-License-Identifier: Apache-2.0
"""What every program says of a condition, in the same words: no server, a sensor that is lost, and so on.

What is wrong with a stream is in `judge`; why a request is denied is said by the server.
"""

from __future__ import annotations

import time
from typing import Final

from bota_ethercat.health.limits import LIMITS, StreamLimits
from bota_ethercat.pdo import AXES
from bota_ethercat.replies import SensorStatus

_UNITS: Final = ("N", "N", "N", "Nm", "Nm", "Nm")
_SINCE: Final = {"tare": "the tare", "change": "its settings changed", "return": "it came back"}
_LAST_DAY: Final = 4e9  # s of the Unix epoch


def no_server(address: object, why: object) -> str:
    """Nothing answers at that address."""
    return f"no server at {address} ({why}): start ethercat-server, or give its address"


def did_not_read(seconds: float, *, busy: bool | None = None) -> tuple[str, str]:
    """That this program itself was late, and what to do; `busy`: whether it used the CPU, None if unknown."""
    lasted = f"for {seconds:.1f} s" if seconds >= 1 else f"for {seconds * 1e3:.0f} ms"
    if busy is None:
        return f"this program did not read {lasted}", "It, or this computer, is too busy"
    if busy:
        return f"this program did other things {lasted}", "Have it read more often"
    return (
        f"this computer did not run this program {lasted}",
        "Give it a priority, or the computer less to do",
    )


def drift(row: SensorStatus, limits: StreamLimits | None = None) -> str:
    """How far the zero has drifted; with `limits`, empty unless that is worth a look."""
    cause, ago_s, kelvin, wrench = row.drift
    least = limits or LIMITS
    if wrench is None or ago_s is None or kelvin is None:
        return ""
    share = [abs(v) / (least.drift_force if n < 3 else least.drift_torque) for n, v in enumerate(wrench)]
    if limits is not None and max(share) < 1:
        return ""
    axis = share.index(max(share))
    since = _SINCE.get(cause, "the start")
    ago = f"{ago_s / 60:.0f} min" if ago_s < 7200 else f"{ago_s / 3600:.0f} h"
    warmer = f", {abs(kelvin):.0f} K {'warmer' if kelvin > 0 else 'colder'}" if abs(kelvin) >= 0.5 else ""
    digits, unit = (1, "N") if axis < 3 else (3, "Nm")
    size = f"{round(wrench[axis], digits) + 0.0:.{digits}f} {unit}"  # never -0.0
    return f"{AXES[axis]} has drifted {size} since {since} {ago} ago{warmer}"


def overload(row: SensorStatus) -> tuple[str, bool]:
    """The largest wrench, and whether the sensor was ever overloaded; empty if that is not known."""
    begun, peak, saturations, saturated_at = row.history
    since, last = _day(begun), _day(saturated_at)
    if peak is None or not since:
        return "", False
    largest = ", ".join(f"{a} {value:.3g} {u}" for a, value, u in zip(AXES, peak, _UNITS, strict=True))
    text = f"largest wrench since {since}: {largest}"
    if not last:
        return text, False
    return f"was overloaded on {last} ({saturations} times in all); {text}", True


def _day(at: float | None) -> str:
    return time.strftime("%Y-%m-%d", time.localtime(at)) if at is not None and 0 < at < _LAST_DAY else ""

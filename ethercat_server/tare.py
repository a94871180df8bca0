"""Tare: sets the sensor's own force/torque offset so that the mean reading becomes a given wrench.

The sensor adds its offset to what it measures, so new = target - mean + current.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any, Final

from ethercat_server.errors import BusError, CutOffError, extended
from ethercat_server.sdo import Sdo, Steps
from ethercat_server.sensor import Sensor, pack_offset, read_offset, write_offset
from ethercat_server.stream import SensorStream
from protocol.control import ErrorCode
from protocol.errors import RequestError
from protocol.pdo import layout_for

LATER: Final = "; it gets its old offset when it is back"
_AXES: Final = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
_LOAD: Final = slice(2, 8)
_RATE: Final = slice(13, 16)
"""Where force and torque, and the angular rate, are among the process data's fields."""
_REST_FORCE_N: Final = 1.0
_REST_TORQUE_NM: Final = 0.05
_REST_RATE_DPS: Final = 3.0
"""Standard deviations that a sensor at rest stays below: more than Bota's own limits for a healthy one."""
_SETTLING: Final = 8
"""Samples after which a new offset is surely in what the sensor gives."""
_PATIENCE: Final = 4.0
"""Samples may take this many times as long as they should."""


def tare(
    sdo: Sdo, sensor: Sensor, stream: SensorStream, samples: int, target: Sequence[float]
) -> Steps[dict[str, Any]]:
    """Steps of the action `tare`; returns what its reply carries. RequestError if the sensor is not at rest,
    or cannot hold the offset.

    If it fails half-way the old offset is put back.
    """
    _check_fits(target, "the key 'target'")
    mean, deviation = yield from _average(sensor, stream, samples)
    _check_rest(sensor, deviation)
    old = yield from read_offset(sdo)
    new = tuple(t - m + o for t, m, o in zip(target, mean, old, strict=True))
    _check_fits(new, "the offset that the key 'target' asks for")
    try:
        yield from write_offset(sdo, new)
        yield from _wait(sensor, stream, _SETTLING)
        mean, _ = yield from _average(sensor, stream, samples)
    except (BusError, RequestError) as error:
        raise (yield from _take_back(sdo, sensor, old, error)) from None
    sensor.offset = new
    return {
        "old_offset": list(old),
        "new_offset": list(new),
        "residual": [m - t for m, t in zip(mean, target, strict=True)],
        "deviation": deviation[:6],
    }


def _check_fits(offset: Sequence[float], what: str) -> None:
    try:
        pack_offset(offset)
    except ValueError as error:
        raise RequestError(ErrorCode.BAD_REQUEST, f"{what} cannot be: {error}") from None


def _take_back(
    sdo: Sdo, sensor: Sensor, old: tuple[float, ...], error: BusError | RequestError
) -> Steps[BusError | RequestError]:
    """Write the old offset again; returns `error` with what came of that."""
    addition = "; the old offset is in force"
    if isinstance(error, CutOffError):
        sensor.offset, sensor.unsettled = old, True
        addition = LATER
    else:
        try:
            yield from write_offset(sdo, old)
        except BusError as worse:
            sensor.offset, sensor.unsettled = old, True
            addition = f"; putting back the old offset failed too: {worse}; tare it again"
    if isinstance(error, RequestError):
        return RequestError(error.code, f"{error}{addition}", **error.extra)
    return extended(error, addition)


def _average(sensor: Sensor, stream: SensorStream, samples: int) -> Steps[tuple[list[float], list[float]]]:
    """Mean of force and torque; deviation of these and the angular rate (deg/s): over the next samples."""
    unpack = layout_for(sensor.pdo_size).struct.unpack
    deadline = time.monotonic() + 1.0 + _PATIENCE * samples * sensor.period_ns * 1e-9
    taken, seen = 0, stream.fresh
    sums, squares = [0.0] * 9, [0.0] * 9
    first: list[float] = []
    while taken < samples:
        yield
        if time.monotonic() > deadline:
            raise RequestError(ErrorCode.NOT_READY, f"sensor {sensor.place} gives too few samples to tare it")
        if stream.fresh == seen:
            continue
        seen = stream.fresh
        values = unpack(stream.process_data)
        row = [*values[_LOAD], *values[_RATE]]
        if not all(map(math.isfinite, row)):
            raise RequestError(
                ErrorCode.NOT_READY, f"sensor {sensor.place} is overloaded: it gives no finite numbers"
            )
        first = first or row
        for place, (value, start) in enumerate(zip(row, first, strict=True)):
            # From the first on, so that a large load does not drown its small changes.
            sums[place] += value - start
            squares[place] += (value - start) ** 2
        taken += 1
    mean = [s / taken for s in sums]
    deviation = [math.sqrt(max(0.0, q / taken - m * m)) for q, m in zip(squares, mean, strict=True)]
    return [m + f for m, f in zip(mean, first, strict=True)][:6], deviation


def _wait(sensor: Sensor, stream: SensorStream, samples: int) -> Steps[None]:
    """Until so many samples have come."""
    target = stream.fresh + samples
    deadline = time.monotonic() + 1.0 + _PATIENCE * samples * sensor.period_ns * 1e-9
    while stream.fresh < target and time.monotonic() < deadline:
        yield


def _check_rest(sensor: Sensor, deviation: Sequence[float]) -> None:
    names = (*_AXES, "Rx", "Ry", "Rz")
    limits = (_REST_FORCE_N,) * 3 + (_REST_TORQUE_NM,) * 3 + (_REST_RATE_DPS,) * 3
    units = ("N",) * 3 + ("Nm",) * 3 + ("deg/s",) * 3
    for name, found, limit, unit in zip(names, deviation, limits, units, strict=True):
        if found > limit:
            raise RequestError(
                ErrorCode.NOT_READY,
                f"sensor {sensor.place} is not at rest: {name} varies by {found:.3g} {unit} "
                f"(standard deviation; at most {limit:g}): hold it still and tare again",
            )

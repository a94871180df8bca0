"""A verified change of a sensor, undone if it fails: of settings, offsets and single objects alike."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from bota_ethercat.errors import RequestError
from ethercat_server.errors import BusError, CutOffError, extended
from ethercat_server.ethercat.datagrams import Steps, T
from ethercat_server.sensor.sensor import Sensor


class Former(NamedTuple):
    """How the sentence of a change that failed goes on."""

    name: str  # of what is restored
    in_force: str  # if it was
    later: str  # if the sensor is lost
    again: str  # what to do if neither is in force for certain


def or_undone(
    change: Steps[T], undo: Callable[[], Steps[object]], former: Former, sensor: Sensor | None = None
) -> Steps[T]:
    """The result of `change`, which verifies what it writes; if it fails, `undo` is run, unless the sensor is
    lost.

    BusError or RequestError is the change's, and says what is in force. Where that is not certain
    `sensor.change_interrupted` is set.
    """
    try:
        return (yield from change)
    except (BusError, RequestError) as error:
        was_interrupted = sensor is not None and sensor.change_interrupted
        if sensor is not None:
            sensor.change_interrupted = True
        if isinstance(error, CutOffError):
            raise _extended(error, former.later) from None
        try:
            yield from undo()
        except BusError as worse:
            why = f"; restoring {former.name} failed too: {worse}; {former.again}"
            raise _extended(error, why) from None
        if sensor is not None:
            sensor.change_interrupted = was_interrupted
        raise _extended(error, former.in_force) from None


def _extended(error: BusError | RequestError, addition: str) -> BusError | RequestError:
    if isinstance(error, RequestError):
        return RequestError(error.code, f"{error}{addition}", **error.extra)
    return extended(error, addition)

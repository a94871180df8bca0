"""Samples of a recording as if the sensor's own offset had never been changed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bota_clients.numbers import count
from bota_clients.recording.columns import Columns
from bota_clients.recording.order import TimeAxis
from bota_clients.recording.reader import RecordedSensor, Recording
from bota_ethercat.pdo import ImuUnits
from bota_ethercat.stream.timeline import InForce


class AtLastOffset:
    """Batches of a sensor as if its last own offset had been in force all the time, on one axis of time.

    Without the samples in which a change was being written, or whose offset is not known where that of others
    is: a server reports a change once all six numbers are written, an older one not before.

    Attributes:
        offset: that offset; None: the recording does not say it.
        said: remarks, once all batches were read.
    """

    def __init__(self, recording: Recording, sensor: RecordedSensor, imu_units: ImuUnits) -> None:
        known = [row.info.offset for row in sensor.offsets if row.info.offset is not None]
        self.offset, self.said = known[-1] if known else None, list[str]()
        self._recording, self._sensor, self._units = recording, sensor, imu_units
        self._in_doubt = list[tuple[int, int]]()
        self._shifts = len(sensor.offsets) > 1
        before, is_announced = None, False
        for in_force, batch in self._batches() if self._shifts else ():
            offset = in_force.info.offset
            if None not in (before, offset) and offset != before:
                at_ns, doubt_ns = int(batch.monotonic_ns[0]), 0 if is_announced else in_force.doubt_ns
                self._in_doubt.append((at_ns - doubt_ns, at_ns + in_force.doubt_after_ns))
            before, is_announced = offset or before, offset is None

    def __iter__(self) -> Iterator[Columns]:
        left_out = 0
        for in_force, batch in self._batches():
            if self._shifts:
                if in_force.info.offset is None:
                    left_out += len(batch)
                    continue
                shift = np.subtract(self.offset or (), in_force.info.offset)
                batch.force[:] += shift[:3]
                batch.torque[:] += shift[3:]
            is_sure = np.ones(len(batch), bool)
            for begin_ns, end_ns in self._in_doubt:
                is_sure &= (batch.monotonic_ns < begin_ns) | (batch.monotonic_ns > end_ns)
            yield batch if is_sure.all() else batch.where(is_sure)
        if left_out:
            self.said.append(f"{count(left_out, 'frame')} left out: the sensor's own offset was not known")

    def _batches(self) -> Iterator[tuple[InForce, Columns]]:
        axis = TimeAxis()
        yield from axis.batches(self._recording.batches(self._sensor.sensor, self._units))
        self.said = axis.said

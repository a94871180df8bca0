"""Windows of the newest samples while they come, for a policy that was trained on those of a recording.

    with connect(12001) as client:
        windows = LiveWindows(client, 64, tool=Path("tool.yaml"))
        while True:
            seen = windows.at(image_stamp_ns)  # by CLOCK_REALTIME, like `ethercat-export run.mcap --at`
            act(policy(seen["force_torque_compensated"], seen["force_torque_compensated_valid"]))

The arrays are those of `ethercat-export --at`: the same slots, ages, validity, compensation. A sample is
there once it was measured and has passed the filters (docs/datasets.md: 2 to 30 ms); what another client does
to the sensor's own offset marks the same samples if the server says so beforehand, as this project's does.
"""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Final

import numpy as np

from bota_clients.export.windows import Arrays, Windows, interpolated, read_tool
from bota_clients.recording.columns import columns
from bota_clients.recording.order import TimeAxis
from bota_ethercat.client import Client
from bota_ethercat.client.session import Item
from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import ImuUnits
from bota_ethercat.stream.timeline import InForce

_KEEP_S: Final = 1.0


class LiveWindows:
    """Windows of one sensor's stream; memory and work do not grow with time.

    They go on after a loss of the connection, a restart of the server, and other settings: the slots of what
    was lost are empty.
    """

    def __init__(
        self,
        client: Client,
        length: int,
        *,
        sensor: int = 0,
        tool: Path | None = None,
        imu_units: ImuUnits = ImuUnits.G_DPS,
        keep_s: float = _KEEP_S,
    ) -> None:
        """Of `length` samples, with a compensated wrench if there is a `tool`, a file of `ethercat-identify`.

        Instants may be asked for until `keep_s` later. Nobody else takes from `client`. RecordingError if the
        tool's file is wrong.
        """
        self._client, self._sensor, self._units = client, sensor, imu_units
        self._windows = Windows(length, tool=read_tool(tool) if tool else None, imu_units=imu_units)
        self._axis, self._keep_ns, self._shift_ns = TimeAxis(), round(keep_s * 1e9), 0
        self._in_force: InForce | None = None
        self._never = threading.Event()
        self._clocks = np.zeros((2, 0), np.int64)  # of the samples that are kept: both stamps

    def at(
        self, stamp_ns: int | None = None, *, monotonic_ns: int | None = None, timeout_s: float = 0.05
    ) -> Arrays:
        """The window of an instant by the server's CLOCK_REALTIME or CLOCK_MONOTONIC; of neither: the newest.

        As `Windows.at`, without its first axis: `force_torque` (length, 6) N, Nm; `imu` (length, 6) m/s²,
        rad/s; `..._age`, `..._valid` (length,); with a tool `force_torque_compensated`. Waits at most
        `timeout_s` for samples on their way: what is then missing is an empty slot, and `is_complete` False.
        Call it at least every second, so that no samples pile up. RecordingError if the sampling rate is
        unknown.
        """
        channel, windows, items = self._client.channel, self._windows, list(self._client.poll_all(0.0))
        deadline_ns = channel.monotonic_ns() + round(timeout_s * 1e9)
        while True:
            left_ns = deadline_ns - channel.monotonic_ns()
            early_ns = min(max(self._early_ns(items, stamp_ns, monotonic_ns), 0), left_ns)
            if left_ns <= 0 or early_ns <= 0:
                self._take(items)
                instant, items = self._instant(stamp_ns, monotonic_ns), []
                if left_ns <= 0 or (self._clocks.size and instant <= windows.until_ns):
                    break
            else:
                channel.wait(self._never, early_ns * 1e-9)
            items += self._client.poll_all((left_ns - early_ns) * 1e-9)
        found = windows.at(np.array([instant]), is_partial=True)
        return {name: array[0] for name, array in found.items()} | {
            "monotonic_ns": np.array(instant - self._shift_ns),
            "is_complete": np.array(0 <= instant <= windows.until_ns),
        }

    def _early_ns(self, items: list[Item], stamp_ns: int | None, monotonic_ns: int | None) -> int:
        """How long before the instant the newest of these frames was measured; 0: it was not.

        Frames wait for each other, as many at once cost what one does.
        """
        frames = (each for each in reversed(items) if isinstance(each, DataMessage))
        newest = next((each for each in frames if each.sensor == self._sensor), None)
        if newest is None or not self._clocks.size:
            return 0
        delay_ns = int(self._clocks[1, -1]) - self._windows.until_ns
        if monotonic_ns is not None:
            return monotonic_ns + delay_ns - newest.monotonic_ns
        return 0 if stamp_ns is None else stamp_ns + delay_ns - newest.stamp_ns

    def _instant(self, stamp_ns: int | None, monotonic_ns: int | None) -> int:
        """On the axis of the windows; -1 if nothing is known."""
        if monotonic_ns is not None:
            return monotonic_ns + self._shift_ns
        if stamp_ns is None or not self._clocks.size:
            return self._windows.until_ns
        # Since the clock was set back last: what was before has the same times.
        back = np.flatnonzero(np.diff(self._clocks[0]) < 0)[-1:].max(initial=-1) + 1
        stamps, instants = self._clocks[:, back:]
        if stamps[0] <= stamp_ns <= stamps[-1]:
            return int(interpolated(np.array([stamp_ns]), stamps, instants)[0])
        nearest = 0 if stamp_ns < stamps[0] else -1
        return int(instants[nearest]) + stamp_ns - int(stamps[nearest])

    def _take(self, items: list[Item]) -> None:
        frames = list[DataMessage]()
        for item in [*items, None]:
            if isinstance(item, DataMessage):
                if item.sensor == self._sensor:
                    frames.append(item)
                continue
            if frames:
                self._add(frames)
                frames = []
            if isinstance(item, InForce) and item.sensor == self._sensor:
                self._in_force = item

    def _add(self, frames: list[DataMessage]) -> None:
        arrived = self._in_force or self._client.session.timeline[self._sensor], columns(frames, self._units)
        for in_force, batch in self._axis.batches([arrived]):
            self._windows.configure(in_force)
            new = self._windows.add(batch)
            self._clocks = np.hstack([self._clocks, (new.stamp_ns, new.monotonic_ns)])
        self._shift_ns = self._axis.shift_ns
        oldest_ns = self._windows.until_ns - self._keep_ns
        if not self._clocks.size or self._clocks[1, 0] > oldest_ns - self._keep_ns // 2:
            return  # now and then is enough
        self._windows.forget(oldest_ns)
        kept = max(int(np.searchsorted(self._clocks[1], oldest_ns)) - 1, 0)
        self._clocks = self._clocks[:, kept:].copy()

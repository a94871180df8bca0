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
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from bota_clients.export.windows import Arrays, Rows, Windows, read_tool
from bota_clients.recording.columns import Columns, columns
from bota_ethercat.client import Client
from bota_ethercat.client.session import Item
from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import ImuUnits
from bota_ethercat.stream.timeline import InForce

_KEEP_S: Final = 1.0
_STAMPS: Final = np.dtype([("stamp_ns", "i8"), ("monotonic_ns", "i8")])


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
        self._keep_ns, self._shift_ns = round(keep_s * 1e9), 0
        self._in_force: InForce | None = None
        self._never = threading.Event()
        self._clocks = Rows(_STAMPS)  # of the samples that are kept, since the clock was set back last
        # Of the newest sample: stamp, place, and by how much later it arrived, by this machine's clock.
        self._stamp_ns = self._newest_ns = self._behind_ns = 0

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
        channel, windows, items = self._client.channel, self._windows, list[Item]()
        deadline_ns = channel.monotonic_ns() + round(timeout_s * 1e9)
        while True:
            now_ns, instant = channel.monotonic_ns(), self._instant(stamp_ns, monotonic_ns)
            left_ns = 0 if 0 <= instant <= windows.until_ns else max(deadline_ns - now_ns, 0)
            if (early_ns := min(self._early_ns(instant, now_ns), left_ns)) > 0:
                channel.wait(self._never, early_ns * 1e-9)
            items += self._client.poll_all((left_ns - max(early_ns, 0)) * 1e-9)
            now_ns = channel.monotonic_ns()
            newest = next((each for each in reversed(items) if isinstance(each, DataMessage)), None)
            if newest is not None:
                self._behind_ns = now_ns - newest.monotonic_ns
            # Frames wait for each other, as many at once cost what one does.
            if now_ns >= deadline_ns or self._early_ns(instant, now_ns) <= 0:
                self._take(items)
                instant, items = self._instant(stamp_ns, monotonic_ns), []
                if now_ns >= deadline_ns or 0 <= instant <= windows.until_ns:
                    break
        found = windows.at(np.array([instant]), is_partial=True)
        return {name: array[0] for name, array in found.items()} | {
            "monotonic_ns": np.array(instant - self._shift_ns),
            "is_complete": np.array(0 <= instant <= windows.until_ns),
        }

    def _early_ns(self, instant: int, now_ns: int) -> int:
        """How long until the sample arrives that completes the window of an instant, by those before it."""
        newest_ns = now_ns - self._behind_ns + self._shift_ns
        return instant + self._newest_ns - self._windows.until_ns - newest_ns if self._newest_ns else 0

    def _instant(self, stamp_ns: int | None, monotonic_ns: int | None) -> int:
        """On the axis of the windows; -1 if nothing is known."""
        if monotonic_ns is not None:
            return monotonic_ns + self._shift_ns
        if stamp_ns is None or not self._newest_ns:
            return self._windows.until_ns
        if stamp_ns >= self._stamp_ns:
            return self._newest_ns + stamp_ns - self._stamp_ns
        clocks = self._clocks.array
        behind = int(np.searchsorted(clocks["stamp_ns"], stamp_ns))
        near: list[tuple[int, int]] = clocks[max(behind - 1, 0) : behind + 1].tolist()
        (stamp, instant), (later, then) = near[0], near[-1]
        return instant + round((stamp_ns - stamp) * ((then - instant) / (later - stamp) if behind else 1.0))

    def _arrived(self, items: list[Item]) -> Iterator[tuple[InForce, Columns]]:
        """The frames of the sensor, with what was in force."""
        frames = list[DataMessage]()
        for item in [*items, None]:
            if isinstance(item, DataMessage):
                if item.sensor == self._sensor:
                    frames.append(item)
                continue
            if frames:
                in_force = self._in_force or self._client.session.timeline[self._sensor]
                yield in_force, columns(frames, self._units)
                frames = []
            if isinstance(item, InForce) and item.sensor == self._sensor:
                self._in_force = item

    def _take(self, items: list[Item]) -> None:
        for new in self._windows.follow(self._arrived(items)):
            rows = np.empty(len(new), _STAMPS)
            rows["stamp_ns"], rows["monotonic_ns"] = new.stamp_ns, new.monotonic_ns
            self._clocks.add(rows)
            latest = self._clocks.array[-len(new) - 1 :]["stamp_ns"]
            if len(back := np.flatnonzero(latest[1:] < latest[:-1])):  # before, the same times were
                self._clocks.take(len(self._clocks) - len(latest) + int(back[-1]) + 1)
        self._shift_ns, clocks = self._windows.axis.shift_ns, self._clocks.array["monotonic_ns"]
        self._stamp_ns, self._newest_ns = self._clocks.array[-1].tolist() if len(clocks) else (0, 0)
        oldest_ns = self._windows.until_ns - self._keep_ns
        if len(clocks) and clocks[0] <= oldest_ns - self._keep_ns // 2:  # now and then is enough
            self._windows.forget(oldest_ns)
            self._clocks.take(max(int(np.searchsorted(clocks, oldest_ns)) - 1, 0))

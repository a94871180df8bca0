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

import itertools
import threading
from collections import deque
from pathlib import Path
from typing import Any, Final

import numpy as np

from bota_clients.export.windows import Arrays, Windows, read_tool
from bota_clients.recording.columns import columns
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
        self._axis, self._keep_ns = self._windows.axis, round(keep_s * 1e9)
        self._in_force: InForce | None = None
        self._never = threading.Event()
        self._clocks = deque[tuple[int, int]]()  # stamps and places of the samples that are kept
        self._behind_ns = 0  # by how much later the newest one arrived, by this machine's clock

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
            "monotonic_ns": np.array(instant - self._axis.shift_ns),
            "is_complete": np.array(0 <= instant <= windows.until_ns),
        }

    def _early_ns(self, instant: int, now_ns: int) -> int:
        """How long until the sample arrives that completes the window of an instant, by those before it."""
        if not self._clocks:
            return 0
        newest_ns = now_ns - self._behind_ns + self._axis.shift_ns
        return instant + self._clocks[-1][1] - self._windows.until_ns - newest_ns

    def _instant(self, stamp_ns: int | None, monotonic_ns: int | None) -> int:
        """On the axis of the windows; -1 if nothing is known."""
        if monotonic_ns is not None:
            return monotonic_ns + self._axis.shift_ns
        if stamp_ns is None or not self._clocks:
            return self._windows.until_ns
        later, then = self._clocks[-1]
        for stamp, instant in reversed(self._clocks):
            if later > stamp_ns >= stamp:
                return instant + round((stamp_ns - stamp) * ((then - instant) / (later - stamp)))
            if stamp_ns > stamp or stamp > later:  # it is newer, or before it the clock was set back
                break
            later, then = stamp, instant
        return then + stamp_ns - later

    def _take(self, items: list[Item]) -> None:
        for are_frames, some in itertools.groupby(items, lambda item: isinstance(item, DataMessage)):
            own: list[Any] = [each for each in some if getattr(each, "sensor", None) == self._sensor]
            if own and are_frames:
                self._add(own)
            elif own:
                self._in_force = own[-1]

    def _add(self, frames: list[DataMessage]) -> None:
        arrived = self._in_force or self._client.session.timeline[self._sensor], columns(frames, self._units)
        for new in self._windows.follow([arrived]):
            self._clocks.extend(zip(new.stamp_ns.tolist(), new.monotonic_ns.tolist(), strict=True))
        clocks, oldest_ns = self._clocks, self._windows.until_ns - self._keep_ns
        if clocks and clocks[0][1] <= oldest_ns - self._keep_ns // 2:  # now and then is enough
            self._windows.forget(oldest_ns)
            while len(clocks) > 1 and clocks[1][1] < oldest_ns:
                clocks.popleft()

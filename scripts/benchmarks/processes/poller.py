"""Reads the sensors with a library's own loop, once a sample period, and notes when each sample is there.

The loops are those of the libraries' examples, but for absolute deadlines where those sleep after the work.
kickcat is run by the Python of .venv-vendor.

Arguments: LIBRARY FILE WARM_UP_S SECONDS IFACE SINC RATE_HZ PRIORITY
"""

from __future__ import annotations

import contextlib
import gc
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from bota_ethercat.pdo import SampleDecoder
from bota_ethercat.program.real_time import make_real_time
from scripts.benchmarks.records import INPUT_BYTES, ArrivalRecorder, deadlines, decode_clock

Exchange = Callable[[], Sequence[bytes]]  # process data of each sensor; none if the answer was lost
_TIMEOUT_US: Final = 2000


def with_pysoem(ifname: str) -> Exchange:
    from scripts.benchmarks.processes.masters import operational_master  # noqa: PLC0415 - as kickcat

    master = operational_master(ifname)

    def exchange() -> Sequence[bytes]:
        master.send_processdata()
        complete = master.receive_processdata(_TIMEOUT_US) == master.expected_wkc
        return [slave.input for slave in master.slaves] if complete else []

    return exchange


def with_kickcat(ifname: str) -> Exchange:
    import kickcat  # type: ignore[import-not-found] # noqa: PLC0415 - one of the two is there

    bus = kickcat.Bus(kickcat.create_link(ifname, ""))
    bus.init(0.1)
    bus.create_mapping()
    sensors = bus.slaves()
    for state in (kickcat.State.SAFE_OP, kickcat.State.OPERATIONAL):
        bus.request_state(state)
        bus.wait_for_state(state, 1.0, bus.process_data_no_check)

    def exchange() -> Sequence[bytes]:
        with contextlib.suppress(RuntimeError):
            bus.process_data()
            return [sensor.input_data for sensor in sensors]
        return []

    return exchange


LIBRARIES: Final = {"pysoem": with_pysoem, "kickcat": with_kickcat}


def main() -> None:
    library, path, warm_up_s, seconds, ifname, _, rate_hz, priority = sys.argv[1:]
    recording = ArrivalRecorder(Path(path), float(warm_up_s), float(seconds))
    gc.disable()
    Path("/proc/self/timerslack_ns").write_text("1000", encoding="ascii")  # as the server's
    make_real_time(int(priority), max(os.sched_getaffinity(0)))
    record(LIBRARIES[library](ifname), recording, int(1e9 / float(rate_hz)))
    recording.write()


def record(exchange: Exchange, recording: ArrivalRecorder, period_ns: int) -> None:
    """Note everything that is read until the time is over; when, before anything is decoded."""
    decode = SampleDecoder(INPUT_BYTES).decode
    for _ in deadlines(period_ns):
        inputs, now = exchange(), time.monotonic_ns()
        for position, data in enumerate(inputs):
            if not recording.add(position, *decode_clock(decode(data).array), 0, now):
                return


if __name__ == "__main__":
    main()

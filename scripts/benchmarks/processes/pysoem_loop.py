"""Reads the sensors with pysoem alone, once a sample period, and notes when each sample is there.

The loop is that of pysoem's examples, but for absolute deadlines in place of sleep(): send, receive, read.

Arguments: FILE WARM_UP_S SECONDS IFACE RATE_HZ PRIORITY CPU
"""

from __future__ import annotations

import gc
import sys
import time
from pathlib import Path
from typing import Any, Final

from bota_ethercat.client import make_real_time
from bota_ethercat.pdo import SampleDecoder
from scripts.benchmarks.processes.masters import operational_master
from scripts.benchmarks.records import INPUT_BYTES, ArrivalRecorder, deadlines, decode_clock

_TIMEOUT_US: Final = 2000


def main(path: str, warm_up_s: str, seconds: str, ifname: str, rate_hz: str, priority: str, cpu: str) -> None:
    recording = ArrivalRecorder(Path(path), float(warm_up_s), float(seconds))
    gc.disable()
    Path("/proc/self/timerslack_ns").write_text("1000", encoding="ascii")  # as the server's
    make_real_time(int(priority), int(cpu))
    record(operational_master(ifname), recording, int(1e9 / float(rate_hz)))
    recording.write()


def record(master: Any, recording: ArrivalRecorder, period_ns: int) -> None:
    """Note everything that is read until the time is over; when, before anything is decoded."""
    decode = SampleDecoder(INPUT_BYTES).decode
    for _ in deadlines(period_ns):
        master.send_processdata()
        if master.receive_processdata(_TIMEOUT_US) != master.expected_wkc:
            continue
        inputs = [slave.input for slave in master.slaves]
        now = time.monotonic_ns()
        for position, data in enumerate(inputs):
            if not recording.add(position, *decode_clock(decode(data).array), 0, now):
                return


if __name__ == "__main__":
    main(*sys.argv[1:])

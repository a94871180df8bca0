"""Reads Bota's Python driver (package bota-driver) and notes when each sample is returned.

Run by the Python of .venv-vendor. Over EtherCAT to sensors of the first generation, `read_frame` returns the
sample that the driver's own thread fetched last and has that thread fetch the next one; it does not wait, and
`read_frame_blocking` is refused. So the loop here calls it at absolute deadlines, as Bota's example does.

Arguments: FILE WARM_UP_S SECONDS IFACE SINC CALLS_PER_S PRIORITY
"""

from __future__ import annotations

import contextlib
import gc
import os
import sys
import time
from pathlib import Path
from typing import Final

import bota_driver  # type: ignore[import-not-found]

from bota_ethercat.program.real_time import make_real_time
from scripts.benchmarks.records import ArrivalRecorder, deadlines, decode_clock

_ATTEMPTS: Final = 5


def main() -> None:
    path, warm_up_s, seconds, ifname, sinc, rate_hz, priority = sys.argv[1:]
    recording = ArrivalRecorder(Path(path), float(warm_up_s), float(seconds))
    gc.disable()
    Path("/proc/self/timerslack_ns").write_text("1000", encoding="ascii")  # as the server's
    make_real_time(int(priority))  # before the driver starts its threads, which inherit it
    driver = active_driver(configuration(ifname, int(sinc)))
    record(driver, recording, int(1e9 / float(rate_hz)))
    recording.write()
    # In version 1.1.16 deactivate(), and so the destructor, never returns: it joins a thread that waits for
    # the next read_frame().
    os._exit(0)


def active_driver(config: bota_driver.BotaDriverConfig) -> bota_driver.BotaDriver:
    """A driver that streams.

    Activating exchanges process data once and then waits for 0.5 s. On a busy machine it failed at times with
    the sensor in SAFEOP + ERROR (0x14): presumably that exchange came in OP and started the 100 ms watchdog.
    """
    for _ in range(_ATTEMPTS):
        with contextlib.suppress(RuntimeError):
            driver = bota_driver.BotaDriver(config)
            if driver.configure() and driver.activate():
                return driver
    raise SystemExit(f"the driver could not be activated in {_ATTEMPTS} attempts")


def configuration(ifname: str, sinc: int) -> bota_driver.BotaDriverConfig:
    """The driver's configuration, with nothing in it that changes the values: no offset, no tare."""
    interface = bota_driver.CoeCommunicationInterfaceConfig()
    interface.network_interface = ifname
    sensor = bota_driver.Gen0SensorOperationConfig()
    sensor.sinc_length = sinc
    operation = bota_driver.DriverOperationConfig()
    operation.runtime_verbosity = False
    config = bota_driver.BotaDriverConfig()
    config.product_name, config.serial_number = "BFT-SENS-ECAT-M8", "SN0001"
    config.communication_interface_name = "CANopen_over_EtherCAT_gen0"
    config.coe_communication_interface_params = interface
    config.gen0_sensor_operation_params = sensor
    config.driver_operation_params = operation
    return config


def record(driver: bota_driver.BotaDriver, recording: ArrivalRecorder, period_ns: int) -> None:
    """Note everything that is returned until the time is over; when, before anything is decoded."""
    for _ in deadlines(period_ns):
        frame = driver.read_frame()
        now = time.monotonic_ns()
        if not frame.status.invalid:
            clock = decode_clock((*frame.force, *frame.torque))
            if not recording.add(0, *clock, 0, now):
                return


if __name__ == "__main__":
    main()

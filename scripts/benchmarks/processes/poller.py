"""Reads the sensors with a library's own loop, once a sample period, and notes when each sample is there.

The loops are those of the libraries' examples, but for absolute deadlines where those sleep after the work.
kickcat and bota_driver are run by the Python of .venv-vendor.

Arguments: LIBRARY FILE WARM_UP_S SECONDS IFACE SINC RATE_HZ PRIORITY
"""

from __future__ import annotations

import contextlib
import gc
import os
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Final

from bota_ethercat.pdo import SampleDecoder
from bota_ethercat.program.real_time import make_real_time
from scripts.benchmarks.records import INPUT_BYTES, ArrivalRecorder, deadlines, decode_clock

# Force and torque of each sensor, to be decoded when they are asked for; none if the answer was lost.
Exchange = Callable[[], Iterable[Sequence[float]]]
_TIMEOUT_US: Final = 2000
_ATTEMPTS: Final = 5
_DECODE: Final = SampleDecoder(INPUT_BYTES).decode


def with_pysoem(ifname: str, _: int) -> Exchange:
    from scripts.benchmarks.processes.masters import operational_master  # noqa: PLC0415 - as kickcat

    master = operational_master(ifname)

    def exchange() -> Iterable[Sequence[float]]:
        master.send_processdata()
        complete = master.receive_processdata(_TIMEOUT_US) == master.expected_wkc
        return (_DECODE(slave.input).array for slave in master.slaves) if complete else ()

    return exchange


def with_kickcat(ifname: str, _: int) -> Exchange:
    import kickcat  # type: ignore[import-not-found] # noqa: PLC0415 - one of the three is there

    bus = kickcat.Bus(kickcat.create_link(ifname, ""))
    bus.init(0.1)
    bus.create_mapping()
    sensors = bus.slaves()
    for state in (kickcat.State.SAFE_OP, kickcat.State.OPERATIONAL):
        bus.request_state(state)
        bus.wait_for_state(state, 1.0, bus.process_data_no_check)

    def exchange() -> Iterable[Sequence[float]]:
        with contextlib.suppress(RuntimeError):
            bus.process_data()
            return (_DECODE(sensor.input_data).array for sensor in sensors)
        return ()

    return exchange


def with_bota_driver(ifname: str, sinc: int) -> Exchange:
    """Over EtherCAT to sensors of the first generation, `read_frame` returns the sample that the driver's
    own thread fetched last and has that thread fetch the next one; it does not wait, and
    `read_frame_blocking` is refused. So it is called at absolute deadlines, as Bota's example does.
    """
    import bota_driver  # type: ignore[import-not-found] # noqa: PLC0415 - as kickcat

    interface = bota_driver.CoeCommunicationInterfaceConfig()
    interface.network_interface = ifname
    sensor = bota_driver.Gen0SensorOperationConfig()
    sensor.sinc_length = sinc
    operation = bota_driver.DriverOperationConfig()
    operation.runtime_verbosity = False
    config = bota_driver.BotaDriverConfig()  # with nothing in it that changes the values: no offset, no tare
    config.product_name, config.serial_number = "BFT-SENS-ECAT-M8", "SN0001"
    config.communication_interface_name = "CANopen_over_EtherCAT_gen0"
    config.coe_communication_interface_params = interface
    config.gen0_sensor_operation_params = sensor
    config.driver_operation_params = operation

    def exchange() -> Iterable[Sequence[float]]:
        frame = driver.read_frame()
        return () if frame.status.invalid else [(*frame.force, *frame.torque)]

    # Activating exchanges process data once and then waits for 0.5 s. On a busy machine it failed at times
    # with the sensor in SAFEOP + ERROR (0x14): presumably that exchange came in OP and started the 100 ms
    # watchdog.
    for _ in range(_ATTEMPTS):
        with contextlib.suppress(RuntimeError):
            driver: Any = bota_driver.BotaDriver(config)
            if driver.configure() and driver.activate():
                return exchange
    raise SystemExit(f"the driver could not be activated in {_ATTEMPTS} attempts")


LIBRARIES: Final = {"pysoem": with_pysoem, "kickcat": with_kickcat, "bota_driver": with_bota_driver}


def main() -> None:
    library, path, warm_up_s, seconds, ifname, sinc, rate_hz, priority = sys.argv[1:]
    recording = ArrivalRecorder(Path(path), float(warm_up_s), float(seconds))
    gc.disable()
    Path("/proc/self/timerslack_ns").write_text("1000", encoding="ascii")  # as the server's
    # The driver starts threads, which inherit it: they are not to share one CPU.
    cpu = -1 if library == "bota_driver" else max(os.sched_getaffinity(0))
    make_real_time(int(priority), cpu)
    record(LIBRARIES[library](ifname, int(sinc)), recording, int(1e9 / float(rate_hz)))
    recording.write()
    # In version 1.1.16 deactivate(), and so the driver's destructor, never returns: it joins a thread that
    # waits for the next read_frame().
    os._exit(0)


def record(exchange: Exchange, recording: ArrivalRecorder, period_ns: int) -> None:
    """Note everything that is read until the time is over; when, before anything is decoded."""
    for _ in deadlines(period_ns):
        inputs, now = exchange(), time.monotonic_ns()
        for position, force_torque in enumerate(inputs):
            if not recording.add(position, *decode_clock(force_torque), 0, now):
                return


if __name__ == "__main__":
    main()

"""What `ethercat-identify delay` does: the lag of the force, beside what the filters imply."""

from __future__ import annotations

import argparse
import json
import sys

import numpy as np

from bota_clients.errors import RecordingError
from bota_clients.identify.last_offset import AtLastOffset
from bota_clients.identify.program import Motion, choose
from bota_clients.identify.stationary_periods import tables_of
from bota_clients.program import say
from bota_clients.recording.asked import Asked
from bota_clients.recording.reader import open_recording
from bota_ethercat.sensor.response import force_lag_s
from bota_ft_compensation.alignment import gyroscope_later_s
from bota_ft_compensation.identification.delay import check_held_out, find_lag
from bota_ft_compensation.quantities import CompensationError


def run(options: argparse.Namespace) -> int:
    with open_recording(options.path, Asked.of(options)) as recording:
        sensor = choose(recording, options.sensor)
        read, motion = AtLastOffset(recording, sensor, options.imu_units), Motion()
        for table in tables_of(read):
            motion.add(table)
    for remark in read.said:
        say("ethercat-identify", f"{options.path}: {remark}")
    settings = sensor.info.settings
    if any(row.info.settings != settings for row in sensor.history):
        raise RecordingError(f"{options.path}: settings were changed during it: record without that")
    times, rows = motion.rows()
    force, _, acceleration, rate = np.split(rows, 4, axis=1)
    try:
        found = find_lag(times, force, acceleration, rate, gyroscope_later_s(settings))
        left = check_held_out(times, np.hstack([force, acceleration, rate]), settings, found)
    except CompensationError as refusal:
        if options.json:
            sys.stdout.write(json.dumps({"ok": False, "error": str(refusal)}, indent=1) + "\n")
        say("ethercat-identify", f"{options.path}: {refusal}")
        return 1
    expected_s = force_lag_s(settings, sensor.info.rate_hz or None)
    expected_ms = None if expected_s is None else expected_s * 1e3
    if options.json:
        told = {
            "ok": True, "lag_ms": found.seconds * 1e3, "interval_ms": found.interval_s * 1e3,
            "expected_ms": expected_ms, "left_N": left[0], "left_unaligned_N": left[1],
            "explained": found.explained,
        }  # fmt: skip
        sys.stdout.write(json.dumps(told, indent=1) + "\n")
    else:
        implied = "unknown" if expected_ms is None else f"{expected_ms:.2f} ms"
        sys.stdout.write(
            f"force and torque come {found.seconds * 1e3:.2f} ms (± {found.interval_s * 1e3:.2f} ms, 95 %) "
            f"after the accelerometer; by the filters that were set: {implied}\n"
            f"in parts that did not choose it, {left[0]:.3g} N are left with it, {left[1]:.3g} N without\n"
        )
    return 0

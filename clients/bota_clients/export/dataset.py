"""What `ethercat-export --at` does: windows of samples for each frame, from a recording into a file.

with open_recording(Path("run.mcap")) as recording:
    for block in windows_of(recording, FrameTimes(fps=30.0), Windows(32)):
        print(block["force_torque"].shape)
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from functools import partial
from typing import Final

import numpy as np
from rich.console import Console
from rich.progress import Progress

from bota_clients.export.cli import PROGRAM, ExportOptions
from bota_clients.export.files import new_dataset
from bota_clients.export.frame_times import Clock, FrameTimes, read_stamps
from bota_clients.export.windows import Arrays, Tool, Windows
from bota_clients.identify.program import choose
from bota_clients.numbers import count
from bota_clients.program import interrupt_on_signals, say
from bota_clients.recording.reader import RecordedSensor, Recording, open_recording
from bota_ethercat.program.version import VERSION
from bota_ethercat.sensor.response import delays_ms
from bota_ethercat.settings import known_settings
from bota_ethercat.text.json_text import JsonObject

_UNITS: Final = {"force": "N", "torque": "Nm", "acceleration": "m/s^2", "angular_rate": "rad/s", "age": "s"}
_say = partial(say, PROGRAM)


def windows_of(
    recording: Recording,
    times: FrameTimes,
    windows: Windows,
    sensor: int = 0,
    advance: Callable[[int], object] = lambda _: None,
) -> Iterator[Arrays]:
    """Blocks of f frames: their `stamp_ns` as given, `monotonic_ns` of the server, and their `Windows.at`.

    `advance` is told how many DATA frames were read. RecordingError for the first frame without a window.
    """
    done = 0
    for settings, frames in recording.batches(sensor):
        windows.configure(settings.values, settings.rate_hz, settings.identity.name)
        table = windows.take(frames)
        times.follow(table.stamp_ns, table.monotonic_ns)
        instants = times.instants_ns[done:]
        if len(instants) and windows.begin_ns >= 0 and instants[0] < windows.begin_ns:
            raise times.refusal(done)
        ready = instants[: np.searchsorted(instants, windows.until_ns, "right")]
        if len(ready):
            stamps = times.stamps_ns[done : done + len(ready)]
            yield {"stamp_ns": stamps, "monotonic_ns": ready, **windows.at(ready)}
            done += len(ready)
        windows.forget(min([windows.until_ns, *instants[len(ready) : len(ready) + 1].tolist()]))
        advance(len(frames))
    if done < times.count or not done:
        raise times.refusal(done)


def attributes_of(recording: Recording, sensor: RecordedSensor, options: ExportOptions) -> JsonObject:
    """What a file says about its arrays."""
    tool = None if options.tool is None else Tool.read(options.tool)
    return {
        "recording": recording.path.name,
        "recorded": dict(recording.metadata),
        "exporter": f"{PROGRAM} {VERSION}",
        "sensor": sensor.history[0].identity._asdict() if sensor.history else None,
        # In force from `stamp_ns` on, with delays of the filters; null: unknown, and taken to be 0.
        "settings": [
            {
                "stamp_ns": row.stamp_ns, "rate_hz": row.rate_hz, **row.values,
                "delay_ms": delays_ms(known_settings(row.values), row.rate_hz or None),
            }
            for row in sensor.history
        ],
        "window": options.window,
        "hold": options.hold,
        "units": _UNITS,
        "frames": {"force_torque": "ft_sensor", "imu": "ft_sensor_imu"},
        "imu_raw_units": options.imu_units.value,
        "at": options.fps or str(options.at),
        "latency_s": options.latency,
        "clock": None if options.clock is None else Clock.read(options.clock)._asdict(),
        "tool": tool and {
            "mass_kg": tool.payload.mass, "center_of_gravity_m": tool.payload.center,
            "inertia_kg_m2": tool.payload.inertia, "bias": tool.bias.values,
            "accelerometer": tool.accelerometer._asdict(),
        },
    }  # fmt: skip


def run(options: ExportOptions) -> int:
    """Export; returns the exit code. Ctrl-C ends it at any time and leaves no file."""
    interrupt_on_signals()
    frames, console = 0, Console(stderr=True)
    try:
        source = str(options.at)
        stamps = None if options.at is None else read_stamps(options.at, options.column, options.topic)
        clock = None if options.clock is None else Clock.read(options.clock)
        times = FrameTimes(
            stamps, fps=options.fps or 0.0, latency_s=options.latency, clock=clock, source=source
        )
        tool = None if options.tool is None else Tool.read(options.tool)
        windows = Windows(options.window, hold=options.hold, tool=tool, imu_units=options.imu_units)
        with open_recording(options.recording) as recording, contextlib.ExitStack() as shown:
            sensor = choose(recording, options.sensor)
            if recording.cut_off is not None:
                _say(f"{options.recording} was cut off ({recording.cut_off}): the intact part is exported")
            progress = shown.enter_context(
                Progress(console=console, transient=True, disable=not console.is_terminal)
            )
            task = progress.add_task("", total=sensor.frames)
            blocks = windows_of(recording, times, windows, sensor.sensor, partial(progress.advance, task))
            with new_dataset(
                options.output, attributes_of(recording, sensor, options), force=options.force
            ) as write:
                for block in blocks:
                    write(block)
                    frames += len(block["stamp_ns"])
    except KeyboardInterrupt:
        _say("stopped: nothing was written")
        return 1
    _say(f"{options.output}: {count(frames, 'frame')} of {count(options.window, 'sample')} each")
    return 0

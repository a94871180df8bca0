"""The virtual sensor's own samples at simulated time, as they come off the bus."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator

from bota_ethercat.pdo import Sample, SampleDecoder
from ethercat_server.virtual_sensor import signals
from ethercat_server.virtual_sensor.dictionary import Flash
from ethercat_server.virtual_sensor.options import SensorOptions
from ethercat_server.virtual_sensor.sensor import Firmware
from ethercat_server.virtual_sensor.signals import MOVE_LENGTH, POSE_LENGTH, POSES
from ft_compensation.identification.poses import Pose, pose_of
from ft_compensation.stationary import StationaryMeans, StationaryWindow

Stream = Iterable[tuple[float, Sample]]  # samples with their times, s since the signal began

SINC = 512  # 100 Hz: quick to simulate
# What the sensor adds to its readings (object 0x8000): the bias that is to be found. N, Nm.
OFFSET = (3.0, -1.5, 7.25, 0.2, -0.05, 0.125)
CYCLE = POSE_LENGTH + MOVE_LENGTH
POSES_TAKE = len(POSES) * CYCLE
STILL = 0.4  # the part of a cycle that `windows_of_poses` looks at
_SETTLE = 0.3


def process_data(
    signal: str, seconds: float, seed: int = 0, sinc: int = SINC, part: float = 1.0
) -> Iterator[tuple[float, int, bytes]]:
    """Time since the signal began (s), number and process data of every sample.

    `part` of the samples of each pose and the move after it, the first ones.
    """
    options = SensorOptions(signal=signal, seed=seed)
    flash = Flash()
    flash.entries[0x8006, 1] = struct.pack("<H", sinc)
    now = 0
    firmware = Firmware(options, flash, lambda: now, lambda *_: None)
    for number, offset in enumerate(OFFSET, 1):
        firmware.write(0x8000, number, struct.pack("<f", offset))
    for number in range(int(seconds * 51200 / sinc)):
        now = firmware.sampler.clock.instant(number)
        if now * 1e-9 % CYCLE < part * CYCLE:
            yield now * 1e-9, number, firmware.inputs()


def samples(
    signal: str, seconds: float, seed: int = 0, sinc: int = SINC, part: float = 1.0
) -> Iterator[tuple[float, Sample]]:
    """The same, decoded."""
    decode = SampleDecoder(61).decode
    for time_s, _, data in process_data(signal, seconds, seed, sinc, part):
        yield time_s, decode(data)


def windows_of_poses(stream: Stream, seconds: float = 1.5) -> Iterator[StationaryMeans]:
    """What a user takes of the signal `poses`: a window in each pose, a moment after the move has ended."""
    window: StationaryWindow | None = None
    for time_s, sample in stream:
        within = time_s % CYCLE
        if within < _SETTLE:
            window = StationaryWindow(seconds)
        elif window is not None and window.add(sample, time_s):
            yield window.means()
            window = None


def take_poses(stream: Stream) -> list[Pose]:
    """Take every pose of the signal `poses`."""
    return [pose_of(means) for means in windows_of_poses(stream)]


def deviations(sinc: int = SINC) -> tuple[float, ...]:
    """The standard deviation of the virtual sensor's noise, force (N) and torque (Nm)."""
    signal = signals.Scene(0, noise=True)
    signal.set_sinc_length(sinc)
    return signal.deviations


def contact(time_s: float) -> tuple[float, ...]:
    """What the tool of `scene` is really touched with, force (N) and torque (Nm)."""
    force = signals.contact_force(time_s)
    return *force, *signals.cross(signals.CONTACT_POINT, force)

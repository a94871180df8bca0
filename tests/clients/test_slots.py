"""Windows and rows of samples against what they are by definition, slot by slot, of any stream."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from bota_clients.errors import RecordingError
from bota_clients.export.csv_table import AXES
from bota_clients.export.samples import samples_of
from bota_clients.export.windows import Windows
from bota_clients.recording.columns import columns
from bota_clients.recording.reader import open_recording
from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.pdo import ImuUnits, SampleDecoder
from bota_ethercat.replies import SensorInfo
from bota_ethercat.stream.timeline import InForce
from bota_ethercat.stream.usable import CHANNELS, Usability
from tests.clients.recordings import describe, frame, write
from tests.clients.test_export_windows import SETTINGS, joined

GAP, REPEATED, INVALID = int(DataFlag.GAP), int(DataFlag.REPEATED), int(DataFlag.INVALID)
NO_TOOL: dict[str, Any] = {"tool_mass": 0.0, "tool_center_of_gravity": [0.0, 0.0, 0.0]}
LENGTH, NOT_A_TIME = 24, -(2**63)
MEASURED = ("force_torque", "acceleration", "angular_rate")
NAMES = ("force_torque", "imu", *(f"{name}_{more}" for name in MEASURED for more in ("age", "valid")))
WRONG: tuple[dict[str, Any], ...] = (
    {"force_torque_saturated": 1}, {"acceleration_saturated": 2}, {"angular_rate_saturated": 4},
    {"torque.y": math.nan}, {"acceleration.z": math.inf}, {"warnings": 2}, {"status": 3},
)  # fmt: skip


class Part(NamedTuple):
    rate_hz: float
    imu: bool
    fir: bool
    epoch: int
    frames: list[DataMessage]

    @property
    def in_force(self) -> InForce:
        settings = SETTINGS | {"sinc_length": 64, "fir": self.fir, "imu_active": int(self.imu)}
        settings["acceleration_filter"] = 4 if self.fir else 1
        return InForce(SensorInfo(settings=settings, rate_hz=self.rate_hz), epoch=self.epoch)

    @property
    def delays_ns(self) -> list[int]:
        """Of force and torque 1.5 samples, with FIR 12, to 0.01 ms; and of the IMU's two filters."""
        of_force = {800.0: (1_880_000, 15_000_000), 400.0: (3_750_000, 30_000_000)}[self.rate_hz][self.fir]
        return [of_force, 11_800_000 if self.fir else 1_940_000, 2_900_000]


class Slot(NamedTuple):
    measured_ns: list[int]
    stamp_ns: int
    sequence: int
    of: int  # number of the sample in the stream; -1: lost
    part: int


EMPTY = Slot([], 0, -1, -1, 0)


def stream(seed: int, parts: int = 5, count: int = 100) -> list[Part]:
    """Samples that are lost on the bus (GAP) or not read in time (their numbers are missing), and others."""
    draw = random.Random(seed)
    found, at_ns, sequence, epoch = list[Part](), draw.randrange(10**9, 10**15), draw.randrange(10**6), 0
    for _ in range(parts):
        rate_hz, frames = draw.choice((800.0, 800.0, 400.0)), list[DataMessage]()
        epoch += draw.random() < 0.6
        for number in range(count if parts == 1 or draw.random() < 0.7 else 0):
            lost = draw.choice((0,) * 9 + (1, 2, 5, 40))
            jump = draw.choice((0, 0, lost, lost + 1))
            flags = GAP if draw.random() < (0.8 if lost else 0.1) else 0
            if not number:  # only what is in force tells of a gap
                lost, jump, flags = 2, 0, 0
            at_ns += round((1 + lost + draw.uniform(-0.3, 0.3)) * 1e9 / rate_hz)
            sequence += 1 + jump
            flags |= draw.choice((0,) * 12 + (REPEATED, INVALID, INVALID | REPEATED))
            wrong = draw.choice(({},) * 12 + WRONG)
            values: Any = {"acceleration.x": 0.5 + number % 7, "angular_rate.y": number, "torque.x": 0.25}
            made = frame(sequence, flags=flags, **{**values, **wrong})
            frames.append(made._replace(monotonic_ns=at_ns, stamp_ns=at_ns + 10**18))
        found.append(Part(rate_hz, draw.random() < 0.7, draw.random() < 0.5, epoch, frames))
    return found


def slots_of(parts: Sequence[Part]) -> tuple[list[Slot], list[DataMessage]]:
    """One for each sample, and for each that is missing before it, as far as a window goes."""
    slots, samples, epoch = list[Slot](), list[DataMessage](), 0
    for number, part in enumerate(parts):
        for each in part.frames:
            if each.flags & (REPEATED | INVALID):
                continue
            before = samples[-1] if samples else each
            begins, epoch = part.epoch != epoch, part.epoch
            more, passed = each.sequence - before.sequence, each.monotonic_ns - before.monotonic_ns
            lost = 0
            if samples and (begins or more != 1 or each.flags & GAP):
                lost = max(round(passed * (part.rate_hz * 1e-9)) - 1, 0)
            for place in range(1, min(lost, LENGTH) + 1):
                at_ns = before.monotonic_ns + round(passed * (place / (lost + 1)))
                known = before.sequence + place if more == lost + 1 else -1
                slots.append(Slot([at_ns - late for late in part.delays_ns], at_ns, known, -1, number))
            at_ns = each.monotonic_ns
            measured = [at_ns - late for late in part.delays_ns]
            slots.append(Slot(measured, at_ns, each.sequence, len(samples), number))
            samples.append(each)
    return slots, samples


def valid_of(sample: DataMessage, part: Part) -> tuple[list[bool], list[float]]:
    found = SampleDecoder(61).decode(sample.process_data)
    valid = [channel.judge(found) is Usability.USABLE for channel in CHANNELS[:3]]
    return [valid[0], valid[1] and part.imu, valid[2] and part.imu], [
        *found.force, *found.torque, *found.acceleration, *found.angular_rate
    ]  # fmt: skip


def reached(slots: Sequence[Slot], channel: int) -> list[int]:
    return [*itertools.accumulate((slot.measured_ns[channel] for slot in slots), max)]


@pytest.mark.parametrize("seed", range(10))
def test_a_window_has_the_slots_that_were_measured_before_its_instant(seed: int) -> None:
    parts, draw = stream(seed), random.Random(seed)
    slots, samples = slots_of(parts)
    made = Windows(LENGTH, tool=NO_TOOL if seed % 2 else None)
    assert (made.begin_ns, made.until_ns) == (-1, -1)
    with pytest.raises(
        RecordingError, match=r"^the sampling rate is not known, so lost samples have no place$"
    ):
        made.configure(InForce(SensorInfo(settings=SETTINGS)))
    made.configure(parts[0].in_force)
    for name, array in made.at(np.array([5]), is_partial=True).items():
        assert not array.any() if name.endswith("valid") else np.isnan(array).all(), name
    with pytest.raises(RecordingError, match="restarted meanwhile: record again"):
        made.add(columns([frame(n, flags=GAP)._replace(monotonic_ns=ns) for n, ns in enumerate((9, 8, 10))]))
    made = Windows(LENGTH, tool=NO_TOOL if seed % 2 else None)
    come = 0
    for number, part in enumerate(parts):
        made.configure(part.in_force)
        for size in iter(lambda part=part: draw.choice((1, 3, 50)), None):  # type: ignore[misc]
            if not (batch := part.frames[come : come + size]):
                come = 0
                break
            made.add(columns(batch))
            come += size
            newest = batch[-1].monotonic_ns
            here = [slot for slot in slots if slot.stamp_ns <= newest and slot.part <= number]
            if not here or here[-1].of < 0:
                continue
            until = min(max(slot.measured_ns[channel] for slot in here) for channel in range(3))
            assert (made.begin_ns, made.until_ns) == (samples[0].monotonic_ns, until)
            is_partial = draw.random() < 0.5
            at = until + (draw.randrange(10**8) if is_partial else -draw.randrange(3 * 10**7))
            with pytest.raises(ValueError, match=f"after {until} ns not all samples are here"):
                made.at(np.array([until, until + 1]))
            found = made.at(np.array([at]), is_partial=is_partial)
            assert {*found} == {
                *NAMES,
                *(f"{NAMES[0]}_compensated{more}" for more in ("", "_valid") if seed % 2),
            }
            imu = np.split(found["imu"][0], 2, axis=1)
            for channel, name in enumerate(MEASURED):
                end = sum(each <= at for each in reached(here, channel))
                if is_partial:
                    end += int(max(at - here[-1].measured_ns[channel], 0) * (part.rate_hz * 1e-9))
                values = (found["force_torque"][0], *imu)[channel]
                for row, index in enumerate(range(end - LENGTH, end)):
                    slot = here[index] if 0 <= index < len(here) else EMPTY
                    valid, numbers = [False] * 3, list[float]()
                    if slot.of >= 0:
                        valid, numbers = valid_of(samples[slot.of], parts[slot.part])
                    assert found[f"{name}_valid"][0, row] == valid[channel], (at, row)
                    if not valid[channel]:
                        assert np.isnan(values[row]).all()
                        assert np.isnan(found[f"{name}_age"][0, row])
                        continue
                    wanted = numbers[(0, 6, 9)[channel] : (6, 9, 12)[channel]]
                    assert values[row] == pytest.approx(wanted, rel=1e-6)
                    age_s = (at - slot.measured_ns[channel]) * 1e-9
                    assert found[f"{name}_age"][0, row] == pytest.approx(age_s, rel=1e-6, abs=1e-9)
            if seed % 2:
                assert found["force_torque_compensated"].tobytes() == found["force_torque"].tobytes()
                assert (found["force_torque_compensated_valid"] == found["force_torque_valid"]).all()
            if draw.random() < 0.3:
                made.forget(oldest := until - 3 * 10**7)
                ends = (sum(max_ns <= oldest for max_ns in reached(here, each)) for each in range(3))
                assert len(made._slots) == len(here) - max(min(ends) - LENGTH, 0)


@pytest.mark.parametrize("seed", range(8))
def test_rows_are_the_slots_with_the_stamps_of_the_wall_clock_between(tmp_path: Path, seed: int) -> None:
    """Which runs otherwise than the other, by up to 0.1 % and 1 ms between two samples, unless it is set."""
    draw, units = random.Random(seed), ImuUnits.SI if seed % 3 else ImuUnits.G_DPS
    (part,) = stream(seed, 1, 400)
    frames, off, before = list[DataMessage](), 10**18, None
    for each in part.frames:
        if before is not None and not each.flags & (REPEATED | INVALID):
            limit = math.floor(10**6 + 0.001 * (each.monotonic_ns - before))
            off += draw.choice((0, 0, 7, limit, -limit, limit + 1, -limit - 1, -3_600_000_000_000))
        before = before if each.flags & (REPEATED | INVALID) else each.monotonic_ns
        frames.append(each._replace(stamp_ns=each.monotonic_ns + off))
    row = describe(0, **part.in_force.info.settings)
    row["sensors"][0]["rate_hz"] = part.rate_hz
    items: list[Any] = [row]
    for each in frames:
        items += [each, {"event": "told"}][: 1 + (draw.random() < 0.05)]
    write(path := tmp_path / "run.mcap", items)
    slots, samples = slots_of([part._replace(frames=frames)])
    with open_recording(path) as recording:
        made = joined(
            samples_of(recording, Windows(LENGTH, tool=NO_TOOL if seed % 2 else None, imu_units=units))
        )
    assert made["monotonic_ns"].tolist() == [slot.stamp_ns for slot in slots]
    assert made["sequence"].tolist() == [slot.sequence for slot in slots]
    assert made["time_s"] == pytest.approx((made["monotonic_ns"] - samples[0].monotonic_ns) * 1e-9, abs=1e-12)
    is_gap, told = list[bool](), False
    for each in frames:
        told = told or bool(each.flags & GAP)
        if not each.flags & (REPEATED | INVALID):
            is_gap.append(told)
            told = False
    rows = list[list[Any]]()
    for slot, stamp in zip(slots, made["stamp_utc"].astype(int).tolist(), strict=True):
        found = SampleDecoder(61, units).decode(samples[slot.of].process_data)
        six = [*found.force, *found.torque]
        numbers = [*six, *found.acceleration, *found.angular_rate, found.temperature]
        if slot.of >= 0:
            last, valid = samples[slot.of], valid_of(samples[slot.of], part)[0][0]
            assert stamp == last.stamp_ns
            rows.append([*numbers, valid, is_gap[slot.of], found.status, found.warnings, *six, valid])
        else:
            after = samples[samples.index(last) + 1]
            passed, walked = after.monotonic_ns - last.monotonic_ns, after.stamp_ns - last.stamp_ns
            is_set = abs(walked - passed) > 10**6 + 0.001 * passed
            between = last.stamp_ns + round(walked * (slot.stamp_ns - last.monotonic_ns) / passed)
            assert stamp == NOT_A_TIME if is_set else abs(stamp - between) <= 1
            rows.append([*[math.nan] * 13, False, False, 0, 0, *six, False])
        if not rows[-1][13]:
            rows[-1][17:23] = [math.nan] * 6
    names = [*AXES, "temperature_degC", "valid", "gap", "status", "warnings"]
    if seed % 2:
        names += [*(f"compensated_{name}" for name in AXES[:6]), "compensated_valid"]
        assert np.isfinite(made["compensated_force_bound_N"]).tolist() == made["valid"].tolist()
    for name, column in zip(names, zip(*rows, strict=True), strict=False):
        assert made[name].astype(float) == pytest.approx(np.array(column, float), rel=1e-6, nan_ok=True), name

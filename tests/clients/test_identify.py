"""`ethercat-identify` on recordings of the virtual sensor, made at simulated time."""

from __future__ import annotations

import functools
import json
import math
import random
import re
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bota_clients.identify.cli import main
from bota_clients.identify.stationary_periods import StationaryPeriod, StationaryPeriods, tables_of
from bota_clients.recording.reader import open_recording
from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.pdo import STANDARD_GRAVITY, encode
from bota_ethercat.settings import start_up_defaults
from bota_ft_compensation.quantities import Payload
from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.virtual_sensor import signals
from ethercat_server.virtual_sensor.dictionary import Flash
from ethercat_server.virtual_sensor.options import SensorOptions
from ethercat_server.virtual_sensor.sensor import Firmware
from ethercat_server.virtual_sensor.signals import MOVE_LENGTH, POSE_LENGTH
from tests.clients.recordings import START_NS, describe, record, write
from tests.compensation import motion
from tests.compensation.making import written_parameters
from tests.ended import run_here
from tests.json_schema import problems

SINC = 512  # 100 Hz: quick to simulate
# What the sensor adds to its readings (object 0x8000): the bias that is to be found. N, Nm.
OFFSET = (3.0, -1.5, 7.25, 0.2, -0.05, 0.125)
CYCLE = POSE_LENGTH + MOVE_LENGTH
POSES_TAKE = 6 * CYCLE


def process_data(options: SensorOptions, seconds: float) -> Iterator[tuple[float, int, bytes]]:
    """Time since power-on (s), number and process data of every sample."""
    flash = Flash()
    flash.entries[0x8006, 1] = struct.pack("<H", SINC)
    now = 0
    firmware = Firmware(options, flash, lambda: now, lambda *_: None)
    for number, offset in enumerate(OFFSET, 1):
        firmware.dictionary.write(0x8000, number, struct.pack("<f", offset), AlState.PREOP)
    for number in range(int(seconds * 51200 / SINC)):
        now = firmware.sampler.clock.instant(number)
        yield now * 1e-9, number, firmware.inputs()


def frames(stream: Iterable[tuple[float, int, bytes]], sensor: int = 0) -> list[DataMessage]:
    """What the server makes of samples."""
    made = []
    for time_s, number, data in stream:
        moment = int(time_s * 1e9)
        made.append(DataMessage(number, START_NS + moment, moment, sensor, 0, 3, data))
    return made


@functools.cache
def posed() -> list[DataMessage]:
    """Six poses, moves between."""
    return frames(process_data(SensorOptions(signal="poses"), POSES_TAKE))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("identify") / "poses.mcap"
    record(path, posed())
    return path


def spoiled(frame: DataMessage) -> DataMessage:
    """Force and torque are saturated, and the force is not finite."""
    broken = bytearray(frame.process_data)
    broken[29] = 0xFF
    struct.pack_into("<f", broken, 5, math.inf)
    return frame._replace(process_data=bytes(broken))


def asked(*arguments: object) -> tuple[int, Any, str]:
    """Exit code, JSON and what was said, of a run with --json."""
    ended = run_here(main, *arguments, "--json")
    return ended.code, ended.json, ended.err


def refused(*arguments: object) -> str:
    """The one sentence of a run that fails."""
    ended = run_here(main, *arguments)
    assert ended.code == 1
    said = ended.err.splitlines()
    assert all(line.startswith("ethercat-identify: ") for line in said)
    return said[-1]


def periods(path: Path, least_seconds: float = 1.0) -> list[StationaryPeriod]:
    stationary = StationaryPeriods(least_seconds)
    with open_recording(path) as opened:
        for table in tables_of([opened.columns(0)]):
            stationary.add(table)
    stationary.end_stretch()
    assert stationary.rejected == []
    return stationary.found


def test_it_finds_the_tool_and_the_bias(recording: Path) -> None:
    code, answer, said = asked(recording)
    assert (code, answer["ok"], said) == (0, True, "")
    assert not problems("identify", answer)
    assert answer["tool_mass"] == pytest.approx(signals.TOOL_MASS, rel=0.01)
    assert math.dist(answer["tool_center_of_gravity"], signals.TOOL_CENTRE) < 0.002
    assert answer["bias"] == pytest.approx(OFFSET, abs=0.05)
    assert abs(answer["tool_mass"] - signals.TOOL_MASS) < 3 * answer["tool_mass_interval"]
    for number, pose in enumerate(answer["poses"]):
        assert number * CYCLE <= pose["begin_s"] <= number * CYCLE + 0.3
        assert POSE_LENGTH - 0.5 <= pose["seconds"] <= POSE_LENGTH + 0.2
        assert len(pose["residual_force"]) == 3
    assert number == 5
    assert {answer["force_fit"]["verdict"], answer["torque_fit"]["verdict"]} <= {"noise", "small"}
    assert answer["accelerometer"]["offset"] == pytest.approx([0.0] * 3, abs=0.02)


def test_a_person_sees_tables_and_no_number_cut_off(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for width, widest in (("100", 100), ("60", 80)):
        monkeypatch.setenv("COLUMNS", width)
        code, shown, _ = run_here(main, recording)
        assert code == 0
        for words in (
            "poses", "residual N", "mass", "center of gravity z", "mm", "± (95 %)", "bias torque x",
            "accelerometer offset z", "accelerometer cross-axis zy",
        ):  # fmt: skip
            assert words in shown
        assert "…" not in shown
        assert max(map(len, shown.splitlines())) <= widest


def test_the_yaml_is_what_the_node_takes(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "tool.yaml"
    _, answer, said = asked(recording, "--yaml", out)
    assert f"written to {out}" in said
    assert "serial number 100, from poses.mcap" in out.read_text().splitlines()[0]
    parameters = written_parameters(out)
    assert parameters["tool_mass"] == pytest.approx(answer["tool_mass"], abs=1e-8)
    assert parameters["bias"] == pytest.approx(answer["bias"], abs=1e-8)
    assert parameters["accelerometer.offset"] == pytest.approx(answer["accelerometer"]["offset"], abs=1e-8)
    assert parameters["accelerometer.scale"] == pytest.approx(answer["accelerometer"]["scale"], abs=1e-8)
    assert "gravity" not in parameters
    assert "tool.yaml exists: choose another name, or use --force" in refused(recording, "--yaml", out)
    asked(recording, "--yaml", out, "--force", "--gravity", "9.81")
    assert written_parameters(out)["gravity"] == [0.0, 0.0, -9.81]
    assert "cannot be written" in refused(recording, "--yaml", tmp_path / "no" / "x.yaml")


def test_the_bias_is_that_of_the_sensors_last_offset_which_the_file_names(tmp_path: Path) -> None:
    """Tared after half of the poses."""
    tared = [5.0, -4.0, 3.0, 0.1, -0.2, 0.3]
    described, half, later = describe(0), len(posed()) // 2, list[DataMessage]()
    described["sensors"][0] |= {"settings": start_up_defaults() | {"sinc_length": SINC}, "offset": [*OFFSET]}
    for each in posed()[half:]:
        data = bytearray(each.process_data)
        measured = struct.unpack_from("<6f", data, 5)
        shifted = [m + now - was for m, now, was in zip(measured, tared, OFFSET, strict=True)]
        struct.pack_into("<6f", data, 5, *shifted)
        later.append(each._replace(process_data=bytes(data)))
    told = {"event": "offset_changed", "sensor": 0, "offset": tared}
    write(tmp_path / "run.mcap", [described, *posed()[:half], told, *later])
    code, answer, _ = asked(tmp_path / "run.mcap", "--yaml", tmp_path / "tool.yaml")
    assert code == 0
    assert answer["bias"] == pytest.approx(tared, abs=0.05)
    assert written_parameters(tmp_path / "tool.yaml")["sensor_offset"] == pytest.approx(tared)


def test_other_frames_and_bad_samples_do_not_matter(tmp_path: Path) -> None:
    """Repeated frames, another sensor, and a saturated sample within a pose."""
    noise = random.Random(1)
    mixed = []
    for number, frame in enumerate(posed()):
        mixed.append(frame)
        if noise.random() < 0.1:
            mixed.append(frame._replace(flags=int(DataFlag.REPEATED)))
        if number == 150:
            mixed[-1] = spoiled(frame)
        mixed.append(frame._replace(sensor=1))
    path = tmp_path / "mixed.mcap"
    record(path, mixed, sensors=(0, 1))
    assert "several sensors (0, 1): choose one with --sensor" in refused(path)
    assert "no samples of sensor 7" in refused(path, "--sensor", 7)
    code, answer, _ = asked(path, "--sensor", 0)
    assert code == 0
    assert answer["tool_mass"] == pytest.approx(signals.TOOL_MASS, rel=0.01)
    for pose in answer["poses"]:
        end = pose["begin_s"] + pose["seconds"]
        assert not pose["begin_s"] <= 150 * SINC / 51200 <= end


def test_too_few_poses_are_refused_with_what_to_do_and_the_poses_are_shown(tmp_path: Path) -> None:
    path = tmp_path / "few.mcap"
    record(path, [frame for frame in posed() if frame.monotonic_ns < 3 * CYCLE * 1e9])
    code, answer, said = asked(path)
    assert code == 1
    assert not problems("identify", answer)
    assert len(answer["poses"]) == 3
    assert "there are 3 of at least 4 poses" in answer["error"]
    assert "axis points up" in said
    record(
        path := tmp_path / "four.mcap", [frame for frame in posed() if frame.monotonic_ns < 4 * CYCLE * 1e9]
    )
    code, answer, _ = asked(path)
    assert code == 0
    assert not problems("identify", answer)
    assert answer["tool_mass"] == pytest.approx(signals.TOOL_MASS, rel=0.01)
    assert "do not determine the accelerometer's offset along x" in answer["notes"][-1]


def test_a_gap_or_a_restarted_server_ends_a_rest_but_not_the_wall_clock(tmp_path: Path) -> None:
    one = [frame for frame in posed() if frame.monotonic_ns < 1.2e9]
    later = [frame._replace(monotonic_ns=frame.monotonic_ns + 10 * 10**9) for frame in one]
    before = [frame._replace(monotonic_ns=frame.monotonic_ns + 5 * 10**9) for frame in one]
    record(path := tmp_path / "gaps.mcap", [*one, *later, *before])
    assert len(periods(path, 0.5)) == 3
    half = len(one) // 2
    set_back = [frame._replace(stamp_ns=frame.stamp_ns + 3600 * 10**9) for frame in one[half:]]
    record(path := tmp_path / "set.mcap", [*one[:half], *set_back])
    (found,) = periods(path, 0.5)
    assert found.seconds == pytest.approx(1.0, abs=0.05)


def test_what_cannot_be_used_is_one_sentence(recording: Path, tmp_path: Path) -> None:
    record(
        path := tmp_path / "still.mcap", frames(process_data(SensorOptions(signal="rest", noise=False), 4.0))
    )
    assert "check imu_raw_units" in refused(path, "--imu-raw-units", "si")
    record(path := tmp_path / "scene.mcap", frames(process_data(SensorOptions(), 4.0)))
    assert "never stationary for 1 s" in refused(path)
    assert "cannot be read: No such file" in refused(tmp_path / "none.mcap")
    (tmp_path / "text.mcap").write_text("hello")
    assert "text.mcap" in refused(tmp_path / "text.mcap")
    record(tmp_path / "empty.mcap", [])
    assert "has no samples" in refused(tmp_path / "empty.mcap")


@pytest.mark.parametrize(
    "arguments",
    [[], ["a.mcap", "b.mcap"], ["a.mcap", "--gravity", "1"], ["a.mcap", "--sensor", "-1"]],
)  # fmt: skip
def test_wrong_usage_is_exit_code_2(arguments: list[str]) -> None:
    ended = run_here(main, *arguments)
    assert ended.code == 2
    assert "usage: ethercat-identify" in ended.err


def test_a_sensor_that_was_exchanged_meanwhile_is_refused(tmp_path: Path) -> None:
    path, half, other = tmp_path / "swapped.mcap", len(posed()) // 2, describe(0)
    other["sensors"][0]["serial"] = 7
    write(path, [describe(0), *posed()[:half], other, *posed()[half:]])
    assert "sensor 0 was replaced during it (serial numbers 100, 7)" in refused(path)


@pytest.fixture(scope="module")
def shaken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """By hand for 6 s, with FIR on."""
    path = tmp_path_factory.mktemp("identify") / "shaken.mcap"
    settings: dict[str, Any] = {**start_up_defaults(), "fir": True}
    shaking = motion.guided(1, metres=0.06, radians=0.3, hertz=(1.5, 4.0))
    record_felt(path, motion.filtered(shaking, Payload(0.7), 6.0, settings), settings)
    return path


def record_felt(path: Path, felt: motion.Felt, settings: dict[str, Any]) -> None:
    record(path, felt_frames(felt), **settings)


def felt_frames(felt: motion.Felt) -> list[DataMessage]:
    made = []
    for number, (time_s, *vectors) in enumerate(zip(*felt, strict=True)):
        names = ("force", "torque", "acceleration", "angular_rate")
        scales = (1.0, 1.0, 1 / STANDARD_GRAVITY, 180 / math.pi)
        values = {
            f"{name}.{axis}": value * scale
            for name, scale, vector in zip(names, scales, vectors, strict=True)
            for axis, value in zip("xyz", vector, strict=True)
        }
        made.append((time_s + 1.0, number, encode(61, values)))
    return frames(made)


@pytest.mark.parametrize("turns", [True, False])
def test_the_inertia_is_found_if_the_tool_turned_between_the_poses_and_likely_if_not(
    turns: bool, tmp_path: Path
) -> None:
    """Seven poses, and 8 s in which it is turned to and fro."""
    begin_s, wrist, arm = 21.0, motion.turned(3), motion.waypoints(1.4, 1.6, 2, radians=5.0)

    def path(t: motion.Array) -> tuple[motion.Array, motion.Array]:
        (place, angles), late = arm(np.minimum(t, begin_s)), t > begin_s
        share = np.clip((t[late] - begin_s) / 2.0, 0.0, 1.0)[:, None] ** 2
        angles[late] += share * wrist(t[late])[1]
        return place, angles

    tool = Payload(1.5, (0.05, -0.03, 0.07), (0.009, 0.011, 0.006, 0.001, -0.002, 0.001))
    settings: dict[str, Any] = start_up_defaults()
    felt = motion.filtered(path if turns else arm, tool, begin_s + 8.0 * turns, settings)
    if not turns:  # not even from pose to pose
        felt = motion.Felt(*(part[felt.times % 3.0 < 1.6] for part in felt))
    record_felt(tmp_path / "a.mcap", felt, settings)
    files = {suffix: tmp_path / f"tool.{suffix}" for suffix in ("yaml", "bota", "again")}
    code, found, _ = asked(tmp_path / "a.mcap", "--yaml", files["yaml"], "--bota", files["bota"])
    assert run_here(main, files["yaml"], "--bota", files["again"]).code == 0
    of_bota = json.loads(files["bota"].read_text())
    rounded: Any = lambda text: pytest.approx(float(text), abs=2e-6)  # noqa: E731
    assert of_bota == json.loads(files["again"].read_text(), parse_float=rounded)
    assert (code, bool(problems("identify", found))) == (0, False)
    written = written_parameters(tmp_path / "tool.yaml")
    assert written["tool_inertia"] == pytest.approx(found["tool_inertia"], abs=1e-8)
    assert written["tool_inertia_interval"] == pytest.approx(found["tool_inertia_interval"], abs=1e-8)
    errors = np.abs(np.subtract(found["tool_inertia"], tool.inertia))
    if turns:
        assert errors.max() < 0.0006
        assert max(found["tool_inertia_interval"]) < 0.001
        of_two = [frame for frame in felt_frames(felt) if frame.monotonic_ns > 15.0e9]
        record(tmp_path / "two.mcap", of_two, **settings)
        code, by_motion, _ = asked(tmp_path / "two.mcap")
        assert (code, by_motion["poses"]) == (0, []), "poses that do not suffice are not shown with a result"
    else:
        assert (errors < found["tool_inertia_interval"]).all()
        assert "hardly turned about" in " ".join(found["notes"])


def test_without_a_rest_all_is_found_by_motion_and_a_wrong_unit_is_refused(tmp_path: Path) -> None:
    tool = Payload(1.5, (0.05, -0.03, 0.07), (0.009, 0.011, 0.006, 0.001, -0.002, 0.001))
    settings: dict[str, Any] = start_up_defaults()
    felt = motion.filtered(motion.turned(3), tool, 10.0, settings)
    some_spoiled = (spoiled(each) if n % 100 == 50 else each for n, each in enumerate(felt_frames(felt)))
    record(tmp_path / "a.mcap", some_spoiled, **settings)
    code, found, _ = asked(tmp_path / "a.mcap", "--yaml", tmp_path / "tool.yaml")
    assert (code, bool(problems("identify", found)), found["poses"]) == (0, False, [])
    truths: dict[str, Any] = {"mass": tool.mass, "center_of_gravity": tool.center, "inertia": tool.inertia}
    for name, truth in truths.items():
        half = np.abs(found[f"tool_{name}_interval"])
        assert (np.abs(np.subtract(found[f"tool_{name}"], truth)) <= 1.5 * half).all()
    assert "from free motion" in (tmp_path / "tool.yaml").read_text().splitlines()[1]
    record_felt(tmp_path / "b.mcap", felt._replace(rate=np.radians(felt.rate)), settings)
    assert re.search(r"or, by motion alone: gravity turns [56]\d", refused(tmp_path / "b.mcap"))


def test_the_lag_of_the_force_is_told_beside_what_the_filters_imply(shaken: Path) -> None:
    code, found, _ = asked("delay", shaken)
    assert code == 0
    assert not problems("identify-delay", found)
    assert found["expected_ms"] == pytest.approx(15 - 1.94)
    assert found["lag_ms"] == pytest.approx(found["expected_ms"], abs=0.2)
    ended = run_here(main, "delay", shaken)
    assert "after the accelerometer; by the filters that were set: 13.06 ms" in ended.out


def test_a_recording_at_rest_shows_no_lag(tmp_path: Path) -> None:
    record(tmp_path / "rest.mcap", frames(process_data(SensorOptions(signal="rest"), 6.0)))
    assert "shake the sensor" in refused("delay", tmp_path / "rest.mcap")
    code, found, _ = asked("delay", tmp_path / "rest.mcap")
    assert (code, found["ok"]) == (1, False)
    assert not problems("identify-delay", found)


def test_settings_of_a_recording_that_cannot_be_are_ignored(tmp_path: Path, shaken: Path) -> None:
    with open_recording(shaken) as opened:
        every = list(opened.frames())
    odd: dict[str, Any] = {"sinc_length": "long", "fir": [], "acceleration_filter": {}, "chop": None}
    record(tmp_path / "odd.mcap", every, **odd)
    code, found, _ = asked("delay", tmp_path / "odd.mcap")
    assert (code, found["expected_ms"]) == (0, None)
    assert "by the filters that were set: unknown" in run_here(main, "delay", tmp_path / "odd.mcap").out

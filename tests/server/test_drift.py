"""What the server learns of a sensor that stands still for long: drift since the tare, overload; and what it
keeps of that in files."""

from __future__ import annotations

import errno
import json
import math
import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from bota_ethercat.health import sentences as words
from bota_ethercat.health.judge import Observation, judge
from bota_ethercat.health.limits import LIMITS
from bota_ethercat.pdo import PDO_FIELDS
from bota_ethercat.replies import SensorStatus, decode
from ethercat_server.acquisition.drift import Drift
from ethercat_server.daemon.histories import kept
from ethercat_server.sensor.sensor import Identity, Sensor
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.server.running import wait_until
from tests.simulation import ManualClock, Simulation

NAMES = [field.name for field in PDO_FIELDS[:18]]
LEVEL = (0.0, 0.0, 1.0)
At = Callable[[float], float]


class Arm:
    """A sensor that samples at 4 Hz, with 0.05 N of noise."""

    def __init__(self, serial: int = 7) -> None:
        self.clock = ManualClock()
        self.sensor = Sensor(0, Identity("BFT", serial, "", ""), {})
        self.drift = Drift(self.sensor, self.clock)
        self._random = random.Random(1)

    def rest(
        self,
        seconds: int,
        force_z: At = lambda _: 0.0,
        temperature: At = lambda _: 30.0,
        up: tuple[float, float, float] = LEVEL,
    ) -> None:
        """Let time pass, by functions of the seconds since this began."""
        for second in range(seconds):
            rows = dict.fromkeys(NAMES, [0.0] * 4)
            rows["force.z"] = [force_z(second + n / 4) + self._random.gauss(0, 0.05) for n in range(4)]
            rows["temperature"] = [temperature(second)] * 4
            rows |= {f"acceleration.{axis}": [value] * 4 for axis, value in zip("xyz", up, strict=True)}
            self.clock.sleep(1.0)
            for half in (slice(2), slice(2, 4)):
                self.drift.add([rows[name][half] for name in NAMES])
            self.drift.each_second()

    @property
    def row(self) -> SensorStatus:
        """As a client reads it in `status`."""
        return decode(SensorStatus, self.drift.as_json())

    @property
    def moved(self) -> float | None:
        """N of Fz; None before there is anything to compare."""
        found = self.drift.as_json()["drift"]
        return None if found is None else found["wrench"][2]

    def warm_up(self, newtons_per_kelvin: float) -> None:
        """10 K in 10 minutes, from a tare on."""
        self.drift.begin("tare")
        self.rest(600, lambda s: newtons_per_kelvin * 10 * s / 600, lambda s: 30 + 10 * s / 600)


def test_drift_since_the_tare_is_told_with_the_axis_the_time_and_the_temperature() -> None:
    arm = Arm()
    arm.warm_up(0.12)
    told = words.drift(arm.row, LIMITS)
    assert told == "Fz has drifted 1.2 N since the tare 10 min ago, 10 K warmer"
    assert str(judge(Observation(drift=told))) == f"Worth a look: {told}: re-tare advised"
    hardly = Arm()
    hardly.warm_up(-0.003)
    assert words.drift(hardly.row).startswith("Fz has drifted 0.0 N since")
    arm.drift.begin("tare")
    arm.rest(80)
    assert words.drift(arm.row, LIMITS) == ""
    assert arm.moved == pytest.approx(0, abs=0.05)


def grip(seconds: float) -> At:
    """A contact of 2 N that comes in this time."""
    return lambda s: 2.0 * min(s / seconds, 1.0)


@pytest.mark.parametrize(
    ("force_z", "up"),
    [
        (grip(0.1), LEVEL),
        (grip(60.0), LEVEL),
        (grip(300.0), (0.0, math.sin(0.03), math.cos(0.03))),
        (grip(300.0), (0.0, 0.0, 0.0)),
        (lambda s: 2.0 + 3 * math.sin(s), LEVEL),
    ],
    ids=["contact", "slow contact", "another pose", "no IMU", "motion"],
)
def test_what_may_be_a_contact_is_not_believed_until_the_wrench_is_back(
    force_z: At, up: tuple[float, float, float]
) -> None:
    arm = Arm()
    arm.rest(80)
    arm.rest(300, force_z, up=up)
    assert arm.moved == pytest.approx(0, abs=0.3), "what a tare calls steady, too"
    arm.rest(16, lambda _: 5.0)
    arm.rest(600, lambda s: s / 600)
    assert arm.moved == pytest.approx(1.0, abs=0.1), "it goes on once it is back"


def test_before_the_first_rest_and_of_raw_counts_nothing_is_said() -> None:
    arm = Arm()
    arm.rest(16, lambda s: 10 * math.sin(s))
    assert arm.moved is None
    arm.sensor.settings = {"calibration_matrix": False}
    arm.rest(16)
    assert (arm.moved, arm.drift.history.peak[2] < 11) == (None, True)


@pytest.mark.parametrize(("register", "saturations"), [(1, 1), (16, 1), (8, 0), (2, 0)])
def test_an_overload_is_one_by_the_warnings_register_too(register: int, saturations: int) -> None:
    arm = Arm()
    arm.rest(2)
    arm.drift.add([[register] if name == "warnings" else [0.0] for name in NAMES])
    arm.drift.each_second()
    assert arm.drift.history.saturations == saturations


def test_overload_is_counted_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    simulation = Simulation(SensorOptions(signal="constant"), settings={"sinc_length": 1024})
    drift: Any = simulation.server.streams[0].drift
    with kept([drift]):
        simulation.run(2.0)
        for _ in range(2):
            simulation.command("limit force.z 5")
            simulation.run(2.5)
            simulation.command("limit force.z off")
            simulation.run(2.5)
    row = simulation.status()["sensors"][0]
    text, overloaded = words.overload(decode(SensorStatus, row))
    assert overloaded
    assert "(2 times in all); largest wrench since " in text
    assert "Fz 9.75 N" in text
    again = Drift(drift.sensor, ManualClock())
    with kept([again]):
        assert again.history.as_json() == row["history"]


@pytest.mark.parametrize(
    "text",
    ["", "[", "[]", '{"runs": 3, "peak": "x", "since": {}, "saturations": [], "saturated_at": NaN}',
     '{"runs": [[1e400, 0, 0, 0, 0, 0], [1e300, 0, 0, 0, 0, 0], null, []], "peak": [1]}', "[" * 9999,
     '{"peak": [1, 1, 1, 1, 1, 1]}' + " " * (1 << 20)],
)  # fmt: skip
def test_a_hostile_file_is_a_new_history(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    (tmp_path / "sensor-7.json").write_text(text)
    arm = Arm()
    with kept([arm.drift]):
        history = arm.drift.history
        assert (history.peak, history.saturations) == ([0.0] * 6, 0)
        assert json.loads(json.dumps(history.as_json(), allow_nan=False))["saturated_at"] is None


def test_a_history_is_written_once_a_full_disk_has_space(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    monkeypatch.setattr("ethercat_server.daemon.histories._EVERY_S", 0.01)
    arm = Arm()
    with monkeypatch.context() as disk:
        disk.setattr(os, "fsync", full)
        with kept([arm.drift]):
            arm.drift.history.changed = True
            wait_until(lambda: "the history of sensor 0 is not kept: [Errno 28]" in caplog.text, "said")
            disk.undo()
    assert [path.name for path in tmp_path.iterdir()] == ["sensor-7.json"]


def test_sensors_with_the_same_serial_number_have_no_history(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    (tmp_path / "sensor-7.json").write_text('{"saturations": 3}')
    arms = [Arm(7), Arm(7), Arm(8)]
    with kept([arm.drift for arm in arms]):
        for arm in arms:
            assert arm.drift.history.saturations == 0
            arm.drift.history.saturations, arm.drift.history.changed = 4, True
    assert caplog.text.count("another one has its serial number 7, too") == 2
    assert (tmp_path / "sensor-7.json").read_text() == '{"saturations": 3}'
    assert json.loads((tmp_path / "sensor-8.json").read_text())["saturations"] == 4


@pytest.mark.parametrize(
    "row",
    [
        {},
        {"drift": 1, "history": "x"},
        {"drift": {"wrench": [1] * 6, "ago_s": "x"}, "history": {"since": 1e30}},
    ],
)
def test_what_a_server_does_not_know_or_makes_up_is_not_said(row: dict[str, Any]) -> None:
    known = decode(SensorStatus, row)
    assert (words.drift(known), words.overload(known)) == ("", ("", False))

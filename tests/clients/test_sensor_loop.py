"""What controllers see through the ros2_control plugin: the class behind it, without ROS."""

from __future__ import annotations

import contextlib
import json
import math
import random
import select
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from bota_clients.identify.cli import main as identify
from bota_ethercat.control import Event, event
from bota_ethercat.framing import DataFlag, encode_data
from bota_ethercat.pdo import STANDARD_GRAVITY, encode
from bota_ft_compensation.alignment import align
from bota_ft_compensation.bias import TareBasis
from bota_ft_compensation.bounds import Bounds
from bota_ft_compensation.compensator import Compensator
from bota_ft_compensation.imu import ImuSource
from bota_ft_compensation.quantities import ZERO, Accelerometer, Accuracy, Payload
from bota_ft_compensation.specific_force import ImuSpecificForce
from tests.bridge.scripted_server import ScriptedServer
from tests.clients.cpp_programs import (
    FAST,
    ROOT,
    SANITIZED,
    SOURCES,
    Commanded,
    build,
    end_driver,
    frame,
    needs_gxx,
    patient,
)
from tests.clients.recordings import record
from tests.clients.test_identify import posed
from tests.compensation.motion import settings
from tests.descriptions import sensor_row
from tests.ended import run_here
from tests.ros_package.test_urdf import FIGURES
from tests.server.running import PATIENCE_S, free_port, wait_until

pytestmark = [needs_gxx, patient]

PACKAGE = ROOT / "clients" / "ros2_control"
THREADS = ("-g", "-O1", "-fsanitize=thread", "-fno-sanitize-recover=all")
FRESH, SATURATED, NOT_FINITE, LATE, BAD_CLOCK, REPEATED, INVALID, SILENT, LOST, DISCONNECTED = range(10)
UNCHECKED = 100
FOREVER = {"max_age": 10, "error_after": "inf", "receive_priority": 0}
"""For what must not depend on how fast this machine is."""

Seen = dict[str, Any]


def program(sanitized: tuple[str, ...] = SANITIZED) -> Path:
    return build(SOURCES / "sensor_loop.cpp", (*sanitized, "-pthread", f"-I{PACKAGE / 'include'}"))


class Loop(Commanded):
    def __init__(self, path: Path) -> None:
        self.process = subprocess.Popen([path], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def has_answered(self) -> bool:
        assert self.process.stdout is not None
        return bool(select.select([self.process.stdout], [], [], 0.005)[0])

    def new(self, *flags: str, **parameters: object) -> str:
        return str(self.do("new", *flags, *(f"{name}={value}" for name, value in parameters.items()))["why"])

    def opened(self, port: int, *flags: str, **parameters: object) -> Loop:
        assert self.new(*flags, host="127.0.0.1", port=port, **{**FOREVER, **parameters}) == ""
        told = self.do("open")
        assert told["ok"], told
        return self

    def refused(self, port: int, *flags: str, **parameters: object) -> str:
        assert self.new(*flags, host="127.0.0.1", port=port, connect_timeout=0, **parameters) == ""
        told = self.do("open")
        assert not told["ok"]
        return str(told["why"])

    def read(self) -> Seen:
        seen: Seen = self.do("read")
        assert seen["allocated"] == 0
        return seen

    def until(self, condition: int, holds: Callable[[Seen], bool] = lambda _: True) -> Seen:
        """The first cycle with this condition; `holds` for every one before it."""
        last: Seen = {}

        def so() -> bool:
            last.update(self.read())
            assert last["condition"] == condition or holds(last), last
            return bool(last["condition"] == condition)

        wait_until(so, f"condition {condition}")
        return last

    def logged(self, text: str, times: int = 1) -> None:
        wait_until(
            lambda: bool(self.read()) and sum(text in line for line in self.do("log")) >= times,
            f"the log to say: {text}",
        )


@pytest.fixture(scope="module", params=[SANITIZED, FAST], ids=["strict", "fast math"])
def running(request: pytest.FixtureRequest) -> Iterator[Loop]:
    loop = Loop(program(request.param))
    yield loop
    assert end_driver(loop.process) == 0


@pytest.fixture
def server(running: Loop) -> Iterator[ScriptedServer]:
    with ScriptedServer() as sensor:
        yield sensor
        running.do("stop")


# -- parameters


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("port", "0", 'the parameter port is "0"; allowed: 1 to 65535'),
        ("port", "12001x", "allowed: 1 to 65535"),
        ("sensor", "-1", "allowed: a position on the bus, 0 to 255"),
        ("max_age", "0,01", "allowed: 0.001 to 10 (s)"),
        ("max_age", "nan", "allowed: 0.001 to 10 (s)"),
        ("error_after", "-0.1", "allowed: 0 or more (s), or inf for never"),
        ("on_stale", "use", 'the parameter on_stale is "use"; allowed: error, nan or hold'),
        ("on_saturated", "NaN", "allowed: error, nan, hold or use"),
        ("on_activate_tare", "yes", "allowed: true or false"),
        ("tool_center_of_gravity", "1,2", "allowed: three numbers (m)"),
        ("bias", "1,2,3,4,5,6,7", "allowed: six numbers (N, Nm)"),
        ("accelerometer.scale", "1,1,0", "allowed: three numbers, about 1"),
        ("quality", "1", 'there is no parameter "quality"; there are: host'),
    ],
)
def test_wrong_parameters_are_refused_in_a_sentence(running: Loop, name: str, value: str, said: str) -> None:
    """Those that xacro writes are right."""
    assert said in running.new(**{name: value})
    assert running.new(host="::1", serial=4294967295, on_activate_tare="True", error_after="1e-1") == ""


# -- what controllers see


GROUPS = {
    "on_stale": (LATE, REPEATED, SILENT, LOST, DISCONNECTED),
    "on_invalid": (INVALID, NOT_FINITE, BAD_CLOCK),
    "on_saturated": (SATURATED,),
}


@pytest.mark.parametrize(("parameter", "conditions"), GROUPS.items())
def test_what_controllers_see_in_each_condition(
    running: Loop, parameter: str, conditions: tuple[int, ...]
) -> None:
    for condition in conditions:
        for reaction, momentary in (("nan", None), ("hold", 5.0), ("error", None)):
            running.new(**{parameter: reaction, "error_after": 0.5})
            good = running.do("take", FRESH, 1000, 1, 1, 5.0)
            assert (good["good"], good["force.x"], good["condition"], good["age"]) == (
                True,
                5.0,
                FRESH,
                0.001,
            )
            first = running.do("take", condition, 1100, 101, 1, 9.0)
            assert (first["good"], first["force.x"]) == (reaction != "error", momentary)
            assert (first["condition"], first["age"], first["allocated"]) == (condition, 0.101, 0)
            assert running.do("take", condition, 1599, 600, 1, 9.0)["good"] == (reaction != "error")
            lasting = running.do("take", condition, 1600, 601, 1, 9.0)
            assert (lasting["good"], lasting["force.x"]) == (False, None)
            # Usable again: the time counts anew.
            assert running.do("take", FRESH, 1700, 1, 1, 6.0)["good"]
            assert running.do("take", condition, 1800, 101, 1, 9.0)["good"] == (reaction != "error")


def test_a_reading_grows_old(running: Loop) -> None:
    """The receiving thread has no time on the processor, or waits for a new connection."""
    running.new(on_stale="hold", max_age=0.01)
    seen = running.do("take", FRESH, 1009, 1, 1, 5.0, 1000, 1)
    assert (seen["force.x"], seen["condition"], seen["age"]) == (5.0, FRESH, 0.01)
    for checked, is_connected, condition in ((1, 1, LATE), (0, 1, LATE), (1, 0, DISCONNECTED)):
        seen = running.do("take", FRESH, 1010, 1, checked, 9.0, 1000, is_connected)
        assert (seen["force.x"], seen["condition"], round(seen["age"], 9)) == (5.0, condition, 0.011)
    assert running.do("take", SILENT, 1010, 1, 1, 9.0, 1000, 0)["condition"] == SILENT


def test_unchecked_samples_saturated_ones_that_may_be_used_and_no_time_limit(running: Loop) -> None:
    running.new(on_invalid="hold")
    running.do("take", FRESH, 0, 1, 1, 5.0)
    seen = running.do("take", FRESH, 1, 1, 0, 9.0)
    assert (seen["force.x"], seen["condition"]) == (5.0, UNCHECKED)
    assert running.do("take", LATE, 2, 50, 0, 9.0)["condition"] == LATE
    running.new(on_saturated="use", error_after=0)
    seen = running.do("take", SATURATED, 0, 1, 1, 900.0)
    assert (seen["good"], seen["force.x"], seen["condition"]) == (True, 900.0, SATURATED)
    running.new(error_after="inf")
    for now_ms in (0, 1_000_000_000):
        seen = running.do("take", SILENT, now_ms, -1, 1, 0.0)
        assert (seen["good"], seen["force.x"], seen["age"]) == (True, None, math.inf)


# -- the tool


TOOL = {
    "tool_mass": 1.25,
    "tool_center_of_gravity": "[0.01,-0.02,0.08]",
    "tool_inertia": "0.01,0.02,0.015,0.001,-0.002,0.003",
    "accelerometer.offset": "0.3,-0.2,0.1",
    "accelerometer.scale": "1.01,0.99,1.002",
    "accelerometer.cross_axis": "0.001,-0.002,0.003,-0.004,0.005,-0.006",
    "gyroscope_matrix": "1.01,0.002,-0.003,0.004,0.99,0.005,-0.006,0.007,1.02",
    "imu_position": "0,0,-0.03",
}


NOT_BY_POSES = {"tool_inertia", "accelerometer.cross_axis", "gyroscope_matrix", "imu_position"}


def moving(rate_hz: float) -> Iterator[tuple[float, tuple[float, ...]]]:
    """Times, acceleration, angular rate: pushes, turns, gaps of any length, NaN, a clock that stood still."""
    random_ = random.Random(7)
    time_s = 1000.0
    for number in range(400):
        if number % 20 == 0:
            felt, turned = [random_.gauss(0, 3) for _ in range(3)], random_.choice((0.0, 0.02, 0.045, 1.0))
            rates = [random_.gauss(0, turned) for _ in range(3)]
        time_s += random_.choice((*(1,) * 12, 0, 2, 3, 5, 15, 90, 90)) / rate_hz * random_.uniform(0.9, 1.1)
        last = math.nan if number % 60 == 50 else rates[2]
        yield time_s, (*(each + random_.gauss(0, 0.1) for each in felt), *rates[:2], last)
    for number in range(60):  # in gaps, about as much as is a push, and turned about as much as is turning
        time_s += 90 / rate_hz
        part, other = 1.0 + 0.001 * (number - 30), number % 2
        yield time_s, (0.5 * part * other, 0.0, 9.8, 0.05 * part * (number % 3 == 1), 0.0, 0.0)


def loads(running: Loop, model: str, lag_s: float, fir: bool, rate_hz: float, *samples: Any) -> Any:
    running.begin("tool", f"BFT-{model}-ECAT-M8", lag_s, int(fir), rate_hz, len(samples))
    for time_s, values in samples:
        running.begin(repr(time_s), *map(repr, values))
    return running.answer()


@pytest.mark.parametrize(
    ("rate_hz", "fir", "lag_ms"),
    [
        (1600, 0, -1.0025),
        (800, 0, -0.065),
        (100, 0, 13.06),
        (800, 1, 13.06),
        (250, 1, 46.06),
        (800, 0, -33.0),
    ],
)
def test_the_load_of_the_tool_is_that_of_python(
    running: Loop, rate_hz: float, fir: int, lag_ms: float
) -> None:
    assert running.new(**TOOL) == ""
    samples = list(moving(rate_hz))
    found = loads(running, "SENS", lag_ms / 1e3, bool(fir), rate_hz, *samples)
    rows = [tuple(yaml.safe_load(f"[{str(row).strip('[]')}]")) for row in TOOL.values()]
    tool = Payload(rows[0][0], *rows[1:3])
    x, y, z = tool.center
    aligned = align({**settings(), "fir": bool(fir)}, rate_hz, lag_ms / 1e3)
    imu = ImuSpecificForce(
        (x, y, z - rows[7][2]), Accelerometer(rows[3], rows[4], cross_axis=rows[5]), aligned, rows[6]
    )
    for number, (time_s, values) in enumerate(samples):
        ax, ay, az, wx, wy, wz = values
        felt = imu.follow((ax, ay, az), (wx, wy, wz), time_s)
        load = found[6 * number : 6 * number + 6]
        if felt is None:
            assert load == [None] * 6, number
        else:
            expected = Compensator(tool).compensate(ZERO, ZERO, felt, imu.turning).tool
            assert load == pytest.approx(expected.values, abs=1e-6), number


@pytest.mark.parametrize("seed", range(20))
def test_the_bounds_are_those_of_python(running: Loop, seed: int) -> None:
    """Identified, typed and unknown tensors; after a tare, and without; of tools identified in motion."""
    draw = random.Random(seed)

    def some(count: int, largest: float, *, likely: float = 1.0) -> Any:
        return tuple(draw.uniform(0.0, largest) * (draw.random() < likely) for _ in range(count))

    tensors = some(6, 0.02, likely=float(seed % 3 > 0)), some(6, 0.01, likely=float(seed % 3 == 2))
    tool = Payload(draw.uniform(0.1, 3.0), some(3, 0.2), tensors[0], some(3, 0.01), tensors[1])
    imu = Accelerometer(
        offset_interval=some(3, 0.8), scale_interval=some(3, 0.01), cross_axis_interval=some(6, 0.01)
    )
    known = Accuracy(some(6, 0.2, likely=float(seed % 2)), some(6, 0.1, likely=float(seed % 4 == 1)))
    place, (rate_hz, fir, lag_s) = (
        some(3, 0.05),
        [(800.0, 0, 1e-3), (100.0, 1, 0.1), (1600.0, 0, 0.0)][seed % 3],
    )
    rows = {
        "tool_mass": [tool.mass],
        "tool_center_of_gravity": tool.center, "tool_inertia": tool.inertia,
        "tool_center_of_gravity_interval": tool.center_interval,
        "tool_inertia_interval": tool.inertia_interval, "imu_position": place,
        "accuracy.noise": known.noise, "accuracy.left": known.left,
    }  # fmt: skip
    rows |= {f"accelerometer.{name}": part for name, part in imu._asdict().items() if "interval" in name}
    assert running.new(**{name: ",".join(map(repr, row)) for name, row in rows.items()}) == ""
    felt, rate, spin, at = some(3, 20.0), some(3, 3.0), some(3, 20.0), some(3, 9.8)
    aligned = align(settings(round(51200 / rate_hz), bool(fir)), rate_hz, lag_s)
    lever = ImuSource(tool.center, place).lever_of("")
    for tared, taken in enumerate((None, TareBasis(tool, None, imu), TareBasis(tool, at, imu))):
        told = running.do(
            "bounds", "NONE", lag_s, fir, rate_hz, tared, *map(repr, (*felt, *rate, *spin, *at))
        )
        found = Bounds(tool, imu, aligned, lever, taken, known).at(felt, (rate, spin))
        assert told == pytest.approx(found, rel=1e-6)


@pytest.mark.parametrize(("model", "heights"), [*FIGURES.items(), ("NONE", (0.0, 0.0))])
def test_the_imu_is_where_the_model_has_it(running: Loop, model: str, heights: tuple[float, float]) -> None:
    running.new(tool_mass=2)
    turning = [(1 + number / 800, (0.0, 0.0, 9.0, 3.0, 0.0, 0.0)) for number in range(6)]
    force = loads(running, model, 0, False, 800, *turning)[-4]
    origin, imu_at = heights
    assert force == pytest.approx(-2 * (9.0 - 3.0**2 * (origin - imu_at) / 1000))


def test_the_compensated_wrench_is_without_bias_and_tool(running: Loop) -> None:
    running.new(bias="1,0,0,0,0,0", **TOOL)
    seen = running.do("take", FRESH, 1000, 1, 1, 5.0)
    assert (seen["force.x"], seen["compensated.force.x"]) == (5.0, 3.75)
    assert running.do("take", LATE, 1100, 101, 1, 9.0)["compensated.force.x"] is None


def test_the_payload_from_the_file_of_an_identification(running: Loop, tmp_path: Path) -> None:
    recording, path = tmp_path / "poses.mcap", tmp_path / "tool.yaml"
    record(recording, posed())
    assert run_here(identify, recording, "--yaml", path).code == 0
    (parameters,) = yaml.safe_load(path.read_text()).values()
    given = {name: value for name, value in parameters["ros__parameters"].items() if name in TOOL}
    assert given.keys() >= TOOL.keys() - NOT_BY_POSES
    found = []
    for asked in ({"payload_file": path}, {k: str(v).replace(" ", "") for k, v in given.items()}):
        assert running.new(**asked) == ""
        found.append(loads(running, "SENS", 0, False, 800, (1.0, (0.1, 0.2, 9.8, 0.0, 0.0, 0.0))))
    assert found[0] == pytest.approx(found[1])
    assert found[0][2] == pytest.approx(-given["tool_mass"] * 9.8, rel=0.05)
    path.write_text("/**:\n  ros__parameters:\n    tool_mass: heavy\n")
    for file in (path, tmp_path / "none.yaml"):
        assert "allowed: a file that ethercat-identify --yaml" in running.new(payload_file=file)


# -- which sensors are refused


@pytest.mark.parametrize(
    ("flags", "parameters", "sensor", "said"),
    [
        ("", {"serial": 8}, {}, "is BFT-SENS-ECAT-M8, serial 100, but the parameter serial is 8"),
        ("", {}, {"calibration_matrix": False}, "sends ADC counts instead of N and Nm"),
        (
            "",
            {"max_age": 0.01},
            {"rate_hz": 150},
            "has a sample every 0.006667 s: raise max_age (0.01 s) to at least 0.01333",
        ),
        ("imu", {}, {"imu_active": 0}, "has its IMU switched off"),
        ("", {"tool_mass": 1}, {"imu_active": 0}, "has its IMU switched off"),
        ("", {"tool_mass": 1}, {"inertia_compensation": True}, "subtracts gravity and inertia itself"),
        ("", {}, {"imu_active": 0, "rate_hz": None, "inertia_compensation": True}, ""),
        ("imu orientation", {}, {"orientation_estimation": False}, ""),  # NaN
    ],
)
def test_sensors_that_cannot_give_what_the_urdf_asks_for(
    running: Loop, flags: str, parameters: dict[str, object], sensor: dict[str, Any], said: str
) -> None:
    running.new(*flags.split(), **parameters)
    told = running.do("check", json.dumps({"protocol": 1, "sensors": [sensor_row(**sensor)]}))
    assert told["why"].startswith(said)
    assert bool(told["why"]) == bool(said)


# -- connections


def test_a_sample_is_fresh_for_four_periods_but_at_least_10_ms(running: Loop, server: ScriptedServer) -> None:
    assert running.new(host="127.0.0.1", port=server.port, receive_priority=0, error_after="inf") == ""
    assert running.do("open")["ok"]
    assert running.do("max_age") == 0.01
    server.reconfigure(rate_hz=100)
    running.logged("are accepted")
    wait_until(lambda: bool(running.do("max_age") == 0.04), "the new rate to count")


def test_wrong_ports_positions_and_versions(running: Loop, server: ScriptedServer) -> None:
    assert "nobody listens there" in running.refused(free_port())
    assert "sensor 3 is not on the bus" in running.refused(server.port, sensor=3)
    server.description["protocol"] = 2
    assert "another version of the protocol" in running.refused(server.port)


def test_the_server_may_come_later(running: Loop) -> None:
    port = free_port()
    running.new(host="127.0.0.1", port=port, connect_timeout=60)
    running.begin("open")
    with ScriptedServer(port):
        assert running.answer()["ok"]
        running.do("stop")


def test_it_becomes_usable_with_the_first_sample(running: Loop, server: ScriptedServer) -> None:
    loop = running.opened(server.port)
    seen = loop.read()
    assert (seen["force.x"], seen["condition"], seen["age"]) == (None, SILENT, math.inf)
    assert "no usable sample within 0.02 s; silent" in loop.do("wait", 20)["why"]
    loop.begin("wait", PATIENCE_S * 1000)
    sequence = 1
    while not loop.has_answered():
        server.send(frame(sequence := sequence + 1))
    assert loop.answer()["ok"]
    assert loop.read()["force.x"] > 1


def test_stale_samples_and_a_lost_sensor(running: Loop, server: ScriptedServer) -> None:
    loop = running.opened(server.port, max_age=0.05, on_stale="hold", error_after=0.2)
    server.send(frame(1))
    loop.until(FRESH)
    begin = time.monotonic()
    stale = loop.until(SILENT)
    assert stale["force.x"] == 1
    wait_until(lambda: not loop.read()["good"], "the error")
    assert time.monotonic() - begin >= 0.2
    assert loop.read()["force.x"] is None
    server.send(
        event(Event.SENSOR_LOST, sensor=0, reason="cable", message="sensor 0 is lost"),
        frame(2, DataFlag.INVALID),
    )
    loop.until(LOST)
    server.send(frame(3))
    assert loop.until(FRESH)["force.x"] == 3


def test_settings_that_changed_are_checked(running: Loop, server: ScriptedServer) -> None:
    loop = running.opened(server.port)
    server.send(frame(1))
    loop.until(FRESH)
    server.send(event(Event.RECONFIGURED, sensor=1), frame(2))  # another one of the chain
    wait_until(lambda: loop.read()["force.x"] == 2, "the sample behind the event")
    assert loop.read()["condition"] == FRESH
    server.reconfigure(rate_hz=400)
    loop.logged("info: the sensor's settings were changed, and are accepted")
    loop.until(UNCHECKED)  # what came before may be of the settings before
    server.send(frame(3))
    assert loop.until(FRESH, lambda seen: seen["force.x"] is None)["force.x"] == 3
    # Counts instead of N are never passed on; they are refused until that is mended.
    server.reconfigure(calibration_matrix=False)
    server.send(frame(4))
    loop.until(UNCHECKED)
    loop.logged("error: 127.0.0.1 port")
    server.send(frame(5))
    assert loop.read()["force.x"] is None
    server.reconfigure()
    loop.logged("are accepted", times=2)
    server.send(frame(7))
    assert loop.until(FRESH, lambda seen: seen["force.x"] is None)["force.x"] == 7
    server.reconfigure(coordinate_system=True)
    loop.logged("has another coordinate_system than when configured")
    server.send(frame(8))
    loop.until(UNCHECKED)


def test_a_tare_in_any_pose_is_right_in_every_pose(running: Loop, server: ScriptedServer) -> None:
    """The sensor's offset becomes what makes it read the load of the tool, which is then subtracted."""
    loop = running.opened(server.port, bias="9,0,0,0,0,0", tool_mass=2, tool_center_of_gravity="0,0,0.1")
    loop.begin("tare")
    sequence = 0
    while not loop.has_answered():
        server.send(frame(sequence := sequence + 1, acceleration__y=0.5))
    assert loop.answer()["ok"]
    newest_ns = time.monotonic_ns()
    (asked,) = (message for message in server.requests if message["action"] == "tare")
    half = STANDARD_GRAVITY  # the weight of half of 2 kg
    assert asked["target"] == pytest.approx([0, -half, 0, 0.1 * half, 0, 0])
    loop.logged("info: tared to the load of the tool in this pose: right in every pose")
    load: dict[str, Any] = {"force.y": -half, "force.z": -half, "torque.x": 0.1 * half}
    wait_until(lambda: time.monotonic_ns() > newest_ns + 50_000_000, "a gap, in which it is turned")
    begin_ns = time.monotonic_ns() - 40_000_000
    for number in range(20):
        data = encode(61, {"acceleration.y": 0.5, "acceleration.z": 0.5, "force.x": 0.0, **load})
        server.send(encode_data(100_000 + number, 5, begin_ns + number * 1_250_000, 0, 0, 3, data))
    wait_until(lambda: loop.read()["sequence"] == 100_019, "the last sample")
    seen = loop.read()
    assert [seen[f"compensated.{name}"] for name in ("force.x", *load)] == pytest.approx([0] * 4, abs=1e-5)


def test_the_delay_of_the_force_is_that_of_the_description(running: Loop) -> None:
    """Two sample periods: the newest force is that of the acceleration two samples before, on a line."""
    delay_ms, offset = {"force_torque": 25.0, "acceleration": 5.0}, [1.0] * 6  # no bias goes with the offset
    with ScriptedServer(rate_hz=100, delay_ms=delay_ms, offset=offset) as server:
        loop = running.opened(server.port, tool_mass=1)
        begin_ns = time.monotonic_ns() - 50_000_000
        for number in range(1, 9):
            data = encode(61, {"acceleration.z": number, "force.x": number})
            server.send(encode_data(number, 5, begin_ns + number * 10_000_000, 0, 0, 3, data))
        wait_until(lambda: loop.read()["force.x"] == 8, "the last sample")
        assert loop.read()["compensated.force.z"] == pytest.approx(6 * STANDARD_GRAVITY)
        loop.do("stop")


def test_the_first_samples_while_the_sensor_turns(running: Loop, server: ScriptedServer) -> None:
    """How fast it spins up, and so the inertia of the tool, is not known yet."""
    loop = running.opened(server.port, "compensated", tool_mass=1, on_invalid="hold")
    begin_ns = time.monotonic_ns()
    for number, condition in (*((early, NOT_FINITE) for early in range(1, 5)), (5, FRESH)):
        data = encode(61, {"acceleration.z": 1.0, "angular_rate.x": 100.0, "force.x": number})
        server.send(encode_data(number, 5, begin_ns + number * 1_250_000, 0, 0, 3, data))
        seen = loop.until(condition)
    assert seen["force.x"] == 5
    assert seen["compensated.force.x"] == pytest.approx(5)


def test_a_tare_without_a_payload_and_one_that_is_refused(running: Loop, server: ScriptedServer) -> None:
    loop = running.opened(server.port)
    assert loop.do("tare")["ok"]
    loop.logged("info: tared to zero in this pose, the weight of a tool included")
    error = {"code": "not_ready", "message": "sensor 0 moves: hold it still"}
    server.answers["tare"] = lambda _: {"ok": False, "error": error}
    assert loop.do("tare") == {
        "ok": False,
        "why": "the sensor could not be tared: sensor 0 moves: hold it still",
    }


def test_another_sensor_in_its_place_is_refused(running: Loop) -> None:
    with ScriptedServer() as first:
        loop = running.opened(first.port, max_age=0.3)
        first.send(frame(1))
        loop.until(FRESH)
    with ScriptedServer(first.port, serial=8) as other:
        loop.logged(
            "sensor 0 is BFT-SENS-ECAT-M8, serial 8, and was BFT-SENS-ECAT-M8, serial 100, when configured"
        )
        other.send(frame(2))
        loop.until(UNCHECKED, lambda seen: seen["force.x"] is None)
    with ScriptedServer(first.port) as same:
        loop.logged("connected again")
        loop.until(SILENT)
        same.send(frame(2))
        assert loop.until(FRESH)["force.x"] == 2
        loop.do("stop")


def test_a_cycle_makes_no_system_call(running: Loop, server: ScriptedServer) -> None:
    """The kernel kills the program for any other system call, also while the connection is made anew."""
    loop = running.opened(server.port)
    server.send(frame(1))
    loop.begin("sealed", 300)
    server.reconfigure(rate_hz=400)
    assert loop.answer() == {"sealed": True, "good": 300}
    loop.logged("are accepted")


@pytest.mark.long
def test_the_two_threads_under_the_thread_sanitizer() -> None:
    """Real seconds: a server that comes and goes while a loop runs at 1 kHz."""
    loop = Loop(program(THREADS))
    with ScriptedServer() as first:
        port = first.port
        loop.opened(port)
        loop.begin("run", 8, 1000)
        end = time.monotonic() + 1
        while time.monotonic() < end:
            with contextlib.suppress(ConnectionError):  # the connection of before
                first.send(frame(int(time.monotonic() * 1e6)))
                first.reconfigure(rate_hz=400)
    for _ in range(20):
        with ScriptedServer(port) as again:
            wait_until(lambda: bool(again.streams), "the next connection")
            again.send(frame(int(time.monotonic() * 1e6)))
    told = loop.answer()
    assert (told["bad"], told["allocated"]) == (0, 0)
    assert told["conditions"].keys() >= {str(FRESH), str(UNCHECKED)}
    assert end_driver(loop.process) == 0

"""What replies say, decoded once for all programs: rows have the types that they promise."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, get_type_hints

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bota_ethercat.replies import Delays, Description, SensorInfo, SensorStatus, Status
from bota_ethercat.stream.timeline import Timeline
from ethercat_server.access.sensors import Sensors
from ethercat_server.doctor.bus_checks import watched
from ethercat_server.doctor.report import ok
from ethercat_server.ethercat.clock import SYSTEM_CLOCK
from tests.simulation import Simulation

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=6) | st.dictionaries(st.text(max_size=9), inner, max_size=4),
    max_leaves=12,
)


def rows_of(row: Any) -> st.SearchStrategy[Any]:
    return JSON | st.fixed_dictionaries({}, optional=dict.fromkeys((*get_type_hints(row), "delay_ms"), JSON))


@given(st.fixed_dictionaries({"sensors": st.lists(rows_of(SensorInfo), max_size=3) | JSON, "version": JSON}))
def test_a_description_has_the_types_that_it_promises(reply: dict[str, Any]) -> None:
    known = Description.parse(reply)
    assert len({info.sensor for info in known.sensors}) == len(known.sensors)
    for info in known.sensors:
        assert known.find(info.sensor) is info
        assert 0 <= info.sensor < 256
        assert 0 <= info.rate_hz <= 1e6
        assert all(len(each) <= 200 and each.isprintable() for each in (info.name, info.state, str(info)))
        assert info.serial is None or type(info.serial) is int
        assert info.offset is None or (len(info.offset) == 6 and all(map(math.isfinite, info.offset)))


@given(rows_of(Status), st.lists(rows_of(SensorStatus), max_size=3))
def test_a_status_has_the_types_that_it_promises(reply: Any, sensors: list[Any]) -> None:
    status = Status.parse({**reply, "sensors": sensors} if isinstance(reply, dict) else reply)
    assert status.cycles is None or type(status.cycles) is int
    for place, row in enumerate(status.sensors):
        assert row.sensor is not None
        assert {type(row.recoveries), type(row.lost_samples)} <= {int, type(None)}
        assert type(row.clock.mode) is str
        assert status.find(place).drift.wrench is None or len(status.find(place).drift.wrench or ()) == 6


def test_a_real_servers_replies_are_decoded_whole() -> None:
    simulation = Simulation(settings={"sinc_length": 64})
    simulation.run(3.0)
    status, said = Status.parse(simulation.status()), simulation.status()
    row = status.find(0)
    expected = said["cycles"], said["sensors"][0]["fresh"], "locked"
    assert (status.cycles, row.fresh, row.clock.mode) == expected
    assert None not in (*status.last_10s.wake_us, *status.recent_age_us(0), *row.age_us, status.uptime_s)


def test_what_a_message_does_not_say_stays_as_it_was() -> None:
    known = SensorInfo.parse(
        {"sensor": 1, "rate_hz": 800, "delay_ms": {"force_torque": 2}, "offset": [1.0] * 6}
    )
    assert known is not None
    assert known.delay_ns == Delays(2_000_000)
    assert known.changed_by({"sensor": 1, "rate_hz": math.inf, "delay_ms": 3, "settings": {"no": 1}}) == known
    assert known.changed_by({"offset": None}).offset is None


@pytest.mark.parametrize(
    "row", [{}, {"clock": 1, "recoveries": "x"}, {"age_us": [], "lost_samples": None}, 5, None]
)
def test_the_doctor_and_the_tool_survive_what_a_server_makes_up(row: Any) -> None:
    described = {"sensors": [{"sensor": 0, "offset": "x", "rate_hz": {}}, {"sensor": "0"}, 7]}
    replies = {"describe": described, "status": {"sensors": [row], "clients": [row], "last_10s": row}}
    client: Any = SimpleNamespace(
        description=described, ask=lambda action, *_, **__: replies[action], close=lambda: None,
        session=SimpleNamespace(same_machine=True, timeline=Timeline()),
    )  # fmt: skip
    sensors = Sensors(client, "a server", "a server")
    assert [found.number for found in sensors.sensors] == [0]
    sensors.clock = SYSTEM_CLOCK
    sensors.wait_settled([0])
    found = list(watched("server", "server", lambda: sensors, 0.0, lambda _: ok("")))
    assert found
    assert not [each for each in found if "Error" in each.found]

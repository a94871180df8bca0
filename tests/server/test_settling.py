"""For half a second after a sensor has entered OP its data settles: the stream does not wait, a tare does."""

from __future__ import annotations

import pytest

from ethercat_server.virtual_sensor.options import SensorOptions
from tests.server.bench import AT_REST, Bench, error


def settling(bench: Bench, sensor: int = 0) -> bool:
    """What `describe` and `status` say."""
    before, now = (
        bench.asking.ask(action)["sensors"][sensor]["settling"] for action in ("describe", "status")
    )
    assert isinstance(now, bool)
    assert before in (now, True), "it may have ended between the two questions"
    return now


def settles(bench: Bench, sensor: int = 0) -> float:
    """How long it goes on from now, s."""
    began_ns = bench.simulation.clock.now_ns
    while settling(bench, sensor):
        pass
    return (bench.simulation.clock.now_ns - began_ns) * 1e-9


def test_a_sensor_settles_after_each_entry_into_op() -> None:
    bench = Bench()
    assert 0.4 < settles(bench) < 0.51, "the server has started"
    bench.command("power cycle 0.2")
    bench.wait_event("sensor_lost")
    assert not settling(bench), "it gives no data"
    bench.wait_event("sensor_back")
    assert len(bench.client.fresh(20)) == 20
    assert 0.4 < settles(bench) < 0.51, "its samples came at once"
    assert bench.asking.ask("configure", settings={"fir": True})["ok"]
    assert 0.4 < settles(bench) < 0.51
    assert bench.asking.ask("configure", settings={"imu_active": 3})["ok"]
    assert not settling(bench), "it did not leave OP"
    bench.command("deaf 0.07")
    bench.wait_event("sensor_back")
    assert not settling(bench), "it did not leave OP either"


def test_one_of_a_chain_settles() -> None:
    bench = Bench(AT_REST, SensorOptions(signal="rest", serial=2))
    bench.simulation.run(0.6)
    bench.command("power cycle 0.2 @1")
    bench.client.wait_event("sensor_back", 1)
    assert (settling(bench, 0), settling(bench, 1)) == (False, True)


@pytest.mark.parametrize("change", ["start", "recovery", "configure"])
def test_a_tare_waits_for_settled_data(change: str) -> None:
    bench = Bench()
    if change != "start":
        bench.simulation.run(0.6)
    if change == "recovery":
        bench.command("power cycle 0.2")
        bench.wait_event("sensor_back")
    elif change == "configure":
        assert bench.asking.ask("configure", settings={"fir": True})["ok"]
    bench.command("limit force.z 5")  # it has not settled
    bench.simulation.at(0.3, "limit force.z off")
    tared = bench.asking.ask("tare", samples=50)
    assert tared["new_offset"][2] == pytest.approx(9.75)


def test_a_sensor_that_is_lost_while_a_tare_waits_for_it_is_not_tared() -> None:
    bench = Bench()
    bench.command("power cycle 0.2")
    refused = error(bench.asking.ask("tare", samples=50))
    assert (refused["code"], "is lost" in refused["message"]) == ("not_ready", True)
    assert not [row for row in bench.stats()["sdo_writes"] if row["index"] == "0x8000"]

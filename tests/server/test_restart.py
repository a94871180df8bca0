"""A server that is started again, in simulated time. As processes: see test_end_to_end.py."""

from __future__ import annotations

import pytest

from tests.server.bench import Bench


def test_the_next_one_finds_the_sensor_in_op_after_one_that_was_killed() -> None:
    killed = Bench()
    again = Bench(backend=killed.simulation.backend)
    assert len(again.client.fresh(100)) == 100
    assert again.asking.ask("describe")["sensors"][0]["state"] == "OP"


def test_a_tare_that_was_not_saved_outlives_the_server_and_then_a_power_cut(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO")
    bench = Bench()
    tared = bench.asking.ask("tare", samples=20, target=[5.0, 0, 0, 0, 0, 0])
    assert tared["ok"], tared
    caplog.clear()
    bench = bench.start_again()
    assert "sensor 0 has a tare in force (saved or not): Fx offset" in caplog.text
    bench.command("power cycle 0.3")
    bench.wait_event("sensor_back")
    held = bench.asking.ask("sdo_read", index=0x8000, subindex=1, type="f32")["value"]
    assert held == pytest.approx(tared["new_offset"][0])

"""The C++ client on a real server and a virtual sensor: every sample, fresh, and old ones never as new."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from itertools import pairwise

import pytest

from protocol.framing import DataFlag
from protocol.pdo import SampleDecoder
from tests.clients.cpp_programs import Driver, Reading, assert_no_faults, driver, needs_gxx, patient
from tests.server.commands import command
from tests.server.running import (
    Client,
    Server,
    Veth,
    free_port,
    needs_bus,
    server,
    virtual_sensor,
    wait_until,
)

pytestmark = [pytest.mark.bus, needs_bus, needs_gxx, patient]

PATIENT = {"max_age_ms": 60_000}
"""For what must not depend on how busy this machine is."""
STRICT_AGE = {"max_age_ms": 300}
SLOW = ("--set", "sinc_length=512")
"""100 Hz, for servers of their own: the rate does not matter to what happens to them."""


@pytest.fixture(scope="module", autouse=True)
def no_faults() -> Iterator[None]:
    yield
    assert_no_faults()


@pytest.fixture(scope="module")
def shared() -> Iterator[Server]:
    with server("virtual", "--virtual", "--signal poses") as running:
        yield running


def new_again(running: Driver, after: Reading) -> Reading:
    """The first fresh reading with a sample that was made after this one."""
    return running.until(
        lambda r: r["fresh"] and r["monotonic_ns"] > after["monotonic_ns"], "samples after the trouble"
    )


# -- trouble, with servers of their own: first, so that the shared one does not run meanwhile


def test_a_server_killed_and_started_again() -> None:
    port = free_port()
    first = Server("virtual", *SLOW, port=port).wait_streaming()
    with driver(port, **STRICT_AGE) as running:
        running.connect()
        before = running.until(lambda r: r["fresh"], "samples")
        first.signal(signal.SIGKILL)
        first.wait()
        gone = running.until(lambda r: r["condition"] == "disconnected", "the loss of the connection")
        assert gone["has_sample"]
        first.close()
        # As long as there is no server the last sample only grows older.
        for _ in range(20):
            reading = running.latest()
            assert not reading["is_new"]
            assert not reading["fresh"]
            assert reading["age_ns"] >= gone["age_ns"]
            assert reading["monotonic_ns"] == gone["monotonic_ns"]
        second = Server("virtual", *SLOW, port=port)
        try:
            back = new_again(running, before)
            assert back["connection"] == 2
            assert running.info()["link"] == "up"
            assert running.do("next", 1000)["is_new"]
        finally:
            second.close()


def test_a_client_that_did_not_read_is_told_what_it_missed() -> None:
    with (
        server("virtual", "--set", "sinc_length=32") as busy,
        driver(busy.port, **STRICT_AGE) as running,
        Client(busy.port) as witness,
    ):
        running.connect()
        start = running.do("next", 1000)

        def withheld() -> bool:
            time.sleep(0.2)
            return any(client["withheld"] > 500 for client in witness.ask("status")["clients"])

        wait_until(withheld, "the server to withhold samples", 60)
        total = {"withheld": 0, "passed_over": 0, "new": 0, "gap": False}

        def caught_up() -> bool:
            reading = running.latest()
            count(reading, total)
            return bool(reading["fresh"])

        wait_until(caught_up, "the newest sample")
        last = running.do("next", 1000)
        count(last, total)
        told = running.info()
        assert total["gap"]
        assert told["withheld"] == total["withheld"] > 500
        # Nothing is unaccounted for: what came and what did not come are all the server's frames.
        not_sent = told["withheld"] + told["skipped"]
        assert told["frames"] + not_sent == last["sequence"] - start["sequence"] + 1
        assert told["samples"] == total["new"] + total["passed_over"] + 1


def count(reading: Reading, total: dict[str, int | bool]) -> None:
    total["withheld"] += reading["withheld"]
    total["passed_over"] += reading["passed_over"]
    total["new"] += reading["is_new"]
    total["gap"] = total["gap"] or reading["gap"]


def test_a_stuck_sensor_and_a_cut_cable() -> None:
    with (
        virtual_sensor() as (veth, sensor),
        server(veth.near, *SLOW) as busy,
        driver(busy.port, **STRICT_AGE) as running,
    ):
        running.connect()
        running.until(lambda r: r["fresh"], "samples")
        command(sensor, "stick")
        stuck = running.until(lambda r: r["condition"] == "repeated", "repeated samples")
        assert stuck["flags"] & DataFlag.REPEATED
        assert not running.latest()["is_new"]
        command(sensor, "unstick")
        before = new_again(running, stuck)
        Veth.ip("link", "set", veth.near, "down")
        lost = running.until(lambda r: r["condition"] == "sensor_lost", "the loss of the sensor")
        assert lost["flags"] & DataFlag.INVALID
        assert not lost["fresh"]
        assert "sensor 0 is lost" in running.info()["error"]
        Veth.ip("link", "set", veth.near, "up")
        after = new_again(running, lost)
        assert after["connection"] == 1
        assert after["sequence"] > before["sequence"]


# -- a healthy server


def test_every_sample_in_order_and_the_same_as_in_python(shared: Server) -> None:
    with driver(shared.port, **PATIENT) as running, Client(shared.port) as client:
        running.connect()
        client.ask("subscribe")
        running.begin("collect", 400, 30_000)
        frames = {frame.sequence: frame for frame in client.collect(500)}
        readings = running.answer()
        assert len(readings) == 400
        decoder = SampleDecoder(61)
        compared = 0
        for reading in readings:
            assert not reading["withheld"], "nothing is missed by one who reads"
            assert reading["passed_over"] == 0
            frame = frames.get(reading["sequence"])
            if frame is None:
                continue
            compared += 1
            sample = decoder.decode(frame.process_data)
            assert reading["array"] == sample.array
            assert reading["temperature"] == sample.temperature
            assert (reading["stamp_ns"], reading["monotonic_ns"]) == (frame.stamp_ns, frame.monotonic_ns)
        assert compared >= 300
        for one, other in pairwise(readings):
            assert other["sequence"] == one["sequence"] + 1 or other["flags"] or not other["withheld"]
            assert other["sequence"] > one["sequence"]
            assert other["monotonic_ns"] > one["monotonic_ns"]
        told = running.info()
        assert (told["withheld"], told["passed_over"], told["allocated"]) == (0, 0, 0)
        assert told["names"] == ["BFT-SENS-ECAT-M8"]


def test_latest_in_a_loop_of_1_khz(shared: Server) -> None:
    with driver(shared.port, **STRICT_AGE) as running:
        running.connect()
        running.do("next", 1000)
        told = running.do("follow", 1500, 1000)
        after = running.info()
        # Every sample is either seen once as new, or counted as passed over; the age is never told too small.
        assert told["new"] + told["passed_over"] + 1 == after["samples"]
        assert (told["not_rising"], told["too_young"], after["allocated"]) == (0, 0, 0)
        # Where a stalled machine lost samples (GAP), REPEATED frames that were not sent count as withheld.
        assert not told["withheld"] or told["gaps"]
        assert told["fresh"] > 1200
        assert told["new"] > 600


def test_a_controller_slower_than_the_sensor_gets_the_newest(shared: Server) -> None:
    with driver(shared.port, **STRICT_AGE) as running:
        running.connect()
        running.do("next", 1000)
        told = running.do("follow", 20, 50)
        after = running.info()
        assert told["passed_over"] > told["new"]
        assert told["new"] + told["passed_over"] + 1 == after["samples"]
        assert told["not_rising"] == 0


def test_one_frame_in_ten(shared: Server) -> None:
    with driver(shared.port, every=10, **PATIENT) as running:
        running.connect()
        readings = running.do("collect", 20, 20_000)
        assert {later["sequence"] - one["sequence"] for one, later in pairwise(readings)} == {10}
        assert running.info()["withheld"] == 0


def test_a_server_that_is_stopped_and_goes_on(shared: Server) -> None:
    with driver(shared.port, **STRICT_AGE) as running:
        running.connect()
        before = running.until(lambda r: r["fresh"], "samples")
        shared.signal(signal.SIGSTOP)
        try:
            silent = running.until(lambda r: r["condition"] == "silent", "silence")
            assert not silent["fresh"]
            assert silent["age_ns"] > STRICT_AGE["max_age_ms"] * 1e6
            waited = running.do("next", 50)
            assert (waited["is_new"], waited["fresh"]) == (False, False)
        finally:
            shared.signal(signal.SIGCONT)
        after = new_again(running, silent)
        assert after["connection"] == 1, "a stopped server is not gone: its connection is kept"
        assert after["monotonic_ns"] > before["monotonic_ns"]


# -- requests


def test_describe_status_tare_and_refusals(shared: Server) -> None:
    with driver(shared.port) as running, Client(shared.port) as client:
        described = running.do("describe")
        wanted = client.ask("describe")
        keys = ("sensor", "serial", "pdo_size", "rate_hz", "name", "hardware", "firmware", "state")
        assert described["sensors"] == [{key: sensor[key] for key in keys} for sensor in wanted["sensors"]]
        assert (described["ok"], described["version"]) == (True, wanted["version"])
        status = running.do("status")
        assert status["ok"]
        assert status["cycles"] > 0
        assert status["sensors"][0]["fresh"] > 0
        tared: Reading = {}

        def at_rest() -> bool:  # the virtual sensor is moved from pose to pose, and refuses meanwhile
            tared.update(running.do("tare", 200, 1.5, -2, 0, 0.25, 0, 0))
            assert tared["ok"] or (tared["code"] == "not_ready" and "not at rest" in tared["error"])
            return bool(tared["ok"])

        wait_until(at_rest, "a tare at rest")
        assert tared["done"]
        entry = client.ask("sdo_read", index="0x8000", subindex=2, type="f32")
        assert entry["value"] == pytest.approx(tared["new_offset"][1], rel=1e-6)  # it keeps float32
        assert all(value > 0 for value in tared["deviation"])
        read = running.do(
            "ask", '{"action":"sdo_read","index":"0x8010","subindex":1,"type":"u8","id":[1,"é"]}'
        )
        assert (read["ok"], read["reply"]["value"], read["reply"]["id"]) == (True, 1, [1, "é"])
        refused = running.do("ask", '{"action":"sdo_read","index":"0x1234"}')
        assert (refused["ok"], refused["code"], refused["abort_code"]) == (False, "sensor", 0x06020000)
        refused = running.do("ask", '{"action":"dance"}')
        assert (refused["code"], "no action 'dance'" in refused["error"]) == ("unknown_action", True)
        refused = running.do("ask", "{nonsense")
        assert "no JSON object" in refused["error"]


def test_a_sensor_that_there_is_not(shared: Server) -> None:
    with driver(shared.port, sensor=9, reconnect=0) as running:
        told = running.do("connect", 5000)
        assert not told["ok"]
        assert "9" in told["error"]
        assert "refused" in told["error"]


def test_requests_without_a_server() -> None:
    with driver(free_port()) as running:
        for what in ("describe", "status", "tare 10"):
            told = running.do(what)
            assert not told["ok"]
            assert "nobody listens there" in told["error"]

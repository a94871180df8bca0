"""The C++ client on the whole server and a virtual sensor: every sample, fresh, old ones never as new."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from bota_ethercat.address import Address
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.clients.cpp_programs import Reading, assert_no_faults, driver, needs_gxx, patient
from tests.served_simulation import ServedSimulation, served
from tests.server.running import free_port, wait_until

pytestmark = [needs_gxx, patient]

PATIENT = {"max_age_ms": 60_000}
"""For what must not depend on how busy this machine is."""


@pytest.fixture(scope="module", autouse=True)
def no_faults() -> Iterator[None]:
    yield
    assert_no_faults()


@pytest.fixture(scope="module")
def shared() -> Iterator[ServedSimulation]:
    with served(SensorOptions(signal="rest"), sinc_length=256) as running:
        yield running


# -- trouble, with servers of their own


def test_a_client_that_did_not_read_is_told_what_it_missed() -> None:
    with (
        served(sinc_length=32) as busy,
        driver(busy.port, receive_buffer=4096, **PATIENT) as running,
        busy.client() as witness,
    ):
        running.connect()
        start = running.do("next", 60_000)
        wait_until(
            lambda: any(client["withheld"] > 100 for client in witness.ask("status")["clients"]),
            "the server to withhold samples",
            60,
        )
        total: dict[str, int | bool] = {"withheld": 0, "passed_over": 0, "new": 0, "gap": False}

        def caught_up() -> bool:
            reading = running.latest()
            count(reading, total)
            return bool(reading["gap"])

        wait_until(caught_up, "the first sample after those")
        last = running.do("next", 60_000)
        count(last, total)
        told = running.info()
        assert told["withheld"] == total["withheld"] > 100
        # Nothing is unaccounted for: what came and what did not come are all the server's frames.
        not_sent = told["withheld"] + told["skipped"]
        assert told["frames"] + not_sent == last["sequence"] - start["sequence"] + 1
        assert told["samples"] == total["new"] + total["passed_over"] + 1


def count(reading: Reading, total: dict[str, int | bool]) -> None:
    total["withheld"] += reading["withheld"]
    total["passed_over"] += reading["passed_over"]
    total["new"] += reading["is_new"]
    total["gap"] = total["gap"] or reading["gap"]


# -- a healthy server


# -- requests


def test_describe_tare_and_refusals(shared: ServedSimulation) -> None:
    with driver(shared.port) as running, shared.client() as client:
        described = running.do("describe")
        wanted = client.ask("describe")
        keys = ("sensor", "serial", "pdo_size", "rate_hz", "name", "hardware", "firmware", "state")
        assert described["sensors"] == [{key: sensor[key] for key in keys} for sensor in wanted["sensors"]]
        assert (described["ok"], described["version"]) == (True, wanted["version"])
        for channel in ("force", "torque"):
            for axis in "xyz":
                shared.command(f"noise {channel}.{axis} 0.001")
        tared = running.do("tare", 20, 1.5, -2, 0, 0.25, 0, 0)
        assert tared["ok"], tared
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


def test_requests_without_a_server() -> None:
    with driver(free_port()) as running:
        for what in ("describe", "tare 10"):
            told = running.do(what)
            assert not told["ok"]
            assert "nobody listens there" in told["error"]


def test_a_server_is_named_as_in_the_other_programs() -> None:
    texts = (
        "robot", "robot:14101", "14101", ":14101", "[::1]", "[::1]:14101", "::1", "robot:", "robot:0", "0",
        "robot:65535", "robot:65536", "robot:+1", "robot:1x", ":",
    )  # fmt: skip
    with driver(1) as running:
        assert running.do("server") == [True, "localhost", 12001], "$BOTA_SERVER of the tests"
        for text in texts:
            try:
                wanted = [True, *Address.parse(text)]
            except ValueError:
                wanted = [False, "localhost", 12001]
            assert running.do("server", text) == wanted, text

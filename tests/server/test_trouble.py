"""Bad input and trouble at start: one sentence on stderr, a non-zero exit, nothing left behind."""

from __future__ import annotations

import ctypes
import os
import re
import socket
import subprocess
import sys
import time

import pytest

from tests.server.commands import command
from tests.server.running import Server, Veth, free_port, needs_bus, server, virtual_sensor

pytestmark = [pytest.mark.bus, needs_bus]


def interfaces() -> set[str]:
    return {name for _, name in socket.if_nameindex() if name.startswith("ecat")}


def fails(ifname: str, *arguments: str, name: str | None = None, code: int = 1) -> str:
    """Run a server that cannot start; returns the sentence it said."""
    running = Server(ifname, *arguments, name=name)
    try:
        assert running.wait() == code, running.said()
        said = [line for line in running.said().splitlines() if not line.startswith("ready")]
        assert "Traceback" not in running.said()
        assert said, "it said nothing"
        assert said[-1].startswith("ethercat-server: ")
        assert not [n for n in interfaces() if n == running.ifname]
        with socket.socket() as sock:
            assert sock.connect_ex(("127.0.0.1", running.port)) != 0
        return said[-1]
    finally:
        running.close()


def test_no_such_interface() -> None:
    assert re.search("no network interface 'nope0'.*there are", fails("nope0"))


def test_interface_name_too_long_for_soem() -> None:
    assert "1 to 15 characters" in fails("a-name-that-is-too-long")


def test_loopback_is_refused() -> None:
    assert "loopback" in fails("lo")


def test_interface_down_and_no_carrier() -> None:
    with Veth() as veth:
        veth.ip("link", "set", veth.near, "down")
        assert f"{veth.near} is down: bring it up" in fails(veth.near)
        veth.ip("link", "set", veth.far, "down")
        veth.ip("link", "set", veth.near, "up")
        assert f"{veth.near} has no carrier: check the cable" in fails(veth.near)


def test_no_slave_answers() -> None:
    with Veth() as veth:
        assert "no EtherCAT slave answers" in fails(veth.near)


def test_not_allowed_names_the_capabilities() -> None:
    # Drops the capabilities from the bounding set, so that the new program has none, even as root.
    pr_capbset_drop = 24

    def drop() -> None:
        libc = ctypes.CDLL(None)
        for capability in (12, 13):
            libc.prctl(pr_capbset_drop, capability, 0, 0, 0)

    with Veth() as veth:
        done = subprocess.run(
            [sys.executable, "-m", "ethercat_server.daemon.cli", veth.near, str(free_port())],
            preexec_fn=drop, capture_output=True, text=True, check=False, timeout=60,
        )  # fmt: skip
    assert done.returncode == 1
    assert "CAP_NET_ADMIN and CAP_NET_RAW missing" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_virtual_bus_without_rights_is_a_sentence() -> None:
    done = subprocess.run(
        ["setpriv", "--bounding-set", "-net_admin,-net_raw",
         sys.executable, "-m", "ethercat_server.daemon.cli", "virtual", str(free_port())],
        capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert done.returncode == 1
    first, last = done.stderr.splitlines()
    assert first.startswith("ethercat-virtual-sensor: cannot create a veth pair: ")
    assert last.endswith("it needs root, or CAP_NET_ADMIN and CAP_NET_RAW")


def test_another_model_is_refused_by_name() -> None:
    with virtual_sensor("--model", "BFT-GENA-THING") as (veth, _):
        assert "'BFT-GENA-THING', a model this server does not know" in fails(veth.near)


@pytest.mark.parametrize(
    ("way", "arguments", "complaint"),
    [
        (
            "vendor",
            (),
            "position 0 of .* is 'BFT-SENS-ECAT-M8' .vendor 0x0000DEAD, .* not a Bota",
        ),
        ("latin foreign", (), "position 0 of .* is 'nameless' .vendor 0x0000DEAD"),
        ("product", (), "vendor 0x0000B07A, product 0x00000007"),
        (
            "size",
            ("--pdo", "65"),
            "sensor 0 .BFT-SENS.* maps process data of 65 bytes: .* 61 or 77",
        ),
        ("rate", (), "samples at 500 Hz, but sinc_length 64 implies 800 Hz"),
    ],
)
def test_a_slave_that_is_wrong_in_one_way(way: str, arguments: tuple[str, ...], complaint: str) -> None:
    with virtual_sensor(*arguments, module="tests.server.odd_sensor", first=(way,)) as (veth, sensor):
        assert re.search(complaint, fails(veth.near))
        assert sensor.process.stdin is not None
        sensor.process.stdin.write("stats\n")
        sensor.process.stdin.flush()
        sensor.wait_for('"INIT"')


def test_a_name_in_the_eeprom_that_is_no_utf_8() -> None:
    with (
        virtual_sensor(module="tests.server.odd_sensor", first=("latin",)) as (veth, _),
        server(veth.near) as running,
        running.connect() as client,
    ):
        assert client.ask("describe")["sensors"][0]["name"] == "BFT-SENS-ECAT-M8"


def test_a_slave_without_a_coe_mailbox() -> None:
    with virtual_sensor(module="tests.server.odd_sensor", first=("mailbox",)) as (veth, _):
        assert re.search(
            "sensor 0 on .* has no CoE mailbox, and so no objects to set it up by", fails(veth.near)
        )


@pytest.mark.parametrize("how", ["error", "busy"])
def test_an_eeprom_that_cannot_be_read(how: str) -> None:
    with virtual_sensor() as (veth, sensor):
        command(sensor, f"sii {how}")
        said = fails(veth.near)
        assert re.search(r"the SII .EEPROM. of the slave at position 0 of .* cannot be read", said)
        command(sensor, "sii ok")
        running = Server(veth.near)
        try:
            running.wait_streaming()
        finally:
            running.close()


def test_name_on_the_command_line_must_be_the_sensors() -> None:
    with virtual_sensor("--model", "BFT-ROKS-ECAT-M8") as (veth, _):
        said = fails(veth.near, name="BFT-SENS-ECAT-M8")
        assert "is a BFT-ROKS-ECAT-M8, not a BFT-SENS-ECAT-M8" in said
        running = Server(veth.near, name="BFT-ROKS-ECAT-M8")
        try:
            running.wait_streaming()
        finally:
            running.close()


def test_port_taken() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        done = subprocess.run(
            [sys.executable, "-m", "ethercat_server.daemon.cli", "virtual", str(port)],
            capture_output=True, text=True, check=False, timeout=60,
        )  # fmt: skip
        assert done.returncode == 1
        assert f"port {port} on 127.0.0.1 is in use by another program" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--set", "colour=1"), "no setting 'colour'"),
        (("--config", "/nonexistent.toml"), "cannot read the configuration"),
        (("--virtual", "--sensors 0"), "the virtual sensor did not start"),
    ],
)
def test_wrong_arguments(arguments: tuple[str, ...], complaint: str) -> None:
    code = 1 if "--virtual" in arguments else 2
    assert complaint in fails("virtual", *arguments, code=code)


def test_settings_for_a_sensor_that_is_not_switched_on_yet(tmp_path_factory: pytest.TempPathFactory) -> None:
    config = tmp_path_factory.mktemp("config") / "c.toml"
    config.write_text("[sensor.1]\nfir = true\n")
    with virtual_sensor("--sensors", "2") as (veth, sensor):
        command(sensor, "power off @1")
        said = fails(veth.near, "--config", str(config), code=1)  # with 2 the service would stay as it is
        assert "settings for sensor 1, but the bus has only 0: BFT-SENS-ECAT-M8" in said
        assert said.endswith("connect that sensor, or correct the name of the table")
        command(sensor, "power on @1")
        running = Server(veth.near, "--config", str(config))
        try:
            running.wait_streaming()
        finally:
            running.close()


def test_tables_that_contradict_one_another(tmp_path_factory: pytest.TempPathFactory) -> None:
    config = tmp_path_factory.mktemp("config") / "c.toml"
    config.write_text(
        "[sensor]\nfir = true\n[sensor.BFT-SENS-ECAT-M8]\nfir = false\n[sensor.0]\nfast = true\n"
    )
    assert "are inconsistent: fast is true but fir is false" in fails(
        "virtual", "--config", str(config), code=2
    )


def test_an_object_that_aborts_is_named() -> None:
    with virtual_sensor() as (veth, sensor):
        assert sensor.process.stdin is not None
        sensor.process.stdin.write("abort 0x8006 1 0x06090030\n")
        sensor.process.stdin.flush()
        sensor.wait_for("ok")
        said = fails(veth.near, "--set", "sinc_length=128")
        assert "sinc_length = 128 did not take" in said
        assert "0x06090030" in said


def test_stopped_while_starting() -> None:
    for _ in range(3):
        running = Server("virtual")
        try:
            # Wherever it is by then: signal handlers, virtual bus, bus scan, settings.
            time.sleep(0.4 + 0.3 * (os.getpid() % 3))
            running.signal(15)
            assert running.wait() in {0, -15}
            assert "Traceback" not in running.said()
            assert running.ifname not in interfaces()
        finally:
            running.close()


@pytest.mark.parametrize("way", ["below PREOP", "below SAFEOP", "below OP"])
def test_stopped_while_a_sensor_does_not_change_its_state(way: str) -> None:
    with virtual_sensor(module="tests.server.odd_sensor", first=(way,)) as (veth, sensor):
        running = Server(veth.near)
        try:
            sensor.wait_for("ignored")
            running.signal(15)
            assert running.wait() == 0, "it does not wait until the sensor has had its time and is blamed"
            assert running.said().endswith("stopped during start-up\n")
        finally:
            running.close()


def test_a_slave_that_vanishes_during_the_scan_does_not_hang_the_server() -> None:
    with virtual_sensor() as (veth, sensor):
        running = Server(veth.near)
        try:
            assert sensor.process.stdin is not None
            # Deaf as soon as the scan has begun, which reads the SII for some tens of milliseconds.
            sensor.process.stdin.write("deaf-after 40\n")
            sensor.process.stdin.flush()
            sensor.wait_for("ok")
            assert running.wait() == 1
            assert "Traceback" not in running.said()
            # SOEM would try on for two minutes.
            assert re.search("the scan of .* does not end: a slave stopped answering", running.said())
        finally:
            running.close()

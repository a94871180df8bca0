"""Real interfaces: which carry no frames, which belong to the network, who has one, and its raw socket.

What the kernel says of one, and whose lock it is, only the kernel knows.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import itertools
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from bota_ethercat.program.signals import Signals
from ethercat_server.access.adapters import Adapter, adapters
from ethercat_server.daemon.options import parse_options
from ethercat_server.daemon.server import serve
from ethercat_server.errors import InterfaceError
from ethercat_server.ethercat import nic
from ethercat_server.ethercat.clock import SYSTEM_CLOCK
from ethercat_server.ethercat.nic import Routes, claimed, look_up, network_trouble, why_silent
from ethercat_server.ethercat.soem import SoemBackend, packet_sockets
from tests import rights
from tests.doctor.running import doctor_here
from tests.ended import completed
from tests.rights import NOBODY, as_user, needs_another_user
from tests.server.running import (
    Veth,
    VirtualSensor,
    another_machine,
    needs_bus,
    steady_addresses,
    wait_until,
)
from tests.tool.running import tool_here

pytestmark = [pytest.mark.bus, needs_bus]
CLAIM = """
import sys
from ethercat_server.ethercat.nic import claimed
with claimed(sys.argv[1]):
    print("claimed", flush=True)
    sys.stdin.read()
"""


@pytest.fixture(scope="module")
def veth() -> Iterator[Veth]:
    with Veth() as found:
        yield found


@pytest.fixture
def directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """In place of the one in /run."""
    found = tmp_path / "ethercat-server"
    monkeypatch.setattr(nic, "DIRECTORY", found)
    return found


def listed(veth: Veth) -> Adapter:
    """What tool and doctor know of the interface."""
    (found,) = [each for each in adapters() if each.name == veth.near]
    return found


def refusal(ifname: str) -> str:
    with pytest.raises(InterfaceError) as refused, claimed(ifname):
        pass
    return str(refused.value)


# -- an interface that cannot carry frames


def test_a_small_mtu_is_named_with_its_remedy(veth: Veth) -> None:
    veth.ip("link", "set", veth.near, "mtu", "1400")
    try:
        assert why_silent(veth.near) == refusal(veth.near)
        assert refusal(veth.near).endswith(f"'sudo ip link set {veth.near} mtu 1500'")
    finally:
        veth.ip("link", "set", veth.near, "mtu", "1500")
    assert why_silent(veth.near) == "check cable and power"


def test_a_part_of_a_bridge_is_refused_and_the_bridge_is_named(veth: Veth) -> None:
    bridge = f"br{os.getpid()}"
    veth.ip("link", "add", bridge, "type", "bridge")
    try:
        veth.ip("link", "set", veth.near, "master", bridge)
        assert f"{veth.near} is part of {bridge} (a bridge or bond)" in refusal(veth.near)
        assert bridge in why_silent(veth.near)
        assert listed(veth).master == bridge
    finally:
        veth.ip("link", "del", bridge)
    with claimed(veth.near):
        pass


def test_an_interface_that_is_down_or_gone_is_why_nothing_comes_back(veth: Veth) -> None:
    veth.ip("link", "set", veth.far, "down")
    assert "has no carrier" in why_silent(veth.near)
    assert (listed(veth).up, listed(veth).carrier) == (True, False)
    veth.ip("link", "set", veth.near, "down")
    assert f"{veth.near} is down: bring it up" in why_silent(veth.near)
    assert not listed(veth).up
    veth.ip("link", "set", veth.near, "up")
    veth.ip("link", "set", veth.far, "up")
    wait_until(lambda: look_up(veth.near).carrier, "the carrier")
    assert "no network interface 'nothing0'" in why_silent("nothing0")
    assert why_silent("virtaul").endswith("; did you mean 'virtual'?")


def test_tool_and_doctor_take_every_name(veth: Veth) -> None:
    for other in ("short0", "a-name-that-is-longer-than-fifteen"):
        veth.ip("link", "property", "add", "dev", veth.near, "altname", other)
        with another(other):
            assert refusal(veth.near).startswith(f"{veth.near} is in use by")
            assert f"{other} is in use by" in tool_here("eeprom", other, code=1).err
        found = doctor_here(other, "--seconds", 0, "--json")
        assert found.json["interface"] == veth.near
        assert found.findings("interface")["link"]["found"] == "up, with carrier (veth)"
        assert "no EtherCAT slave answers" in found.findings("bus")["slaves"]["found"]


DROPS = "a bridge, which drops EtherCAT frames because their source address is a group's"
SEES = nic.Interface("near0", 5)
OTHERS = {5: SEES, 7: nic.Interface("br0", 7, kind="bridge"), 8: nic.Interface("far0", 8, master_index=7)}


@pytest.mark.parametrize(
    ("found", "why"),
    [
        ({}, "check cable and power"),
        (
            {"kind": "bridge", "up": False},
            f"near0 is {DROPS}: name the interface that the sensor is connected to",
        ),
        (
            {"up": False, "master_index": 7},
            "near0 is down: bring it up with 'sudo ip link set near0 up'",
        ),
        (
            {"master_index": 7, "mtu": 1499},
            "near0 is part of br0 (a bridge or bond), which takes its frames: remove it with "
            "'sudo ip link set near0 nomaster', or use another interface",
        ),
        (
            {"mtu": 1499, "carrier": False},
            "near0 has an MTU of 1499 bytes, too few for EtherCAT: 'sudo ip link set near0 mtu 1500'",
        ),
        (
            {"carrier": False, "xdp": ("xdpdrv",)},
            "near0 has no carrier: check the cable, the PoE injector and its power supply",
        ),
        ({"link": 5, "kind": "veth"}, "check cable and power"),
        (
            {"link": 8, "kind": "veth", "xdp": ("xdpdrv",)},
            f"near0 is connected to br0, {DROPS}: connect the sensor to near0 itself, or "
            "'sudo ip link set far0 nomaster'",
        ),
        (
            {"link": 7, "kind": "macvlan"},
            f"near0 is connected to br0, {DROPS}: connect the sensor to near0 itself",
        ),
        (
            {"xdp": ("xdpgeneric", "xdpoffload")},
            "near0 has an XDP program, which may drop its frames and stays when the program that loaded it "
            "has ended: 'sudo ip link set dev near0 xdpgeneric off'",
        ),
    ],
)
def test_what_stops_frames_is_told_by_its_worst_alone(
    found: dict[str, object], why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = OTHERS | {5: replace(SEES, **found)}  # type: ignore[arg-type]
    monkeypatch.setattr(nic, "look_up", lambda which: known[which])
    monkeypatch.setattr(nic, "_look_up", lambda which, _: known[which])
    monkeypatch.setattr(nic, "_link_mbits", lambda _: 100)
    assert why_silent(5) == why


def test_who_gets_a_copy_of_the_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """All sockets for all protocols, on it or on all interfaces; of some the process is not visible."""
    rows = [(3, 5, 1), (3, 0, 2), (3, 6, 3), (0x88A4, 5, 4), (3, 0, 5), (3, 5, 6), (3, 0, 7)]
    one, two, none = (
        nic.Process(pid, "x", sockets) for pid, sockets in ((10, {1, 2, 3}), (11, {2, 4, 5}), (12, {3}))
    )
    monkeypatch.setattr(nic, "packet_sockets", lambda: [nic.Listener(*row) for row in rows])
    monkeypatch.setattr(
        nic, "users_of", lambda inodes: (each for each in (one, two, none) if each.sockets & inodes)
    )
    assert [*nic.receivers(5)] == [(one, True), (two, False), (None, True)]
    del rows[-2]
    assert [*nic.receivers(5)][2:] == [(None, False)]
    rows[:] = rows[2:4]
    assert [*nic.receivers(5)] == []


# -- what is in between


@contextlib.contextmanager
def bridged(there: Sequence[str], veth: Veth) -> Iterator[str]:
    """A bridge where the far end of `veth` is, with a virtual sensor on another of its ports."""
    name = f"br{os.getpid()}"
    port, sensor = f"p{name}", f"s{name}"
    for command in (
        f"link add {name} type bridge", f"link add {port} type veth peer name {sensor}",
        f"link set {port} master {name}", f"link set {veth.far} master {name}",
        *(f"link set {each} up" for each in (name, port, sensor, veth.far)),
    ):  # fmt: skip
        subprocess.run([*there, "ip", *command.split()], check=True)
    program = VirtualSensor("ethercat_server.virtual_sensor.cli", [sensor], under=there)
    try:
        program.wait_for("ready")
        yield name
    finally:
        program.close()
        for each in (port, name):
            subprocess.run([*there, "ip", "link", "del", each], check=True)


@pytest.mark.parametrize("elsewhere", ["", "there", "there, with the same number"])
def test_a_bridge_on_the_way_is_why_no_slave_answers(elsewhere: str) -> None:
    """The kernel drops the frames; where the bridge is in another network namespace, too."""
    with contextlib.ExitStack() as stack:
        veth = stack.enter_context(Veth())
        there = stack.enter_context(another_machine(veth)) if elsewhere else []
        if "same" in elsewhere:
            veth.ip("link", "del", veth.near)
            number, other = ["index", "777"], ["netns", there[1].split("/")[2]]
            pair = [*number, "type", "veth", "peer", "name", veth.far, *number, *other]
            veth.ip("link", "add", veth.near, "up", *pair)
            subprocess.run([*there, "ip", "link", "set", veth.far, "up"], check=True)
            wait_until(lambda: look_up(veth.near).carrier, "the carrier")
        assert why_silent(veth.near) == "check cable and power"
        bridge = stack.enter_context(bridged(there, veth))
        why = f"{veth.near} is connected to {bridge}, a bridge, which drops EtherCAT frames"
        wait_until(lambda: look_up(veth.near).carrier, "the carrier")
        assert (
            f"no EtherCAT slave answers on {veth.near}: {why}" in tool_here("eeprom", veth.near, code=1).err
        )
        ended = doctor_here(veth.near, "--seconds", 0, "--json")
        found, member = ended.findings("bus")["slaves"], ended.findings("other software")["membership"]
        assert found["found"] == "no EtherCAT slave answers"
        assert found["why"].startswith(why)
        assert (member["level"], f"{member['found']}: {member['why']}") == ("bad", found["why"])
        if not elsewhere:
            assert found["why"].endswith(f", or 'sudo ip link set {veth.far} nomaster'")
            assert f"{bridge} is a bridge, which drops EtherCAT frames" in refusal(bridge)
            veth.ip("link", "add", "link", bridge, "name", f"m{bridge}", "up", "type", "macvlan")
            assert f"m{bridge} is connected to {bridge}, a bridge" in why_silent(f"m{bridge}")


def test_a_link_that_is_too_fast_for_a_slave_ends_in_a_switch(
    veth: Veth, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a card: a pair of interfaces has a speed that means nothing."""
    card = replace(look_up(veth.near), kind="", link=0)
    assert (mbits := nic._link_mbits(veth.near)) > 100, "as the driver of a pair says"
    monkeypatch.setattr(nic, "look_up", lambda _: card)
    assert f"{veth.near} is linked at {mbits} Mbit/s" in why_silent(veth.near)
    monkeypatch.setattr(nic, "_link_mbits", lambda _: 100)
    assert why_silent(veth.near) == "check cable and power"


# -- an interface of the machine's network

ROUTED = """
set -e
for end in near other; do
    ip link add ${end}0 type veth peer name ${end}1
    ip link set ${end}1 up
    ip link set ${end}0 up
done
ip address add 192.0.2.7/24 dev near0
ip address add 198.51.100.7/24 dev other0
ip address add 2001:db8::7/64 dev near0 nodad
ip address add 2001:db8:1::7/64 dev other0 nodad
eval "$1"
shift
exec "$@"
"""
"""In a network namespace, where a route to elsewhere hurts nobody."""
LOOK = """
import contextlib
import os
import sys
from ethercat_server.access.adapters import adapters
from ethercat_server.doctor.machine import Host
from ethercat_server.doctor.machine_checks import CHECKS
from ethercat_server.errors import InterfaceError
from ethercat_server.ethercat.nic import claimed
from ethercat_server.virtual_sensor.cli import main
try:
    with claimed("near0"):
        print("allowed")
except InterfaceError as error:
    print(error)
with claimed("near0", allow_ip=True):
    print(*(row.unfit for row in adapters() if row.name == "near0"))
look = CHECKS["other software", "addresses"]
refused, allowed = (look(Host("near0", allow_ip=yes)) for yes in (False, True))
print(refused.level.name, refused.found, *refused.commands, *allowed.commands)
with contextlib.redirect_stderr(sys.stdout):
    print(main(["near0", "--exit-on-eof", "--control", f"/tmp/control-{os.getpid()}"]))
"""

SEEN = """
import dataclasses
import json
import subprocess
from ethercat_server.ethercat.nic import IFF_PROMISC, change_flags, find_routes, interfaces, look_up

def ip(*words):
    return json.loads(subprocess.run(["ip", "-json", *words], check=True, stdout=-1).stdout)

other = subprocess.Popen(["unshare", "--net", "bash", "-c", "echo; read"], stdin=-1, stdout=-1)
other.stdout.readline()
commands = '''link set lo up; link add near0 type veth peer far0
link add away0 mtu 1400 type veth peer hidden0 netns PID; link add bridge0 type bridge
link set far0 master bridge0; link add idle0 type veth peer idle1
link property add dev idle0 altname so-long-that-it-is-no-name
link add link near0 name upper0 type macvlan; link set near0 up; link set far0 up; link set upper0 up
address add 192.0.2.9/30 dev near0; address add fe80::9/64 dev near0 nodad
address add fe80::1/64 dev near0 nodad; address add 2001:db8::7/64 dev near0 nodad
address add 192.0.2.5/30 dev near0 valid_lft 600 preferred_lft 600
address add 198.51.100.1 peer 198.51.100.9/32 dev upper0; route add 10.1.0.0/16 dev near0
route add 10.2.0.0/16 via 192.0.2.10; route add 10.3.0.0/16 dev upper0 table 9
route add 10.4.0.0/16 dev far0; route add local 10.5.0.0/16 dev near0
-6 route add fd01::/16 via fe80::5 dev near0
route add 10.6.0.0/16 nexthop via 198.51.100.9 dev upper0 nexthop dev near0'''
for line in commands.replace("PID", str(other.pid)).replace("\\n", "; ").split("; "):
    subprocess.run(["ip", *line.split()], check=True)
made = [{**dataclasses.asdict(row), **find_routes(row.ifindex)._asdict()} for row in interfaces()]
table = [row for family in ("-4", "-6") for row in ip(family, "route", "show", "table", "all")]
print(json.dumps([made, ip("-details", "link"), ip("address"), table], default=lambda each: each.hex()))
index = look_up("so-long-that-it-is-no-name").ifindex
steps = [{way: IFF_PROMISC} for way in ("on", "on", "off", "off")]
print(json.dumps([(change_flags(index, **step), ip("link", "show", "idle0")[0]["flags"]) for step in steps]))
other.communicate()
"""


def test_what_is_seen_of_interfaces_is_what_ip_shows() -> None:
    """Of a bridge, a VLAN and pairs of which one end is elsewhere; of addresses and routes of every kind."""
    looked = completed("unshare", "--net", sys.executable, "-c", SEEN)
    assert looked.returncode == 0, looked.stderr
    whole, flags = looked.stdout.splitlines()
    made, links, addresses, table = json.loads(whole)
    index = {row["ifname"]: row["ifindex"] for row in links}
    own = {row["ifname"]: row["addr_info"] for row in addresses}
    assert [row["name"] for row in made] == [row["ifname"] for row in links]
    for row, link in zip(made, links, strict=True):
        name, has = link["ifname"], link["flags"]
        its = own[name]
        text = {id(each): f"{each['local']}/{each['prefixlen']}" for each in its}
        local = [text[id(each)] for each in its if each["scope"] == "link"]
        carried = {name, "upper0"} if name == "near0" else {name}
        routes = {
            each["dst"] + ("/128" if ":" in each["dst"] and "/" not in each["dst"] else ""): "gateway" in hop
            for each in table
            for hop in each.get("nexthops", [each])
            if {**each, **hop}.get("dev") in carried
            and each.get("type", "unicast") == "unicast"
            and each.get("protocol") != "kernel"
        }
        assert row == {
            "name": name, "ifindex": link["ifindex"], "up": "UP" in has, "loopback": "LOOPBACK" in has,
            "carrier": "LOWER_UP" in has and link["operstate"] in ("UP", "UNKNOWN"), "mtu": link["mtu"],
            "master_index": index.get(link.get("master"), 0), "address": link["address"].replace(":", ""),
            "kind": link.get("linkinfo", {}).get("info_kind", ""), "ethernet": link["link_type"] == "ether",
            "link": link.get("link_index") or index.get(link.get("link"), 0),
            "namespace": row["namespace"] if name == "away0" else "",
            "stats": row["stats"], "xdp": [], "default": False, "link_local": sorted(local),
            "addresses": [text[id(each)] for each in its if each["scope"] != "link"],
            "leased": [text[id(each)] for each in its if each.get("dynamic") and each["scope"] != "link"],
            "others": [*routes], "beyond": [each for each, gateway in routes.items() if gateway],
        }  # fmt: skip
        assert (len(row["namespace"]), row["stats"] != "") == (8 * (name == "away0"), True)
    told = [(number, "PROMISC" in has) for number, has in json.loads(flags)]
    assert told == [(0x1002, True), (0x1102, True), (0x1102, False), (0x1002, False)]


@pytest.mark.parametrize(
    ("after_s", "said"), [(0.0, ""), (4.95, ""), (5.05, "near0 has no carrier: "), (99, "near0 is ")]
)
def test_a_link_that_was_just_brought_up_is_waited_for(
    after_s: float, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = [1000.0]
    clock = SimpleNamespace(monotonic=lambda: now_s[0], sleep=lambda s: now_s.append(now_s.pop() + s))
    monkeypatch.setattr(nic, "time", clock)
    monkeypatch.setattr(
        nic, "look_up", lambda _: nic.Interface("near0", 7, after_s < 99, carrier=now_s[0] - 1000 >= after_s)
    )
    with pytest.raises(InterfaceError, match=said) if said else contextlib.nullcontext():
        nic._wait_usable("near0")
    assert now_s[0] - 1000 == pytest.approx(min(after_s, 5.0) % 99 if after_s < 99 else 0.0, abs=0.03)


# As routing daemons set it: routes do not say where their next hops are.
UNSEEN = "echo 0 >/proc/sys/net/ipv4/nexthop_compat_mode"


@pytest.mark.parametrize(
    ("routes", "elsewhere"),
    [
        (routes, "the machine's default route")
        for routes in (
            "ip route add default via 192.0.2.1",
            "ip route add default dev near0",
            "ip route add default via inet6 fe80::1 dev near0",
            *(
                f"ip route add default nexthop via {one} nexthop via {other}"
                for one, other in itertools.permutations(
                    ("192.0.2.1 dev near0 weight 9", "198.51.100.1 dev other0")
                )
            ),
            "ip nexthop add id 5 via 192.0.2.1 dev near0; ip route add default nhid 5",
            f"{UNSEEN}; ip nexthop add id 5 via 192.0.2.1 dev near0; ip route add default nhid 5",
            f"{UNSEEN}; ip nexthop add id 5 dev other0; ip nexthop add id 6 dev near0; "
            "ip nexthop add id 7 group 5/6; ip route add default nhid 7",
            "ip rule add from 192.0.2.7 table 77; ip route add default via 192.0.2.1 table 77",
            "ip rule add fwmark 1 table 7777; ip route add default dev near0 table 7777",
            "ip route add 0.0.0.0/1 via 192.0.2.1; ip route add 128.0.0.0/1 via 192.0.2.1",
            "ip route add 128.0.0.0/2 dev near0",
            "ip -6 route add default via 2001:db8::1",
            "ip -6 route add default nexthop via 2001:db8::1 nexthop via 2001:db8:1::1",
            "ip -6 route add 2000::/3 dev near0",
            "ip link add link near0 name up0 type macvlan; ip link set up0 up; ip route add default dev up0",
        )
    ]
    + [
        ("ip route add 10.0.0.0/8 via 192.0.2.1", "the route to 10.0.0.0/8, through a gateway"),
        ("ip -6 route add fd00::/8 via 2001:db8::1 table 9", "the route to fd00::/8, through a gateway"),
        ("true", ""),
        ("ip route add 10.1.0.0/16 dev near0", ""),
        ("ip route add 224.0.0.0/4 dev near0", ""),
        ("ip route add default via 198.51.100.1; ip -6 route add default via 2001:db8:1::1", ""),
        ("ip route add default nexthop via 198.51.100.1 nexthop via 198.51.100.2", ""),
        (f"{UNSEEN}; ip nexthop add id 6 via 198.51.100.1 dev other0; ip route add default nhid 6", ""),
        ("ip route add unreachable default; ip -6 route add blackhole default", ""),
    ],
)
def test_the_interface_with_a_route_to_elsewhere_is_refused_by_all(routes: str, elsewhere: str) -> None:
    """By server, `find`, doctor and virtual sensor, unless it is allowed."""
    looked = completed("unshare", "--net", "bash", "-c", ROUTED, "bash", routes, sys.executable, "-c", LOOK)
    server, find, doctor, *virtual = looked.stdout.splitlines()
    if not elsewhere:
        assert server == "allowed"
        assert doctor.startswith("LOOK ")
        assert "sudo ip address flush dev near0" in doctor
        assert any(line.startswith("ready") for line in virtual), looked.stderr
        return
    assert server.startswith(f"near0 has {elsewhere}, so it is not for a sensor"), looked.stderr
    assert "'ethercat-sensor adapters' lists them" in server
    assert "--allow-ip" in server
    way = re.sub("the (machine's )?|,.*", "", elsewhere)
    assert find.startswith("part of" if "type macvlan" in routes else way)
    assert doctor.startswith(f"TROUBLE {elsewhere} (")
    assert "flush" not in doctor, "it would cut the machine off"
    assert virtual == [f"ethercat-virtual-sensor: {server}", "1"]


def test_what_stands_on_what_stands_on_an_interface_is_carried_by_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """As VLANs on VLANs, which are numbered as they were made; not the other end of a pair."""
    links = {5: 0, 9: 5, 8: 9, 7: 8, 6: 3, 4: 5, 3: 8}
    rows = [replace(SEES, ifindex=index, link=link, kind="vlan") for index, link in sorted(links.items())]
    rows[1] = replace(rows[1], kind="veth")
    rows[0] = replace(rows[0], namespace=b"1")
    rows.insert(0, nic.Interface("br0", 2, kind="bridge"))
    monkeypatch.setattr(nic, "interfaces", lambda: rows)
    assert nic._carried_by(5) == {5, 9, 8, 7}
    rows[-1] = replace(rows[-1], master_index=2)
    assert nic._carried_by(5) == {5, 9, 8, 7, 2}
    assert nic._carried_by(2) == {2}


def test_no_service_is_installed_for_one() -> None:
    routes = "ip route add default nexthop via 192.0.2.1 nexthop via 192.0.2.2"
    install = Path(__file__).parents[2] / "scripts/install-service"
    done = completed("unshare", "--net", "bash", "-c", ROUTED, "bash", routes, install, "--dry-run", "near0")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("install-service: near0 has the machine's default route")


@contextlib.contextmanager
def address(veth: Veth, *options: str) -> Iterator[None]:
    with steady_addresses(fcntl.LOCK_EX):
        veth.ip("address", "add", "192.0.2.77/32", "dev", veth.near, *options)
        try:
            yield
        finally:
            veth.ip("address", "flush", "dev", veth.near)


def test_an_address_for_some_time_is_refused_by_server_tool_and_doctor_and_marked(veth: Veth) -> None:
    """So does a DHCP client add it."""
    why = f"{veth.near} has the IP address 192.0.2.77/32 by DHCP"
    with address(veth, "valid_lft", "600", "preferred_lft", "600"):
        assert refusal(veth.near).startswith(why)
        assert f"'sudo ip address flush dev {veth.near}'" in refusal(veth.near)
        assert why in tool_here("eeprom", veth.near, code=1).err
        with pytest.raises(InterfaceError, match="has the IP address"):
            serve(parse_options([veth.near, "14999", "--user", "root"]), Signals())
        found = doctor_here(veth.near, "--seconds", 0, "--json")
        assert why in found.findings("bus")["slaves"]["found"]
        assert (found.code, found.findings("other software")["addresses"]["level"]) == (1, "bad")
        line = next(
            line for line in tool_here("adapters").out.splitlines() if line.startswith(f"{veth.near} ")
        )
        assert "not for a sensor: 192.0.2.77/32" in line
        with claimed(veth.near, allow_ip=True):
            pass
    with claimed(veth.near):
        pass


def test_an_address_that_somebody_gave_it_is_allowed(veth: Veth) -> None:
    """The doctor warns of it: IP traffic delays the sensor's frames."""
    with address(veth), claimed(veth.near):
        assert f"{veth.near} " in (listed := tool_here("adapters").out)
        assert "192.0.2.77/32" in listed
        assert "not for a sensor: 192.0.2.77/32" not in listed


OTHER = "name the sensor's interface ('ethercat-sensor adapters' lists them)"


@pytest.mark.parametrize(
    ("routes", "why", "said"),
    [
        (
            Routes(("10.0.0.2/24",), (), True, beyond=("10.9.0.0/16",)),
            f"ens5 has the machine's default route, so it is not for a sensor: {OTHER}; --allow-ip overrides "
            "this",
            "default route, route to 10.9.0.0/16, 10.0.0.2/24",
        ),
        (
            Routes(leased=("2001:db8::2/64", "10.0.0.2/24")),
            f"ens5 has the IP address 2001:db8::2/64 by DHCP, so it is part of a network: {OTHER}, or, if "
            "only the sensor is on it, 'sudo ip address flush dev ens5'; --allow-ip overrides this",
            "",
        ),
        (Routes(("10.0.0.2/24",)), None, "10.0.0.2/24"),
        (Routes((), ("fe80::1/64",), others=("10.1.0.0/16",)), None, ""),
        (
            Routes(others=("10.1.0.0/16",), beyond=("10.1.0.0/16", "10.2.0.0/16"), leased=("10.1.0.2/24",)),
            f"ens5 has the route to 10.1.0.0/16, through a gateway, so it is not for a sensor: {OTHER}; "
            "--allow-ip overrides this",
            "route to 10.1.0.0/16, route to 10.2.0.0/16",
        ),
        (Routes(), None, ""),
    ],
)
def test_what_every_interface_may_have_is_no_network(routes: Routes, why: str | None, said: str) -> None:
    assert (network_trouble("ens5", routes), str(routes)) == (why, said)


@pytest.mark.parametrize(
    ("family", "length", "address", "found"),
    [
        (socket.AF_INET, 0, "", ""),
        (socket.AF_INET, 7, "10.0.0.0", ""),
        (socket.AF_INET, 8, "10.0.0.0", "10.0.0.0/8"),
        (socket.AF_INET, 4, "224.0.0.0", "224.0.0.0/4"),
        (socket.AF_INET6, 6, "fc00::", ""),
        (socket.AF_INET6, 7, "fc00::", "fc00::/7"),
    ],
)
def test_a_destination_of_many_networks_is_that_of_a_default_route(
    family: int, length: int, address: str, found: str
) -> None:
    told = {1: socket.inet_pton(family, address)} if address else {}
    assert nic._destination(family, length, told) == found


@pytest.mark.parametrize("allow_ip", [False, True])
def test_loopback_is_refused_whatever_is_allowed(allow_ip: bool) -> None:
    with pytest.raises(InterfaceError) as refused:
        nic.check_network(nic.Interface("lo", 1, loopback=True), "lo", allow_ip=allow_ip)
    assert str(refused.value) == "lo is the loopback interface: name the sensor's"


def test_where_the_kernel_does_not_say_what_is_on_it_somebody_must_allow_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def unknown(_: int) -> Routes:
        raise OSError("no answer")

    monkeypatch.setattr(nic, "find_routes", unknown)
    nic.check_network(SEES, "near0", allow_ip=True)
    with pytest.raises(InterfaceError) as refused:
        nic.check_network(SEES, "near0", allow_ip=False)
    assert str(refused.value) == (
        "the kernel does not say whether near0 has an IP address (no answer): --allow-ip overrides this check"
    )


def test_what_a_name_may_be(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nic, "own_name", lambda name: {"alternative/name": "ens5"}.get(name, name))
    for name, is_one in (
        ("a" * 15, True), ("a" * 16, False), ("\N{MICRO SIGN}" * 8, False), ("", False), ("a/b", False),
        ("alternative/name", True),
    ):  # fmt: skip
        told = (
            f"{name!r} is not an interface name: it must have 1 to 15 characters; "
            "'ethercat-sensor adapters' lists them"
        )
        assert nic.name_trouble(name) == (None if is_one else told)


@pytest.mark.parametrize(
    ("answer", "found"),
    [
        ((100, 1, 0), (100, 1)),
        ((0x86A0, 0, 1), (100_000, 0)),
        ((0xFFFF, 255, 0xFFFF), (0, 255)),
        ((0xFFFF, 1, 0), (0, 1)),
        ((0, 1, 0), (0, 1)),
    ],
)
def test_the_speed_of_a_link(
    answer: tuple[int, ...], found: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(nic, "ethtool", lambda *_: answer)
    assert nic.link_settings("ens5") == found


@pytest.mark.parametrize(
    ("rows", "processes", "who"),
    [
        ([(0x88A4, 5, 1)], {10: {1}}, "another EtherCAT master, process 10 (p10)"),
        ([(0x88A4, 5, 1), (3, 5, 2)], {10: {1, 2}}, "a virtual sensor, process 10 (p10)"),
        ([(0x88A4, 5, 1), (3, 6, 2)], {10: {1, 2}}, "another EtherCAT master, process 10 (p10)"),
        ([(0x88A4, 5, 1), (3, 5, 2)], {9: {2}, 10: {1}}, "another EtherCAT master, process 10 (p10)"),
        ([(0x88A4, 5, 1), (3, 5, 2)], {9: {2}}, "another EtherCAT master, or a virtual sensor"),
        ([(0x88A4, 6, 1), (3, 5, 2)], {10: {1, 2}}, ""),
    ],
)
def test_who_has_an_interface_is_said(
    rows: list[tuple[int, int, int]],
    processes: dict[int, set[int]],
    who: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    known = [nic.Process(pid, f"p{pid}", sockets) for pid, sockets in processes.items()]
    monkeypatch.setattr(nic, "look_up", lambda _: SEES)
    monkeypatch.setattr(nic, "packet_sockets", lambda: [nic.Listener(*row) for row in rows])
    monkeypatch.setattr(nic, "users_of", lambda inodes: (each for each in known if each.sockets & inodes))
    monkeypatch.setattr(nic, "_name_of", lambda path: f"p{path.name}")
    if not who:
        nic.check_unused("near0")
        return
    with pytest.raises(InterfaceError) as refused:
        nic.check_unused("near0")
    assert str(refused.value) == f"near0 is in use by {who}: stop that one first"


BOTH = ["CAP_NET_ADMIN", "CAP_NET_RAW"]


@pytest.mark.parametrize(
    ("mask", "missing"), [(0x3000, []), (0x1000, BOTH[1:]), (0x2000, BOTH[:1]), (0xCFFF, BOTH)]
)
def test_what_must_be_allowed(mask: int, missing: list[str]) -> None:
    told = f"Name:\tx\nCapInh:\t0\nCapEff:\t{mask:016x}\nCapBnd:\t0\n"
    assert nic.missing_capabilities(told) == missing
    assert nic.missing_capabilities("Name:\tx\n") == BOTH


# -- who has it


def test_a_master_of_somebody_elses_is_named_with_its_process(veth: Veth) -> None:
    """It has no lock of ours, only the raw socket: whose that is only the kernel knows."""
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW) as its:
        its.bind((veth.near, 0x88A4))
        name = Path("/proc/self/comm").read_text().strip()
        assert f"is in use by another EtherCAT master, process {os.getpid()} ({name}): stop" in refusal(
            veth.near
        )
    with claimed(veth.near):
        pass


@contextlib.contextmanager
def another(ifname: str) -> Iterator[subprocess.Popen[str]]:
    """Another process that has claimed the interface."""
    process = subprocess.Popen(
        [sys.executable, "-c", CLAIM, ifname], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    with process:
        assert process.stdout is not None
        assert process.stdout.readline() == "claimed\n"
        yield process


def test_the_process_that_has_the_interface_is_named_until_it_ends_in_any_way(
    veth: Veth, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where another's lock is of a file whose number ends alike."""
    original, lock = Path.read_text, r"^(.*FLOCK\s+\S+\s+\S+) \d+ (\S+:)(\d+) (.*)$"
    alike = functools.partial(re.sub, lock, r"\1 1 \g<2>1\3 \4\n\g<0>", flags=re.MULTILINE)
    monkeypatch.setattr(Path, "read_text", lambda path, **how: alike(original(path, **how)))
    before, after = ((tmp_path / name).open("w") for name in "ab")
    fcntl.flock(before, fcntl.LOCK_EX)
    with before, after, another(veth.near) as process:
        fcntl.flock(after, fcntl.LOCK_EX)
        name = Path(f"/proc/{process.pid}/comm").read_text().strip()
        expected = f"{veth.near} is in use by another EtherCAT master, process {process.pid} ({name}): stop"
        if os.access(nic.DIRECTORY, os.W_OK):
            assert refusal(veth.near).startswith(expected)
            with claimed(veth.far):
                pass
        process.send_signal(signal.SIGKILL)
        process.wait()
        with claimed(veth.near):
            pass


@needs_another_user
def test_another_user_can_neither_take_the_lock_nor_stop_others_from_it(
    veth: Veth, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As it could with an abstract socket."""
    directory = rights.temporary() / "ethercat-server"
    monkeypatch.setattr(nic, "DIRECTORY", directory)
    with claimed(veth.near):
        (lock,) = directory.iterdir()
        with as_user(NOBODY.pw_uid):
            for place in (directory, lock):
                with pytest.raises(PermissionError):
                    os.open(place, os.O_RDONLY)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as taken:
        taken.bind(f"\0ethercat-server/ifindex/{socket.if_nametoindex(veth.near)}")
        with claimed(veth.near):
            pass


@needs_another_user
def test_the_lock_that_root_made_is_the_services_too(veth: Veth, monkeypatch: pytest.MonkeyPatch) -> None:
    directory = rights.temporary() / "ethercat-server"
    monkeypatch.setattr(nic, "DIRECTORY", directory)
    directory.mkdir(mode=0o700)
    os.chown(directory, NOBODY.pw_uid, NOBODY.pw_gid)
    which = veth.near, socket.if_nametoindex(veth.near)
    with nic.locked(*which), as_user(NOBODY.pw_uid), pytest.raises(InterfaceError, match="in use"):
        nic.locked(*which).__enter__()
    with as_user(NOBODY.pw_uid), nic.locked(*which), pytest.raises(InterfaceError, match="in use"):
        nic.locked(*which).__enter__()


@pytest.mark.parametrize("trap", ["link", "fifo", 0o777, 0o720, 0o702])
def test_a_lock_that_may_be_anothers_is_not_used(veth: Veth, directory: Path, trap: str | int) -> None:
    directory.mkdir(mode=0o700)
    if trap == "link":
        (directory / "lock").symlink_to(directory.parent)
    elif trap == "fifo":
        os.mkfifo(directory / "lock")
    elif isinstance(trap, int):
        directory.chmod(trap)
    with claimed(veth.near), pytest.raises(OSError):  # noqa: PT011 - any
        nic._open_lock("lock")


def test_a_folder_of_locks_that_others_could_enter_is_closed(veth: Veth, directory: Path) -> None:
    directory.mkdir()
    directory.chmod(0o755)
    with claimed(veth.near):
        assert directory.stat().st_mode & 0o777 == 0o700
        assert [lock.stat().st_mode & 0o777 for lock in directory.iterdir()] == [0o755]


def test_without_run_it_is_a_name_in_the_namespace(veth: Veth, monkeypatch: pytest.MonkeyPatch) -> None:
    """As for the root of a user namespace."""
    monkeypatch.setattr(nic, "DIRECTORY", Path("/proc/ethercat-server"))
    for _ in range(2):
        with claimed(veth.near), pytest.raises(InterfaceError, match="in use"), claimed(veth.near):
            pass


# -- the raw socket, with this test at the other end

FRAME = (b"\xff" * 6 + b"\x01" * 6 + b"\x88\xa4" + b"\x0e\x10").ljust(60, b"\0")
LONG_S = 20.0
Ends = tuple[SoemBackend, socket.socket]


@pytest.fixture
def ends(veth: Veth) -> Iterator[Ends]:
    before = packet_sockets()
    with (
        contextlib.closing(SoemBackend(veth.near)) as near,
        socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0) as far,
    ):
        far.bind((veth.far, 0x88A4))
        far.settimeout(LONG_S)
        near.open()
        assert len(packet_sockets() - before) == 3, "both, and a second handle"
        yield near, far
    assert packet_sockets() == before


def test_frames_go_both_ways_and_none_is_none(ends: Ends) -> None:
    near, far = ends
    assert near.receive(0) is None
    near.send(FRAME)
    assert far.recv(2048) == FRAME
    for _ in range(2):
        far.send(FRAME)
    assert [near.receive(LONG_S), near.receive(0), near.receive(0)] == [FRAME, FRAME, None]


def test_the_kernel_says_when_a_frame_had_arrived(ends: Ends) -> None:
    near, far = ends
    near.arrived_ns()  # from now on
    right = False
    for _ in range(50):  # it is late if this process stops while it reads two clocks
        before = SYSTEM_CLOCK.raw_ns()
        far.send(FRAME)
        after = SYSTEM_CLOCK.raw_ns()
        time.sleep(0.002)  # in which it lies there
        assert near.receive(LONG_S) == FRAME
        assert near.arrived_ns() > before
        right |= near.arrived_ns() < after
    assert right


def test_a_link_that_is_down_loses_frames(veth: Veth, ends: Ends) -> None:
    """The last one: it stays down."""
    veth.ip("link", "set", veth.near, "down")
    ends[0].send(FRAME)
    assert ends[0].receive(0.01) is None

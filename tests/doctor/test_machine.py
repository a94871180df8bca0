"""The checks of machine and interface on made-up machines: a table of what is different and what is said."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from bota_ethercat.health.limits import Level
from bota_ethercat.program.command import command
from ethercat_server.doctor.machine import FACTS, Host, processor_list
from ethercat_server.doctor.machine_checks import CHECKS, examine_machine, rising
from ethercat_server.doctor.report import CannotLookError, CheckResult, bad, examine, ok
from ethercat_server.errors import BusError
from ethercat_server.ethercat.nic import Process, Routes
from tests.doctor.made_up import CPUS, GOOD, Facts, Files, but, machine

SKIP, FINE, NOTE, LOOK, BAD = Level.NOT_POSSIBLE, Level.GOOD, Level.NOTE, Level.LOOK, Level.TROUBLE


class Case(NamedTuple):
    """A machine that is good but for `files` and `facts`, and the only finding of a check there."""

    check: str
    level: Level
    files: Mapping[str, str | bytes | None] = {}
    facts: Facts = but()
    said: str = ""
    """Part of what is found, or of the effect."""
    commands: Sequence[str] | None = None
    values: Mapping[str, Any] = {}
    """Among those of the finding."""


# -- kernel

SWITCH = "/sys/kernel/debug/sched/preempt"
FULL = [f"echo full | sudo tee {SWITCH}"]
ORDINARY: Files = {
    "/sys/kernel/realtime": None, "/proc/version": "Linux version 6.1.0-amd64 #1 SMP PREEMPT_DYNAMIC",
}  # fmt: skip
FIXED: Files = {**ORDINARY, "/proc/version": "Linux version 6.1 #1 SMP"}
UBUNTU = {**FIXED, "/etc/os-release": 'NAME="Ubuntu"\nID=ubuntu\n'}


def switched(text: str, model: str, level: Level, commands: list[str] | None = None) -> Case:
    """Where the kernel's preemption can be switched, and is."""
    return Case("preemption", level, {**ORDINARY, SWITCH: text}, values={"model": model}, commands=commands)


KERNEL = [
    Case("preemption", FINE),
    Case("preemption", FINE, {"/proc/version": "Linux version 5.15"}, values={"model": "rt"}),
    Case("preemption", FINE, {"/sys/kernel/realtime": None}),
    switched("none voluntary (full)", "full", NOTE),
    switched("none voluntary full (lazy)", "lazy", NOTE),
    switched("none (voluntary) full", "voluntary", LOOK, FULL),
    switched("(none) voluntary full", "none", LOOK, FULL),
    # Where the switch is hidden, the command line or the build tells, or nothing.
    Case("preemption", LOOK, {**ORDINARY, "/proc/cmdline": "preempt=none"},
         values={"model": "none", "dynamic": True}),
    Case("preemption", SKIP, ORDINARY, said=f"{SWITCH} cannot be read: it needs root and debugfs"),
    Case("preemption", LOOK, UBUNTU, commands=["sudo pro attach && sudo pro enable realtime-kernel"]),
    Case("preemption", LOOK, FIXED, commands=["sudo apt install linux-image-rt-amd64"]),
    Case("preemption", NOTE, {**FIXED, "/proc/version": "Linux version 5.4 #1 SMP PREEMPT"},
         values={"model": "full"}),
]  # fmt: skip

# -- rights and processors

NO_RIGHTS = {"/proc/self/status": "CapEff:\t0000000000000000\n"}
NAMES = ["CAP_NET_ADMIN", "CAP_NET_RAW", "CAP_IPC_LOCK", "CAP_SYS_NICE"]
GOVERNOR = f"{CPUS}/cpu*/cpufreq/scaling_governor"
IDLE = f"{CPUS}/cpu1/cpuidle"
DEEP: Files = {
    f"{IDLE}/state2/latency": "40", f"{IDLE}/state2/name": "C3",
    f"{IDLE}/state3/latency": "170", f"{IDLE}/state3/name": "C8",
}  # fmt: skip
TOO_DEEP = [f"echo 1 | sudo tee {CPUS}/cpu*/cpuidle/state[23]/disable"]
DMA = "/dev/cpu_dma_latency"
DOCTOR = command("sudo ethercat-doctor ens5")
PROCESSORS = [
    Case("capabilities", FINE),
    Case("capabilities", NOTE, NO_RIGHTS, values={"missing": NAMES}, commands=[DOCTOR]),
    Case("capabilities", NOTE, {"/proc/self/status": f"CapEff:\t{3 << 12:016x}\n"}, said="less steady cycle"),
    Case("governor", FINE),
    Case("governor", LOOK, {GOVERNOR.replace("*", "2"): "powersave"}, said="performance on 3, powersave on 1",
         commands=[f"echo performance | sudo tee {GOVERNOR}"]),
    Case("governor", FINE, {GOVERNOR.replace("*", str(n)): None for n in range(4)}, values={"governors": []}),
    Case("idle states", FINE, values={"latency_us": 2}),
    Case("idle states", SKIP, {f"{IDLE}/state1/latency": "much"}, said="which is not a number"),
    Case("idle states", LOOK, DEEP, said="C8, 170 µs to wake", commands=TOO_DEEP),
    Case("idle states", NOTE, {**DEEP, f"{IDLE}/state3/disable": "1"}, said="C3, 40 µs"),
    # A program may limit the latency.
    Case("idle states", FINE, {**DEEP, DMA: struct.pack("=i", 0)}, values={"limit_us": 0, "latency_us": 0}),
    Case("idle states", LOOK, {**DEEP, DMA: struct.pack("=i", 2_000_000_000)}),
    Case("idle states", LOOK, {**DEEP, DMA: b"\0"}),
]  # fmt: skip

# -- interface

UNSUPPORTED = "the driver does not support it"
VETH = {"kind": "veth"}
HELD = {"rx_coalesce_usecs": 3, "tx_coalesce_usecs": 0, "use_adaptive_rx_coalesce": 0}

INTERFACE = [
    Case("link", FINE),
    Case("link", BAD, facts=but(link={"up": False, "carrier": False}), said="down",
         commands=["sudo ip link set ens5 up"]),
    Case("link", BAD, facts=but(link={"carrier": False}), said="up, no carrier",
         commands=["ip -br link show ens5"]),
    Case("link", BAD, facts=but(link={"loopback": True}), said="the loopback interface",
         commands=["ethercat-sensor adapters"]),
    Case("link", BAD, facts={"link": None, "names": ("lo", "eth1")}, said="lo, eth1"),
    *(
        Case("speed", level, facts=but(settings=found))
        for found, level in (((100, "full"), FINE), ((100, "half"), BAD), ((10, "full"), BAD),
                             ((1000, "full"), LOOK), ((None, None), FINE))
    ),
    Case("speed", FINE, facts=but(settings=(10000, "full"), link=VETH)),
    Case("speed", SKIP, facts=but(link={"carrier": False}), said="carrier"),
    Case("speed", SKIP, facts=but(settings="went wrong"), said="went wrong"),
    Case("driver", FINE, said="e1000e on 0000:00:1f.6"),
    Case("driver", LOOK, facts=but(driver=("r8152", "usb-0000:00:14.0-2")), said="PCIe"),
    Case("driver", LOOK, facts=but(driver=("virtio_net", "0000:00:03.0"))),
    Case("driver", BAD, {"/sys/class/net/ens5/wireless/status": ""}),
    Case("coalescing", FINE),
    Case("coalescing", LOOK, facts=but(coalescing=HELD), said="rx 3 µs",
         commands=["sudo ethtool -C ens5 rx-usecs 0 tx-usecs 0"]),
    Case("coalescing", LOOK, facts=but(coalescing={**HELD, "use_adaptive_rx_coalesce": 1}),
         commands=["sudo ethtool -C ens5 adaptive-rx off adaptive-tx off rx-usecs 0 tx-usecs 0"]),
    Case("coalescing", SKIP, facts=but(coalescing=UNSUPPORTED), said=UNSUPPORTED),
    *(
        Case("EEE", level, facts=but(EEE=found),
             commands=["sudo ethtool --set-eee ens5 eee off"] if level is not FINE else [])
        for found, level in (((True, True), LOOK), ((True, False), NOTE), ((False, False), FINE))
    ),
]  # fmt: skip

# -- other software

DHCP = {"/proc/55/comm": "dhclient\n"}
SOFTWARE = [
    Case("managers", LOOK, {"/run/NetworkManager/devices/7": "[device]\nmanaged=true\n"},
         said="NetworkManager", commands=["sudo nmcli device set ens5 managed no"]),
    Case("managers", LOOK, {"/run/systemd/netif/links/7": "ADMIN_STATE=configured\n"},
         said="systemd-networkd", commands=["sudo scripts/install-service ens5"]),
    Case("managers", LOOK, {"/etc/network/interfaces.d/a": "auto ens5\niface ens5 inet dhcp\n"},
         said="ifupdown", commands=["sudoedit /etc/network/interfaces"]),
    Case("managers", LOOK, {**DHCP, "/proc/55/cmdline": "dhclient\0-v\0ens5\0"}, said="dhclient (55)",
         commands=["sudo kill 55"]),
    Case("managers", FINE, {"/run/NetworkManager/devices/7": "[device]\nmanaged=false\n"}),
    Case("managers", FINE, {"/run/NetworkManager/devices/8": "[device]\nmanaged=true\n"}),
    Case("managers", FINE, {"/run/systemd/netif/links/7": "ADMIN_STATE=unmanaged\n"}),
    Case("managers", FINE, {"/etc/network/interfaces": "iface ens5 inet manual\niface ens50 inet dhcp\n"}),
    Case("managers", FINE, {**DHCP, "/proc/55/cmdline": "dhclient\0eth0\0"}),
    *(
        Case("addresses", level, facts=but(routes=routes))
        for routes, level in (
            (Routes(("10.0.0.2/24",), (), True), BAD),
            (Routes(("10.0.0.2/24",), leased=("10.0.0.2/24",)), BAD),
            (Routes(("10.0.0.2/24",)), LOOK),
            (Routes(others=("10.1.0.0/16",)), LOOK),
            (Routes(link_local=("fe80::1/64",)), NOTE),
            (Routes(), FINE),
        )
    ),
    Case("membership", BAD, facts=but(link={"master": "br0"}), commands=["sudo ip link set ens5 nomaster"]),
    Case("membership", LOOK, facts=but(link={"upper": ("ens5.10",)}),
         commands=["sudo ip link delete ens5.10"]),
    Case("membership", BAD, facts=but(link={"kind": "veth"}, between=["connected to br0", "remove it"]),
         said="connected to br0\nremove it"),
    Case("XDP", LOOK, facts=but(link={"xdp": ("xdpdrv", "xdpgeneric")}), said="xdpdrv, xdpgeneric",
         commands=[f"sudo ip link set dev ens5 {mode} off" for mode in ("xdpdrv", "xdpgeneric")]),
    Case("packet sockets", LOOK, facts=but(receivers=[(Process(70, "tcpdump", set()), True)]),
         said="process 70 (tcpdump)", commands=["sudo kill 70"]),
    Case("packet sockets", NOTE, facts=but(receivers=[(None, False)]), said="of another user"),
]  # fmt: skip


def looks(name: str, subject: Host) -> list[CheckResult]:
    """What a check finds."""
    ((check, look),) = (row for row in CHECKS.items() if row[0][1] == name)
    found = list(examine(*check, look, subject))
    assert not faults(found)
    return found


def faults(findings: Sequence[CheckResult]) -> list[CheckResult]:
    return [finding for finding in findings if "error in ethercat-doctor" in finding.found]


@pytest.mark.parametrize("case", [*KERNEL, *PROCESSORS, *INTERFACE, *SOFTWARE], ids=lambda case: case.check)
def test_what_is_said(case: Case, tmp_path: Path) -> None:
    (found,) = looks(case.check, machine(tmp_path, case.files, case.facts))
    assert found.level is case.level
    assert case.said in f"{found.found}\n{found.why}"
    assert case.commands is None or [*found.commands] == case.commands
    assert {**found.values, **case.values} == found.values
    assert found.why or found.level < Level.NOTE, "a warning says why it matters"


def test_nothing_is_wrong_with_a_good_machine(tmp_path: Path) -> None:
    found = list(examine_machine(machine(tmp_path)))
    assert [finding for finding in found if finding.level is not FINE] == []
    assert {finding.check for finding in found} == {name for _, name in CHECKS}


def test_without_the_interface_the_machine_is_looked_at_all_the_same(tmp_path: Path) -> None:
    found = list(examine_machine(machine(tmp_path, facts={"link": None, "names": ("lo", "eth1")})))
    assert [(f.check, f.level) for f in found if f.level is not FINE] == [("link", BAD), ("the rest", SKIP)]


def test_each_manager_and_each_vlan_has_its_command(tmp_path: Path) -> None:
    files = {
        "/run/NetworkManager/devices/7": "managed=1\n",
        "/etc/network/interfaces": "iface ens5 inet dhcp\n",
    }
    here = machine(tmp_path, files, but(link={"upper": ("ens5.10", "ens5.11")}))
    for check in ("managers", "membership"):
        assert [len(finding.commands) for finding in looks(check, here)] == [1, 1]


def test_names_of_interfaces_are_quoted_in_commands(tmp_path: Path) -> None:
    here = machine(tmp_path, facts=but(link={"up": False}))
    here.ifname = "a;reboot"
    assert looks("link", here)[0].commands == ("sudo ip link set 'a;reboot' up",)


def test_counters_that_rise_while_the_doctor_looks() -> None:
    before = {"rx_crc_errors": 7, "rx_dropped": 2, "rx_packets": 1}
    assert rising(before, {**before, "rx_packets": 900}).level is FINE
    assert rising(before, {**before, "rx_crc_errors": 9}) == bad(
        "rx_crc_errors 2",
        "frames are being corrupted: check cable, connectors, shield and sources of interference",
        rx_crc_errors=2,
    )
    assert rising(before, {**before, "rx_dropped": 3}).level is NOTE
    with pytest.raises(CannotLookError):
        rising(before, {})


def test_the_facts_of_a_real_interface() -> None:
    lo = Host("lo")
    assert (lo.link.loopback, lo.link.ifindex) == (True, socket.if_nametoindex("lo"))
    assert isinstance(lo.fact("routes"), Routes)
    for fact in ("settings", "EEE"):
        with pytest.raises(CannotLookError, match=UNSUPPORTED):
            lo.fact(fact)
    assert Host("nosuch0").fact("link") is None


def test_lists_of_processors() -> None:
    assert (processor_list("0-2,5\n"), processor_list("")) == ([0, 1, 2, 5], [])
    for text in ("x", "1-", "-1", "0-99999999999"):
        with pytest.raises(CannotLookError):
            processor_list(text)


# -- whatever the files hold, and whichever are not there: each check says something, and none fails

GARBAGE = ("", "\0\0", "-", "99999999999999999999", "x" * 5000, "1 2 3\n" * 50, b"\xff\xfe\x80", "(", "0-")


@pytest.mark.parametrize("number", range(len(GARBAGE)))
def test_garbage_in_every_file(tmp_path: Path, number: int) -> None:
    assert not faults(list(examine_machine(machine(tmp_path, dict.fromkeys(GOOD, GARBAGE[number])))))


def test_no_files_at_all(tmp_path: Path) -> None:
    unknown = but(**dict.fromkeys(FACTS, "no") | {"link": {}})
    found = list(examine_machine(Host("ens5", facts=dict(unknown), root=tmp_path)))
    assert {finding.check for finding in found} == {name for _, name in CHECKS}
    assert {finding.level for finding in found} <= {FINE, SKIP}
    skipped = [finding.found for finding in found if finding.level is SKIP]
    assert len(skipped) > len(CHECKS) // 2
    assert all(said.startswith("not checked: ") for said in skipped)


def test_files_that_are_folders_or_endless(tmp_path: Path) -> None:
    for name in GOOD:
        (tmp_path / "folders" / name.lstrip("/")).mkdir(parents=True)
    assert not faults(list(examine_machine(Host("ens5", facts=dict(but()), root=tmp_path / "folders"))))
    endless = machine(tmp_path / "endless", {"/proc/version": None})
    (tmp_path / "endless/proc/version").symlink_to("/dev/zero")
    assert not faults(list(examine_machine(endless)))


@pytest.mark.parametrize(
    ("error", "level", "said"),
    [
        (CannotLookError("why"), SKIP, "not checked: why"),
        (PermissionError(13, "Permission denied"), SKIP, "not checked: Permission denied"),
        (BusError("slave 0 does not answer"), BAD, "slave 0 does not answer"),
        (ZeroDivisionError("oh"), SKIP, "an error in ethercat-doctor"),
    ],
)
def test_a_check_that_fails_is_one_finding_more(error: Exception, level: Level, said: str) -> None:
    def look() -> Iterator[CheckResult]:
        yield ok("first")
        raise error

    first, second = examine("bus", "slaves", look)
    assert (first.found, first.subject, first.check) == ("first", "bus", "slaves")
    assert (second.level, second.check, said in second.found) == (level, "slaves", True)

"""The network interface, its interrupts and other software on it, on made-up machines."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from bota_ethercat.health.verdict import Level
from ethercat_server.doctor import machine_checks
from ethercat_server.doctor.finding import CannotLookError
from ethercat_server.doctor.machine import InterfaceFacts
from ethercat_server.doctor.machine_checks import examine_machine
from ethercat_server.ethercat.nic import Routes
from tests.doctor.made_up import CPUS, but, machine, only

NAMED = "ens5"


def test_nothing_is_wrong_with_a_good_machine(tmp_path: Path) -> None:
    found = list(examine_machine(machine(tmp_path)))
    assert [finding for finding in found if finding.level is not Level.GOOD] == []
    assert {finding.subject for finding in found} == {
        "kernel",
        "rights",
        "processors",
        "interface",
        "other software",
    }


def test_without_the_interface_the_machine_is_looked_at_all_the_same(tmp_path: Path) -> None:
    gone = machine(tmp_path, facts=InterfaceFacts(names=("lo", "eth1")))
    found = list(examine_machine(gone))
    assert [(f.check, f.level) for f in found if f.level is not Level.GOOD] == [
        ("link", Level.TROUBLE),
        ("the rest", Level.NOT_POSSIBLE),
    ]
    assert "lo, eth1" in only("link", gone).why


@pytest.mark.parametrize(
    ("change", "found", "command"),
    [
        ({"up": False, "carrier": False}, "down", "sudo ip link set ens5 up"),
        ({"carrier": False}, "up, no carrier", "ip -br link show ens5"),
        ({"loopback": True}, "the loopback interface", "ethercat-sensor adapters"),
    ],
)
def test_links_that_cannot_be_used(tmp_path: Path, change: dict[str, bool], found: str, command: str) -> None:
    finding = only("link", machine(tmp_path, facts=but(link=change)))
    assert (finding.level, finding.found, finding.commands) == (Level.TROUBLE, found, (command,))


@pytest.mark.parametrize(
    ("settings", "level"),
    [
        ((100, "full"), Level.GOOD),
        ((100, "half"), Level.TROUBLE),
        ((10, "full"), Level.TROUBLE),
        ((1000, "full"), Level.LOOK),
        ((None, None), Level.GOOD),
    ],
)
def test_ethercat_is_100_megabits_full_duplex(
    tmp_path: Path, settings: tuple[int | None, str | None], level: Level
) -> None:
    assert only("speed", machine(tmp_path, facts=but(settings=settings))).level is level


def test_speed_of_what_has_none(tmp_path: Path) -> None:
    virtual = machine(tmp_path, facts=but(settings=(10000, "full"), link={"kind": "veth"}))
    assert only("speed", virtual).level is Level.GOOD
    with pytest.raises(CannotLookError, match="carrier"):
        only("speed", machine(tmp_path, facts=but(link={"carrier": False})))
    with pytest.raises(CannotLookError, match="went wrong"):
        only("speed", machine(tmp_path, facts=but(settings="went wrong")))


def test_drivers(tmp_path: Path) -> None:
    assert only("driver", machine(tmp_path / "a")).found == "e1000e on 0000:00:1f.6"
    usb = only("driver", machine(tmp_path / "b", facts=but(driver=("r8152", "usb-0000:00:14.0-2"))))
    assert (usb.level, "PCIe" in usb.why) == (Level.LOOK, True)
    guest = only("driver", machine(tmp_path / "c", facts=but(driver=("virtio_net", "0000:00:03.0"))))
    assert guest.level is Level.LOOK
    wireless = machine(tmp_path / "d", {f"/sys/class/net/{NAMED}/wireless/status": ""})
    assert only("driver", wireless).level is Level.TROUBLE


def test_coalescing(tmp_path: Path) -> None:
    assert only("coalescing", machine(tmp_path)).level is Level.GOOD
    held = {"rx_coalesce_usecs": 3, "tx_coalesce_usecs": 0, "use_adaptive_rx_coalesce": 0}
    found = only("coalescing", machine(tmp_path, facts=but(coalescing=held)))
    assert (found.level, found.found) == (Level.LOOK, "rx 3 µs")
    assert found.commands == ("sudo ethtool -C ens5 rx-usecs 0 tx-usecs 0",)
    held["use_adaptive_rx_coalesce"] = 1
    found = only("coalescing", machine(tmp_path, facts=but(coalescing=held)))
    assert found.commands == ("sudo ethtool -C ens5 adaptive-rx off adaptive-tx off rx-usecs 0 tx-usecs 0",)
    none = machine(tmp_path, facts=but(coalescing="the driver does not support it"))
    assert only("coalescing", none).level is Level.GOOD
    with pytest.raises(CannotLookError):
        only("coalescing", machine(tmp_path, facts=but(coalescing="Operation not permitted")))


def test_offloads(tmp_path: Path) -> None:
    on = {"generic-receive-offload": True, "tcp-segmentation-offload": True, "rx-checksumming": True}
    found = only("offloads", machine(tmp_path, facts=but(offloads=on)))
    assert (found.level, found.commands) == (Level.NOTE, ("sudo ethtool -K ens5 gro off tso off",))
    assert (
        only("offloads", machine(tmp_path, facts=but(offloads=on, link={"kind": "veth"}))).level is Level.GOOD
    )


@pytest.mark.parametrize(
    ("eee", "level"),
    [
        ((True, True), Level.LOOK),
        ((True, False), Level.NOTE),
        ((False, False), Level.GOOD),
        ("the driver does not support it", Level.GOOD),
    ],
)
def test_energy_efficient_ethernet(tmp_path: Path, eee: tuple[bool, bool] | str, level: Level) -> None:
    found = only("EEE", machine(tmp_path, facts=but(eee=eee)))
    assert found.level is level
    assert found.commands == (("sudo ethtool --set-eee ens5 eee off",) if level > Level.GOOD else ())


def test_counters(tmp_path: Path) -> None:
    def counted(**counters: int) -> Level:
        return only(
            "counters", machine(tmp_path, facts=but(link={"counters": {"rx_packets": 9, **counters}}))
        ).level

    assert counted() is Level.GOOD
    assert counted(rx_crc_errors=1) is Level.LOOK
    assert counted(rx_dropped=5) is Level.NOTE
    flapping = machine(tmp_path, facts=but(link={"carrier_changes": 90}))
    assert only("counters", flapping).level is Level.NOTE
    with pytest.raises(CannotLookError):
        only("counters", machine(tmp_path, facts=but(link={"counters": {}})))


def test_counters_that_rise_while_the_doctor_looks() -> None:
    before = {"rx_crc_errors": 7, "rx_dropped": 2, "rx_packets": 1}
    (same,) = machine_checks.rising(before, {**before, "rx_packets": 900})
    assert same.level is Level.GOOD
    (more,) = machine_checks.rising(before, {**before, "rx_crc_errors": 9})
    assert (more.level, more.found, more.values) == (Level.TROUBLE, "rx_crc_errors 2", {"rx_crc_errors": 2})
    (dropped,) = machine_checks.rising(before, {**before, "rx_dropped": 3})
    assert dropped.level is Level.NOTE
    with pytest.raises(CannotLookError):
        list(machine_checks.rising(before, {}))


def test_interrupts_belong_on_the_isolated_processor(tmp_path: Path) -> None:
    assert only("interrupts", machine(tmp_path / "a")).values == {"irqs": [130], "processors": [3]}
    elsewhere = machine(tmp_path / "b", {"/proc/irq/130/effective_affinity_list": "0"})
    found = only("interrupts", elsewhere)
    assert found.level is Level.NOTE
    assert found.commands == ("echo 3 | sudo tee /proc/irq/130/smp_affinity_list",)
    balanced = machine(tmp_path / "c", {"/proc/99/comm": "irqbalance\n"})
    assert "irqbalance runs" in only("interrupts", balanced).found
    shared = machine(tmp_path / "d", {"/proc/irq/130/effective_affinity_list": "0", f"{CPUS}/isolated": ""})
    assert only("interrupts", shared).level is Level.GOOD


@pytest.mark.parametrize(
    ("line", "found"),
    [
        (" 41: 0 PCI-MSIX-0000:00:03.0 1-edge ens5-rx-0", True),
        (" 41: 0 PCI-MSIX-0000:00:03.0 1-edge ens5", True),
        (" 41: 0 IR-PCI-MSI 1-edge mlx5_comp0@pci:0000:00:1f.6", True),
        (" 41: 0 PCI-MSIX-0000:00:03.0 1-edge ens51", False),
        (" 41: 0 PCI-MSIX-0000:00:03.0 1-edge ens50-rx-0", False),
        ("NMI: 0 ens5", False),
    ],
)
def test_which_interrupts_are_the_cards(tmp_path: Path, line: str, found: bool) -> None:
    here = machine(tmp_path, {"/proc/interrupts": line + "\n", "/proc/irq/41/smp_affinity_list": "3"})
    if found:
        assert only("interrupts", here).values["irqs"] == [41]
    else:
        with pytest.raises(CannotLookError):
            only("interrupts", here)


def test_a_virtual_interface_has_no_interrupts(tmp_path: Path) -> None:
    virtual = machine(tmp_path, {"/proc/interrupts": ""}, facts=but(link={"kind": "veth", "parent": ""}))
    assert only("interrupts", virtual).level is Level.GOOD
    assert only("interrupt threads", virtual).level is Level.GOOD


def test_interrupt_threads_come_before_the_server(tmp_path: Path) -> None:
    assert only("interrupt threads", machine(tmp_path / "a")).values == {"threads": {77: 85}}
    below = {"/proc/77/stat": "77 (irq/130-ens5) S " + " ".join(["0"] * 36) + " 50 1 0\n"}
    found = only("interrupt threads", machine(tmp_path / "b", below))
    assert (found.level, found.commands) == (Level.NOTE, ("sudo chrt -f -p 85 77",))
    assert only("interrupt threads", machine(tmp_path / "c", below, rt_priority=40)).level is Level.GOOD
    not_threaded = machine(tmp_path / "d", {"/proc/77/comm": None})
    assert "not threaded" in only("interrupt threads", not_threaded).found


@pytest.mark.parametrize(
    ("files", "named", "command"),
    [
        (
            {"/run/NetworkManager/devices/7": "[device]\nmanaged=true\n"},
            "NetworkManager",
            "nmcli device set ens5",
        ),
        (
            {"/run/systemd/netif/links/7": "ADMIN_STATE=configured\n"},
            "systemd-networkd",
            "install-service ens5",
        ),
        ({"/etc/network/interfaces.d/a": "auto ens5\niface ens5 inet dhcp\n"}, "ifupdown", "sudoedit"),
        (
            {"/proc/55/comm": "dhclient\n", "/proc/55/cmdline": "dhclient\0-v\0ens5\0"},
            "dhclient (55)",
            "kill 55",
        ),
    ],
)
def test_managers(tmp_path: Path, files: dict[str, str], named: str, command: str) -> None:
    found = only("managers", machine(tmp_path, files))
    assert found.level is Level.LOOK
    assert named in found.found
    assert command in found.commands[0]


@pytest.mark.parametrize(
    "files",
    [
        {"/run/NetworkManager/devices/7": "[device]\nmanaged=false\n"},
        {"/run/NetworkManager/devices/8": "[device]\nmanaged=true\n"},
        {"/run/systemd/netif/links/7": "ADMIN_STATE=unmanaged\n"},
        {"/etc/network/interfaces": "iface ens5 inet manual\niface ens50 inet dhcp\n"},
        {"/proc/55/comm": "dhclient\n", "/proc/55/cmdline": "dhclient\0eth0\0"},
    ],
)
def test_managers_that_leave_it_alone(tmp_path: Path, files: dict[str, str]) -> None:
    assert only("managers", machine(tmp_path, files)).level is Level.GOOD


@pytest.mark.parametrize(
    ("routes", "level"),
    [
        (Routes(("10.0.0.2/24",), (), True), Level.TROUBLE),
        (Routes(("10.0.0.2/24",), leased=("10.0.0.2/24",)), Level.TROUBLE),
        (Routes(("10.0.0.2/24",)), Level.LOOK),
        (Routes(others=("10.1.0.0/16",)), Level.LOOK),
        (Routes(link_local=("fe80::1/64",)), Level.NOTE),
        (Routes(), Level.GOOD),
    ],
)
def test_addresses(tmp_path: Path, routes: Routes, level: Level) -> None:
    assert only("addresses", machine(tmp_path, facts=but(routes=routes))).level is level


def test_membership(tmp_path: Path) -> None:
    bridged = only("membership", machine(tmp_path, facts=but(link={"master": "br0"})))
    assert (bridged.level, bridged.commands) == (Level.TROUBLE, ("sudo ip link set ens5 nomaster",))
    below = only("membership", machine(tmp_path, facts=but(link={"upper": ("ens5.10",)})))
    assert (below.level, below.commands) == (Level.LOOK, ("sudo ip link delete ens5.10",))


TABLE = "sk RefCnt Type Proto Iface R Rmem User Inode\n"


@pytest.mark.parametrize(
    ("row", "level"),
    [
        ("ffff 3 3 0003 7 1 0 0 4242", Level.LOOK),
        ("ffff 3 3 0003 0 1 0 0 4242", Level.LOOK),
        ("ffff 3 3 88cc 7 1 0 0 4242", Level.NOTE),
        ("ffff 3 3 88cc 0 1 0 0 4242", Level.GOOD),
        ("ffff 3 3 0003 8 1 0 0 4242", Level.GOOD),
        ("ffff 3 3 88a4 7 1 0 0 4242", Level.GOOD),
    ],
)
def test_listeners_hear_its_frames_or_all(tmp_path: Path, row: str, level: Level) -> None:
    here = machine(tmp_path, {"/proc/self/net/packet": f"{TABLE}{row}\n", "/proc/66/comm": "tcpdump\n"})
    descriptors = tmp_path / "proc/66/fd"
    descriptors.mkdir()
    (descriptors / "3").symlink_to("socket:[4242]")
    found = only("listeners", here)
    assert found.level is level
    assert found.values["listeners"] == (["tcpdump (66)"] if level is not Level.GOOD else [])


def test_listeners_that_may_not_be_seen_are_counted(tmp_path: Path) -> None:
    here = machine(tmp_path, {"/proc/self/net/packet": TABLE + "ffff 3 3 0003 7 1 0 0 4242\n"})
    assert "only root can see" in only("listeners", here).found
    with pytest.raises(CannotLookError):
        only("listeners", machine(tmp_path, {"/proc/self/net/packet": TABLE + "hello\n"}))


def test_names_of_interfaces_are_quoted_in_commands(tmp_path: Path) -> None:
    here = machine(tmp_path, facts=but(link={"up": False}))
    here.ifname = "a;reboot"
    assert only("link", here).commands == ("sudo ip link set 'a;reboot' up",)


def test_the_facts_of_a_real_interface() -> None:
    from ethercat_server.doctor.machine import Link, collect

    found = collect("lo")
    assert isinstance(found.link, Link)
    assert found.link.loopback
    assert found.link.index == socket.if_nametoindex("lo")
    assert isinstance(found.routes, Routes)
    assert found.settings == "the driver does not support it"
    assert isinstance(found.offloads, dict)
    assert collect("nosuch0").link is None

"""The network interface: link, card, driver settings that add latency, error counters."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from typing import Any, Final

from ethercat_server.doctor.finding import Finding, bad, cannot_look, note, ok, warning
from ethercat_server.doctor.machine.facts import Link, known
from ethercat_server.doctor.machine.machine import Machine

_ETHERCAT_SPEED: Final = 100
_GUEST_DRIVERS: Final = frozenset({"virtio_net", "vmxnet3", "hv_netvsc", "xen-netfront", "vif", "ena", "gve"})
_UNWANTED: Final = {
    "generic-receive-offload": "gro",
    "large-receive-offload": "lro",
    "tcp-segmentation-offload": "tso",
    "generic-segmentation-offload": "gso",
}
_DELAYS: Final = ("rx_coalesce_usecs", "tx_coalesce_usecs")
_ADAPTIVE: Final = ("use_adaptive_rx_coalesce", "use_adaptive_tx_coalesce")
_DAMAGE: Final = ("rx_crc_errors", "rx_frame_errors", "rx_length_errors", "tx_carrier_errors", "collisions")
_ERRORS: Final = ("rx_errors", "tx_errors", *_DAMAGE)
_DROPS: Final = (
    "rx_dropped",
    "tx_dropped",
    "rx_fifo_errors",
    "rx_missed_errors",
    "rx_over_errors",
    "tx_fifo_errors",
)
_FEW_CARRIER_CHANGES: Final = 20


def link(machine: Machine) -> Iterator[Finding]:
    """Whether the interface is there, up, and has a carrier."""
    facts, name = machine.facts, machine.shown
    if facts.link is None:
        yield bad(
            f"no network interface {machine.ifname!r}",
            f"available: {', '.join(facts.names)}; USB adapters change names when plugged into another port",
            "ethercat-sensor adapters", present=False,
        )  # fmt: skip
        return
    found: Link = known(facts.link)
    values: dict[str, Any] = {"present": True, "up": found.up, "carrier": found.carrier, "kind": found.kind}
    if found.loopback:
        yield bad(
            "the loopback interface",
            "sensors need a network card: use another interface",
            "ethercat-sensor adapters",
            **values,
        )
    elif not found.up:
        yield bad("down", "it cannot send frames", f"sudo ip link set {name} up", **values)
    elif not found.carrier:
        why = "no link: check cable, PoE injector and its power supply; the sensor belongs on its LAN side"
        yield bad("up, no carrier", why, f"ip -br link show {name}", **values)
    else:
        yield ok("up, with carrier" + (f" ({found.kind})" if found.kind else ""), **values)


def speed(machine: Machine) -> Iterator[Finding]:
    """EtherCAT is 100 Mbit/s, full duplex."""
    there = machine.facts.there
    if not there.carrier:
        cannot_look("no carrier")
    mbits, duplex = known(machine.facts.settings)
    values: dict[str, Any] = {"mbits": mbits, "duplex": duplex}
    text = f"{mbits or 'unknown'} Mbit/s, {duplex or 'unknown'} duplex"
    name = machine.shown
    if there.kind or (mbits is None and duplex is None):
        yield ok(text, "not meaningful for a virtual interface", **values)
    elif duplex == "half":
        yield bad(text, "EtherCAT needs full duplex", f"sudo ethtool -s {name} autoneg on", **values)
    elif mbits is not None and mbits < _ETHERCAT_SPEED:
        yield bad(
            text, "EtherCAT is 100 Mbit/s: check the cable", f"sudo ethtool -s {name} autoneg on", **values
        )
    elif mbits is not None and mbits > _ETHERCAT_SPEED:
        yield warning(
            text,
            "sensors use 100 Mbit/s, so there is a switch or another device in between, which delays frames: "
            "connect the sensor, or its PoE injector, directly",
            **values,
        )
    else:
        yield ok(text, **values)


def driver(machine: Machine) -> Iterator[Finding]:
    """The network card, and how it is connected."""
    there, name = machine.facts.there, machine.ifname
    found, bus = known(machine.facts.driver)
    values: dict[str, Any] = {"driver": found, "bus": bus}
    text = f"{found} on {bus}" if bus and bus != "N/A" else found
    if any(machine.path(f"/sys/class/net/{name}/{mark}").exists() for mark in ("wireless", "phy80211")):
        yield bad(text, "a wireless interface: EtherCAT needs a cable", "ethercat-sensor adapters", **values)
    elif bus.startswith("usb"):
        why = "USB polls an adapter every 125 µs at best: prefer a PCIe card"
        yield warning(f"{text}, USB", why, **values)
    elif found in _GUEST_DRIVERS:
        why = "a virtual card: each frame goes through the host; pass a physical card through"
        yield warning(text, why, **values)
    else:
        yield ok(text + (f", {there.kind}" if there.kind and there.kind != found else ""), **values)


def coalescing(machine: Machine) -> Iterator[Finding]:
    """Whether the card delays its interrupts."""
    machine.facts.there  # noqa: B018 - there must be one
    found = machine.facts.coalescing
    if isinstance(found, str):
        yield _not_supported(found)
        return
    on = [f"{name[:2]} {found.get(name, 0)} µs" for name in _DELAYS if found.get(name)]
    on += [f"adaptive {name.split('_')[2]}" for name in _ADAPTIVE if found.get(name)]
    values: dict[str, Any] = {name: found.get(name) for name in (*_DELAYS, *_ADAPTIVE)}
    if not on:
        yield ok("off", **values)
        return
    adaptive = " adaptive-rx off adaptive-tx off" if any(found.get(name) for name in _ADAPTIVE) else ""
    yield warning(
        ", ".join(on), "the card delays the interrupt for a received frame by up to that",
        f"sudo ethtool -C {machine.shown}{adaptive} rx-usecs 0 tx-usecs 0", **values,
    )  # fmt: skip


def offloads(machine: Machine) -> Iterator[Finding]:
    """Segmentation and receive offloads, which are for TCP."""
    there = machine.facts.there
    found: Mapping[str, bool] = known(machine.facts.offloads)
    on = [short for name, short in _UNWANTED.items() if found.get(name)]
    if not on or there.kind:
        yield ok(f"{', '.join(on)} on, without effect on a virtual interface" if on else "off", on=on)
        return
    yield note(
        f"{', '.join(on)} on", "meant for TCP; some drivers delay other frames because of them",
        f"sudo ethtool -K {machine.shown} {' '.join(f'{short} off' for short in on)}", on=on,
    )  # fmt: skip


def energy_efficient_ethernet(machine: Machine) -> Iterator[Finding]:
    """Energy-efficient Ethernet."""
    machine.facts.there  # noqa: B018 - there must be one
    found = machine.facts.eee
    if isinstance(found, str):
        yield _not_supported(found)
        return
    enabled, active = found
    values: dict[str, Any] = {"enabled": enabled, "active": active}
    mend = f"sudo ethtool --set-eee {machine.shown} eee off"
    if active:
        yield warning("in use", "the link sleeps between frames, and waking takes tens of µs", mend, **values)
    elif enabled:
        yield note("enabled, not in use", "another device on the cable could negotiate it", mend, **values)
    else:
        yield ok("off", **values)


def _not_supported(why: str) -> Finding:
    if "not support" not in why:
        cannot_look(why)
    return ok("none: the driver does not support it")


def counters(machine: Machine) -> Iterator[Finding]:
    """Error counters of the card since it came up."""
    there = machine.facts.there
    found, name = there.counters, machine.shown
    if not found:
        cannot_look("the kernel provides no counters")
    errors = {key: found[key] for key in _ERRORS if found.get(key)}
    drops = {key: found[key] for key in _DROPS if found.get(key)}
    values: dict[str, Any] = {**errors, **drops, "carrier_changes": there.carrier_changes}
    if errors:
        why = "frames were corrupted: check cable, connectors, shield and sources of interference"
        yield warning(_counted(errors), why, f"ip -s -s link show {name}", **values)
    elif drops:
        why = "includes frames of unknown protocols; see 'card meanwhile' for new ones"
        yield note(_counted(drops), why, f"ip -s -s link show {name}", **values)
    elif (there.carrier_changes or 0) > _FEW_CARRIER_CHANGES:
        yield note(
            f"{there.carrier_changes} carrier changes",
            "a loose connector, or a sensor that is often power-cycled",
            f"ip -s -s link show {name}", **values,
        )  # fmt: skip
    else:
        yield ok(f"no errors in {found.get('rx_packets', 0)} frames received", **values)


def rising(before: Mapping[str, int], after: Mapping[str, int]) -> Iterator[Finding]:
    """Errors that the card counted during the measurement."""
    if not before or not after:
        cannot_look("the kernel provides no counters")
    new = {key: after.get(key, 0) - before.get(key, 0) for key in (*_ERRORS, *_DROPS)}
    new = {key: count for key, count in new.items() if count > 0}
    if any(key in _ERRORS for key in new):
        why = "frames are being corrupted: check cable, connectors, shield and sources of interference"
        yield bad(_counted(new), why, **new)
    elif new:
        yield note(_counted(new), "frames of unknown protocols, or a receive buffer overflow", **new)
    else:
        yield ok("no new errors", "", **new)


def _counted(found: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in found.items())


def device_names(machine: Machine) -> set[str]:
    """Names that the interface's interrupts may have: its own, and those of its devices."""
    names = {machine.ifname}
    if machine.facts.there.parent:
        names.add(machine.facts.there.parent)
    folder = machine.path(f"/sys/class/net/{machine.ifname}/device")
    if folder.exists():
        names.add(os.path.basename(os.path.realpath(folder)))  # noqa: PTH119 - a link's target's name
    return names

"""The kernel: preemption model, timer resolution, clock source, limits on real-time programs."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, Final

from ethercat_server.doctor.finding import Finding, bad, cannot_look, note, ok, warning
from ethercat_server.doctor.machine.machine import Machine

_SWITCH: Final = "/sys/kernel/debug/sched/preempt"
_MOUNT: Final = "sudo mount -t debugfs none /sys/kernel/debug"
_MODELS: Final = {"none": "NONE", "voluntary": "VOLUNTARY", "full": "", "lazy": "LAZY"}
"""Preemption models and the kernel option that makes each the default: PREEMPT_ and this."""
_GOOD_CLOCKS: Final = frozenset(
    {"tsc", "kvm-clock", "arch_sys_counter", "hyperv_clocksource_tsc_page", "xen"}
)
_USUAL_RUNTIME: Final = 950_000
_USUAL_PERIOD: Final = 1_000_000
_FINE_S: Final = 1e-6


def preemption(machine: Machine) -> Iterator[Finding]:
    """Whether a high-priority program can preempt the kernel."""
    version = machine.text_or("/proc/version")
    config = machine.config
    if machine.text_or("/sys/kernel/realtime") == "1" or "PREEMPT_RT" in version:
        yield ok("fully preemptible (PREEMPT_RT)", model="rt")
        return
    dynamic = "PREEMPT_DYNAMIC" in version or "PREEMPT_DYNAMIC" in config
    model, sure = _model(machine, version, dynamic)
    text = f"{model} (dynamic)" if dynamic else model
    values: dict[str, Any] = {"model": model, "dynamic": dynamic, "certain": sure}
    if not sure:
        text += f", unless changed since boot: {_SWITCH} cannot be read"
    if model in {"full", "lazy"}:
        yield note(
            f"{text}: no real-time kernel",
            "sufficient for most uses; drivers and interrupts may delay the server by some 100 µs under load",
            _real_time_kernel(machine), **values,
        )  # fmt: skip
        return
    why = "kernel code is rarely preempted: under load the server wakes milliseconds late"
    if dynamic:
        mount = () if machine.names("/sys/kernel/debug") or sure else (_MOUNT,)
        yield warning(
            text, f"{why}; to make it permanent, add preempt=full to the kernel command line",
            *mount, f"echo full | sudo tee {_SWITCH}", **values,
        )  # fmt: skip
    else:
        yield warning(text, why, _real_time_kernel(machine), **values)


def _model(machine: Machine, version: str, dynamic: bool) -> tuple[str, bool]:
    chosen = re.search(r"\((\w+)\)", machine.text_or(_SWITCH))
    if chosen:
        return chosen[1], True
    asked = machine.command_line.get("preempt", "")
    if dynamic and asked in _MODELS:
        return asked, True
    config = machine.config
    for model, option in _MODELS.items():
        if f"PREEMPT_{option}".rstrip("_") in config:
            return model, not dynamic
    if "PREEMPT" in version.split():
        return "full", True
    if dynamic:
        return "full", False
    if not version:
        cannot_look("neither /proc/version nor the kernel's configuration can be read")
    return "voluntary", False


def _real_time_kernel(machine: Machine) -> str:
    system = machine.text_or("/etc/os-release")
    if re.search(r"^ID=\"?ubuntu", system, re.MULTILINE):
        return "sudo pro attach && sudo pro enable realtime-kernel"
    return "sudo apt install linux-image-rt-amd64"


def tick(machine: Machine) -> Iterator[Finding]:
    """Whether sleeping programs wake on time, or at the kernel's next tick."""
    rate = machine.config.get("HZ")
    text = f"tick {rate} Hz" if rate else "tick rate unknown"
    values: dict[str, Any] = {
        "hz": int(rate) if rate and rate.isdecimal() else None,
        "resolution_s": machine.timer_resolution_s,
    }
    if machine.timer_resolution_s <= _FINE_S:
        yield ok(f"{text}, high-resolution timers", "wake-ups do not depend on the tick", **values)
        return
    yield bad(
        f"{text}, timers resolve {machine.timer_resolution_s * 1e3:.3g} ms",
        "every wake-up is late by up to that: remove highres=off and nohz=off from the kernel command line, "
        "or use a kernel with CONFIG_HIGH_RES_TIMERS",
        **values,
    )


def clock_source(machine: Machine) -> Iterator[Finding]:
    """The hardware that the kernel reads the time from."""
    folder = "/sys/devices/system/clocksource/clocksource0"
    source = machine.text(f"{folder}/current_clocksource")
    if source in _GOOD_CLOCKS:
        yield ok(source, source=source)
        return
    others = machine.text_or(f"{folder}/available_clocksource").split()
    better = [name for name in others if name in _GOOD_CLOCKS]
    why = "reading the time takes microseconds, and the server does so several times per exchange"
    if better:
        yield warning(source, why, f"echo {better[0]} | sudo tee {folder}/current_clocksource", source=source)
    else:
        log = "'dmesg | grep -i tsc' says why the kernel rejects better ones"
        yield note(source, f"{why}; {log}", source=source)


def throttling(machine: Machine) -> Iterator[Finding]:
    """Share of CPU time that real-time programs may use."""
    runtime = machine.number("/proc/sys/kernel/sched_rt_runtime_us")
    period = machine.number("/proc/sys/kernel/sched_rt_period_us")
    values: dict[str, Any] = {"runtime_us": runtime, "period_us": period}
    mend = f"sudo sysctl kernel.sched_rt_runtime_us={_USUAL_RUNTIME * period // _USUAL_PERIOD}"
    if period <= 0:
        cannot_look("/proc/sys/kernel/sched_rt_period_us is not positive")
    if runtime < 0:
        yield note("off", "a real-time program in an endless loop blocks its processor", mend, **values)
    elif runtime < period // 2:
        yield bad(
            f"real-time programs may use {100 * runtime / period:.0f} % of the CPU time",
            "the server is suspended for the rest of it", mend, **values,
        )  # fmt: skip
    else:
        why = "more than the server needs"
        yield ok(f"real-time programs may use {100 * runtime / period:.0f} % of the CPU time", why, **values)


def group_scheduling(machine: Machine) -> Iterator[Finding]:
    """CONFIG_RT_GROUP_SCHED: real-time priorities only for groups with a real-time budget."""
    if not machine.config:
        cannot_look(f"neither /proc/config.gz nor /boot/config-{machine.release} can be read")
    asked = machine.command_line.get("rt_group_sched")
    off = asked == "0" or ("RT_GROUP_SCHED_DEFAULT_DISABLED" in machine.config and asked != "1")
    if "RT_GROUP_SCHED" not in machine.config or off:
        yield ok("no groups with real-time budgets", enabled=False)
        return
    yield note(
        "real-time budgets per group (CONFIG_RT_GROUP_SCHED)",
        "a service may get no real-time priority at all (the server logs 'not granted'): to switch it off, "
        "add rt_group_sched=0 to the kernel command line",
        enabled=True,
    )

"""The soak: only the server, for long. Does it lose samples, and does its memory grow?"""

from __future__ import annotations

import contextlib
import time
from typing import Any, Final

import numpy as np
from rich.console import Console

from ethercat_server.acquisition.histogram import Distribution
from ethercat_server.virtual_sensor.measurement.signals import decode_clock
from protocol.accounting import NOT_NEW
from protocol.pdo import SampleDecoder
from scripts.benchmarks import statistics
from scripts.benchmarks.chain import Setup, chain, start_server, virtual_bus
from scripts.benchmarks.statistics import Floats
from scripts.demonstration.program import Stopped

_LOOK_EVERY_S: Final = 1.0
_SETTLED: Final = 0.1
"""The memory of this first part of the time does not count: it is still growing to what it needs."""
_FEWEST_LOOKS: Final = 10
_WRAP: Final = 2**24


class Tally:
    """What arrived of each sensor, in fixed memory but for the instants of losses."""

    def __init__(self) -> None:
        self.arrivals = 0
        self.repeated = 0
        self.losses: list[int] = []
        """Instants of the samples that are missing."""
        self.ages = Distribution()
        self._newest: dict[int, int] = {}

    def take(self, position: int, number: int, instant_ns: int, age_ns: int, period_ns: float) -> None:
        """One arrival."""
        self.arrivals += 1
        self.ages.record(age_ns)
        newest = self._newest.get(position)
        step = 1 if newest is None else (number - newest + _WRAP // 2) % _WRAP - _WRAP // 2
        if step <= 0:
            self.repeated += 1
            return
        self._newest[position] = number
        self.losses.extend(int(instant_ns - back * period_ns) for back in range(1, step))


def slope_kb_per_hour(seconds: Floats, rss: Floats) -> float:
    """How fast memory grows: a straight line through it, once settled."""
    settled = seconds >= seconds[0] + _SETTLED * (seconds[-1] - seconds[0])
    return float(np.polyfit(seconds[settled], rss[settled], 1)[0]) * 3600 / 1000


def mb(size: float) -> float:
    """Bytes in MB, rounded."""
    return round(float(size) / 1e6, 2)


def soak(setup: Setup, seconds: float, console: Console) -> dict[str, Any]:
    """Run it and print what came of it. DemoError ends it early; Stopped ends it with what there is."""
    tally, memory = Tally(), []
    with virtual_bus(setup) as (ifname, _), chain(setup) as running:
        running.start_canaries()
        link = start_server(running, ifname)
        server = running.watched["server"]
        link.ask("subscribe")
        decode = SampleDecoder(61).decode
        began = time.monotonic()
        look_at = began + setup.warm_up_s
        with contextlib.suppress(Stopped):
            for frame in link.frames():
                now_ns = time.monotonic_ns()
                if frame.flags & NOT_NEW:
                    continue
                number, instant_ns = decode_clock(decode(frame.process_data).array)
                age_ns = (now_ns - instant_ns) % (2**20 * 10**9)
                tally.take(frame.sensor, number, now_ns - age_ns, age_ns, setup.period_ns)
                now_s = now_ns * 1e-9
                if now_s >= look_at:
                    running.check()
                    memory.append((now_s - began, server.memory_info().rss))
                    look_at += _LOOK_EVERY_S
                    if now_s - began >= seconds:
                        break
        if len(memory) < _FEWEST_LOOKS:
            running.check()
            raise Stopped
        link.close()
        cpu = server.cpu_times()
        used_s = time.monotonic() - began
        running.stop()
        stopped = running.stops()
    seconds_at, rss = np.array(memory, dtype=float).T
    lost = np.array(tally.losses, dtype=float)
    in_stops = int(np.count_nonzero(statistics.covered(lost, setup.period_ns, stopped) >= 0.5))
    result = {
        "seconds": round(used_s, 1),
        "rate_hz": setup.rate_hz,
        "sensors": setup.sensors,
        "arrivals": tally.arrivals,
        "lost": len(lost),
        "lost_in_stops": in_stops,
        "repeated": tally.repeated,
        "machine_stops": len(stopped),
        "age_us": tally.ages.summary_us(),
        "cpu_percent": round(100 * (cpu.user + cpu.system) / used_s, 1),
        "rss_mb": {"first": mb(rss[0]), "last": mb(rss[-1]), "highest": mb(rss.max())},
        "rss_slope_kb_per_hour": round(slope_kb_per_hour(seconds_at, rss), 1) + 0.0,
    }
    for name, value in result.items():
        console.print(f"{name.replace('_', ' '):24} {value}")
    return result

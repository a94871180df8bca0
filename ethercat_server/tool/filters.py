"""`filters`: what each setting of the force/torque filters costs a control loop, and which one suits it.

Definitions, and how sure each figure is: docs/filters.md.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

from bota_ethercat.program.arguments import number
from bota_ethercat.sensor.filters import FORCE_TORQUE_FILTERS, SHORT_SINC, noise_limit
from bota_ethercat.sensor.response import DelaySource, Response, force_torque_response, noise_bandwidth
from bota_ethercat.settings import start_up_defaults
from ethercat_server.tool.command import DONE, Subcommand, argument, columns, say, say_json, value_text

FREQUENCIES_HZ: Final = (5, 10, 20, 50)
DESIGNED_DEG: Final = 60.0  # phase margin of the loop if its sensor were ideal
LEAST_DEG: Final = 30.0  # of it that a recommended setting leaves
_HERTZ: Final = number(0.1, 100_000)
_NOISE_LIMITS: Final = (0.6, 0.1)  # of Fx and Fy by Bota's test, standard deviation, N


class Choice(NamedTuple):
    """One setting of the filters, for one loop."""

    sinc_length: int
    fir: bool
    rate_hz: int
    cutoff_hz: float
    noise: float  # standard deviation, as a multiple of that of the server's default
    noise_limit_n: float | None  # of Fx and Fy, by Bota's limits; None: they do not apply
    response: Response
    margin_deg: float

    @property
    def phases_deg(self) -> list[float]:
        """By how much sines of `FREQUENCIES_HZ` come late."""
        return [self.response.phase_deg(hz) or 0.0 for hz in FREQUENCIES_HZ]

    def as_json(self) -> dict[str, Any]:
        return {
            **{name: getattr(self, name) for name in Choice._fields if name != "response"},
            "delay_ms": self.response.delay_ms,
            "delay_source": self.response.source.value,
            "phase_deg": dict(zip(map(str, FREQUENCIES_HZ), self.phases_deg, strict=True)),
        }

    def cells(self) -> tuple[str, ...]:
        limit = "" if self.noise_limit_n is None else f"{self.noise_limit_n:.2f}"
        return (
            str(self.sinc_length), "on" if self.fir else "off", str(self.rate_hz), f"{self.cutoff_hz:g}",
            f"{self.noise:.2f}", limit, f"{self.response.delay_ms:.2f}",
            *(f"{phase:.0f}°" for phase in self.phases_deg),
            f"{self.margin_deg:.0f}°" if self.margin_deg > 0 else "none",
        )  # fmt: skip


def choices(bandwidth_hz: float) -> list[Choice]:
    """Every setting of Bota's table, for a loop of this bandwidth."""
    default = FORCE_TORQUE_FILTERS[int(start_up_defaults()["sinc_length"])]
    found = []
    for length, row in FORCE_TORQUE_FILTERS.items():
        for fir in (False, True):
            response = force_torque_response({"sinc_length": length, "fir": fir}, row.rate_hz)
            power = noise_bandwidth(fir) * row.rate_hz / (noise_bandwidth(False) * default.rate_hz)
            # The newest sample is half a period old on average when the loop reads it.
            lost = (response.phase_deg(bandwidth_hz) or 0.0) + 360.0 * bandwidth_hz / (2 * row.rate_hz)
            limit = None if fir or length < SHORT_SINC else noise_limit(*_NOISE_LIMITS, length)
            found.append(
                Choice(length, fir, row.rate_hz, row.cutoff_hz(fir), math.sqrt(power), limit, response,
                       DESIGNED_DEG - lost)
            )  # fmt: skip
    return found


def recommend(found: Sequence[Choice], loop_hz: float) -> tuple[Choice, str]:
    """The least noise that leaves enough margin and has a new sample in every cycle, else the most margin."""
    quick = [choice for choice in found if choice.rate_hz >= loop_hz]
    enough = [choice for choice in quick or found if choice.margin_deg >= LEAST_DEG]
    sample = "a new sample in every cycle" if quick else "fewer samples than cycles"
    if enough:
        best = min(enough, key=lambda choice: choice.noise)
        return best, f"the least noise that leaves {LEAST_DEG:g}° of phase margin, with {sample}"
    best = max(quick or found, key=lambda choice: choice.margin_deg)
    late_s = (best.response.delay_s or 0.0) + 0.5 / best.rate_hz
    slower_hz = (DESIGNED_DEG - LEAST_DEG) / 360.0 / late_s
    return best, (
        f"the most phase margin, with {sample}; to have {LEAST_DEG:g}° lower the loop's bandwidth to "
        f"{slower_hz:.0f} Hz"
    )


def _filters(args: argparse.Namespace) -> int:
    bandwidth_hz = args.bandwidth or args.loop / 10
    found = choices(bandwidth_hz)
    best, why = recommend(found, args.loop)
    if args.json:
        say_json({
            "loop_hz": args.loop, "bandwidth_hz": bandwidth_hz,
            "recommended": {"sinc_length": best.sinc_length, "fir": best.fir, "why": why},
            "settings": [choice.as_json() for choice in found],
        })  # fmt: skip
        return DONE
    names = ("SINC", "FIR", "rate", "cut-off", "noise", "limit", "delay", *map(str, FREQUENCIES_HZ), "margin")
    units = ("", "", "Hz", "Hz", "rel.", "N", "ms", *("Hz",) * len(FREQUENCIES_HZ), "")
    say(columns([names, units, *((*each.cells(), "<" * (each is best)) for each in found)]))
    ideal = f"{DESIGNED_DEG:g}° of phase margin with an ideal sensor"
    say(f"loop of {args.loop:g} Hz: bandwidth {bandwidth_hz:g} Hz, {ideal}")
    say(f"recommended: --set sinc_length={best.sinc_length} --set fir={value_text(best.fir)}: {why}")
    say(f"with FAST or CHOP the delay is {DelaySource.UNKNOWN.value}: not for a loop")
    return DONE


_ARGUMENTS: Final = (
    argument("--loop", "rate of the control loop", metavar="HZ", type=_HERTZ, required=True),
    argument("--bandwidth", "its bandwidth (default: loop / 10)", metavar="HZ", type=_HERTZ),
)
COMMANDS: Final = {"filters": Subcommand(_ARGUMENTS, _filters)}

# SPDX-License-Identifier: Apache-2.0
"""Judges what was observed of a sensor's stream. Every sentence of a verdict is here, and nowhere else.

Losses explain a low rate, and silence explains repeated and invalid frames: what is explained is not found.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final, NamedTuple

from bota_ethercat.health.advice import IT_TELLS, STOOD_STILL
from bota_ethercat.health.limits import LIMITS, About, Finding, Level, StreamLimits, Verdict, verdict
from bota_ethercat.health.sentences import did_not_read
from bota_ethercat.pdo import AXES
from bota_ethercat.replies import EmergencyStatus
from bota_ethercat.sensor.warnings_register import Severity, WarningFlag, explain


class Observation(NamedTuple):
    """What was seen of one sensor's stream in some time. None and 0 where nothing is known."""

    seconds: float = 0.0  # how long it was observed
    samples: int = 0  # new ones
    lost: int = 0  # samples that did not come: lost on the bus or in the server, or not read in time
    skipped: int = 0  # samples that came, but too old
    repeated: int = 0
    invalid: int = 0  # frames
    silent_s: float = 0.0  # the longest time without a new sample, up to the end of the observation
    held_s: float = 0.0  # of that, the time by which samples that had been made came later
    unread_s: float = 0.0  # the longest time in which the program that observes did not look for samples
    busy: bool | None = None  # whether it did other things meanwhile; None: unknown
    rate_hz: float | None = None  # new samples a second, by their stamps
    nominal_hz: float = 0.0
    age_p99_us: float | None = None  # of the samples on arrival; None on another machine than the server's
    not_finite: int = 0  # samples with values that are not finite
    # The bits of the warnings register that were set in any sample; likewise of the saturation fields.
    warnings: int = 0
    force_torque_saturated: int = 0
    acceleration_saturated: int = 0
    angular_rate_saturated: int = 0
    temperature: float | None = None
    locked: bool | None = None  # whether the server follows the sensor's clock
    recoveries: int = 0
    missed_deadlines: int = 0  # by the server's loop, in sampling periods
    reconnects: int = 0
    is_lost: bool = False  # the server says that it has lost the sensor
    lost_because: str = ""  # what it said when it lost it
    state: str = "OP"  # the sensor's AL state
    server_silent: bool = False  # the server itself owes an answer
    emergency: str = ""  # what the sensor's newest emergency says, if it is new and not over
    drift: str = ""  # how far its zero has drifted, if that is worth a look
    settings: Mapping[str, object] = {}


class Saturation(NamedTuple):
    """One saturation field of the process data."""

    field: str
    axes: tuple[str, ...]  # of its bits, lowest first
    flag: WarningFlag


SATURATIONS: Final = (
    Saturation("force_torque_saturated", AXES, WarningFlag.FORCE_TORQUE_SATURATED),
    Saturation("acceleration_saturated", ("ax", "ay", "az"), WarningFlag.ACCELERATION_SATURATED),
    Saturation("angular_rate_saturated", ("ωx", "ωy", "ωz"), WarningFlag.ANGULAR_RATE_SATURATED),
)
# Bits of an emergency's code; none of them in one that says that an error is over.
_ERROR_CLASS: Final = 0xFF00
# AL states that are, or may be, those of a sensor that streams.
_STREAMING: Final = frozenset({"OP", "?", ""})
_CABLE: Final = "Check its cable and power"
_STOOD_STILL: Final = f"The server's {STOOD_STILL.format(' meanwhile')}"
# Missed deadlines that amount to this time explain why a sensor did not answer, or left OP.
_STANDSTILL_S: Final = 0.02
_STALL_S: Final = 0.02  # a shorter one makes no sample old
# Samples of about this time wait for a program that does not read; what comes then is withheld from it.
_BUFFERED_S: Final = 0.25


def judge(seen: Observation, limits: StreamLimits = LIMITS) -> Verdict:
    """The verdict on a stream."""
    return verdict(_findings(seen, limits))


def _findings(seen: Observation, limits: StreamLimits) -> Iterator[Finding]:
    silent = seen.silent_s > limits.stale_after
    if silent:
        yield _silence(seen, limits)
    elif seen.is_lost:
        yield _trouble("silence", "The server has lost the sensor", _advice(seen))
    elif not seen.samples and seen.state not in _STREAMING:
        yield _trouble("silence", f"The sensor is in state {seen.state}, not OP", "See the server's log")
    yield from _values(seen, limits)
    yield from _losses(seen, limits)
    if not silent and not seen.is_lost:
        yield from _arrival(seen, limits)
    yield from _circumstances(seen)


def _trouble(key: str, found: str, remedy: str, about: About = About.STREAM, size: float = 0.0) -> Finding:
    return Finding(Level.TROUBLE, about, key, found, remedy, size)


def _look(key: str, found: str, remedy: str, about: About = About.STREAM, size: float = 0.0) -> Finding:
    return Finding(Level.LOOK, about, key, found, remedy, size)


def _advice(seen: Observation) -> str:
    """Where to look for the reason why a sensor did not answer."""
    if seen.lost_because:
        return f"The server said: {seen.lost_because}"
    return _STOOD_STILL if _stood_still(seen) else _CABLE


def _stood_still(seen: Observation) -> bool:
    """Whether the server's loop did not run for a time that explains it."""
    return seen.missed_deadlines > _STANDSTILL_S * seen.nominal_hz > 0


def _silence(seen: Observation, limits: StreamLimits) -> Finding:
    why, remedy = who_was_late(seen, limits)
    return _trouble("silence", f"No new sample for {seen.silent_s:.1f} s, {why}", remedy, size=seen.silent_s)


def who_was_late(seen: Observation, limits: StreamLimits = LIMITS) -> tuple[str, str]:
    """Why there was no new sample for `silent_s`, and what to do: a clause each.

    From what each knows of itself: this program, whether it looked for samples, or did other things; the
    numbers and stamps of the samples, whether they were made; the frames, whether the sensor answered; the
    server, whether its loop ran and it answers. Who did not look knows nothing of the others.
    """
    least_s = seen.silent_s - limits.stale_after  # what explains this much explains it
    if seen.unread_s >= least_s or seen.held_s >= least_s:
        return _who_held_up(seen, least_s)
    if seen.is_lost or seen.invalid:
        return "the sensor does not answer the bus", _advice(seen)
    if seen.repeated:
        return "the sensor repeats the same sample again and again", "Power-cycle it"
    if seen.server_silent:
        return "the server does not answer", "It is stopped or overloaded"
    if seen.state not in _STREAMING:
        return f"the server has the sensor in state {seen.state}, not OP", "See its log"
    return "the server sends none", _STOOD_STILL if _stood_still(seen) else "See its log"


def _who_held_up(seen: Observation, least_s: float) -> tuple[str, str]:
    """As `who_was_late`, of samples that were made in time."""
    if seen.unread_s >= least_s:
        return did_not_read(seen.unread_s, busy=seen.busy)
    return "they came late", "The network, or the server's computer, is too slow"


def _values(seen: Observation, limits: StreamLimits) -> Iterator[Finding]:
    """What is wrong with the samples themselves."""
    if seen.not_finite:
        remedy = "Power-cycle the sensor; if it persists, contact support"
        yield _trouble("not_finite", "Samples have values that are not finite", remedy)
    if seen.settings.get("calibration_matrix") is False:
        found = "settings.calibration_matrix is off, force and torque are counts and not N and Nm"
        yield _trouble("calibration_matrix", found, "Switch it on", About.SENSOR)
    axes = saturated_axes(seen)
    register = seen.warnings
    for flag in axes:
        register |= flag
    for row in explain(register):
        level = Level.LOOK if row.severity is Severity.WARNING else Level.TROUBLE
        where = f": {', '.join(axes[row.flag])}" if row.flag in axes else ""
        yield Finding(level, About.SENSOR, f"warning {row.flag}", f"{row.meaning}{where}", row.remedy)
    if seen.temperature is not None:
        yield from _temperature(seen.temperature, limits)


def _temperature(celsius: float, limits: StreamLimits) -> Iterator[Finding]:
    if celsius >= limits.temperature_warn:
        make, found = (
            _trouble if celsius >= limits.temperature_error else _look,
            f"The sensor has {celsius:.1f} °C",
        )
        yield make("temperature", found, "Let it cool down", About.SENSOR, celsius)
    elif celsius < limits.coldest:
        found = f"The sensor says {celsius:.1f} °C, which its electronics cannot have"
        yield _look("temperature", found, "Do not use it; contact support", About.SENSOR)


def saturated_axes(seen: Observation) -> dict[int, list[str]]:
    """The saturated axes, by their flag in the warnings register."""
    found = {}
    for field, axes, flag in SATURATIONS:
        if bits := getattr(seen, field):
            names = [name for place, name in enumerate(axes) if bits >> place & 1]
            found[int(flag)] = names or ["an undefined axis"]
    return found


def _losses(seen: Observation, limits: StreamLimits) -> Iterator[Finding]:
    if seen.lost >= limits.lost_warn:
        total = seen.samples + seen.lost
        found = f"{seen.lost} of {total} samples ({_percent(seen.lost, total)}) were lost"
        remedy = f"The machine is too busy or the cable is bad; {IT_TELLS}"
        # Whatever took it off the bus has taken its samples, too.
        if seen.recoveries or seen.is_lost or seen.lost_because:
            remedy = _advice(seen)
        if seen.unread_s > _BUFFERED_S:
            why, advice = did_not_read(seen.unread_s, busy=seen.busy)
            found, remedy = f"{found}, {why}", advice
        level = _many(seen.lost, total, seen, limits)
        yield Finding(level, About.STREAM, "lost", found, remedy, seen.lost)
    if seen.skipped >= limits.lost_warn:
        why, remedy = _who_held_up(seen, _STALL_S)
        yield _look("skipped", f"{seen.skipped} old samples skipped, {why}", remedy, size=seen.skipped)
    if seen.recoveries:
        times = "once" if seen.recoveries == 1 else f"{seen.recoveries} times"
        yield _look("recoveries", f"The server lost the sensor {times} and has it back", _advice(seen))


def _many(count: int, total: int, seen: Observation, limits: StreamLimits) -> Level:
    period_s = 1 / seen.nominal_hz if seen.nominal_hz else seen.seconds / max(total, 1)
    many = count > limits.lost_error * total and count * period_s >= limits.lost_error_s
    return Level.TROUBLE if many else Level.LOOK


def _frames(count: int) -> str:
    return "1 frame was" if count == 1 else f"{count} frames were"


def _percent(part: int, total: int) -> str:
    percent = 100 * part / total
    return f"{percent:.0f} %" if percent >= 10 else f"{percent:.2g} %"


def _arrival(seen: Observation, limits: StreamLimits) -> Iterator[Finding]:
    """How the samples arrive, of a stream that is not silent."""
    yield from _rate(seen, limits)
    if seen.invalid >= limits.lost_warn:
        found = f"{_frames(seen.invalid)} invalid, the sensor did not answer the bus"
        level = _many(seen.invalid, seen.samples + seen.invalid, seen, limits)
        yield Finding(level, About.STREAM, "invalid", found, _advice(seen), seen.invalid)
    if seen.repeated >= limits.lost_warn:
        found = f"{_frames(seen.repeated)} repeated, the sensor had nothing new"
        yield _look("repeated", found, "If it goes on, power-cycle it", size=seen.repeated)
    if seen.age_p99_us is not None and seen.age_p99_us >= limits.age_warn * 1e6:
        make = _trouble if seen.age_p99_us >= limits.age_error * 1e6 else _look
        found = f"Samples are {seen.age_p99_us / 1000:.1f} ms old on arrival (p99)"
        remedy = "This machine, or the program that reads, is busy"
        yield make("age", found, remedy, size=seen.age_p99_us)


def _rate(seen: Observation, limits: StreamLimits) -> Iterator[Finding]:
    rate, nominal = seen.rate_hz, seen.nominal_hz
    if rate is None or not nominal or seen.unread_s > _BUFFERED_S:
        return
    # One sample more or less at either end of a short observation is no deviation.
    slack = 2.0 / seen.seconds if seen.seconds > 0 else 2.0
    without = seen.lost + seen.invalid + seen.repeated  # periods without a sample that have a finding already
    with_lost = min(rate * (1 + without / max(seen.samples, 1)), nominal) if rate < nominal else rate
    off = max(abs(with_lost - nominal) - slack, 0.0) / nominal
    if off > limits.rate_tolerance:
        make = _trouble if off > limits.rate_error else _look
        found = f"{rate:.0f} samples a second instead of {nominal:g}"
        yield make("rate", found, "The filters in effect are not those of the settings: set them again")


def _circumstances(seen: Observation) -> Iterator[Finding]:
    if seen.emergency:
        yield _look("emergency", seen.emergency, "If it comes again, contact support", About.SENSOR)
    if seen.drift:
        yield _look("drift", seen.drift, "Re-tare advised", About.SENSOR)
    if seen.settings.get("coordinate_system") is True:
        found = "settings.coordinate_system is on, force and torque are in a frame configured in the sensor"
        yield _look("coordinate_system", found, "Switch it off, or correct the URDF", About.SENSOR)
    if seen.locked is False:
        found = "The server does not follow the sensor's clock (yet), stamps are less exact"
        yield _look("clock", found, "If it goes on, the machine is too busy", About.CLOCK)
    if seen.reconnects:
        found = "The connection to the server was interrupted"
        yield _look("reconnects", found, "If it happens again, see the server's log", About.LINK)


def emergency(last: EmergencyStatus) -> str:
    """An emergency of a sensor in words; empty if there is none, or one that says that an error is over."""
    if last.code is None or not last.code & _ERROR_CLASS:
        return ""
    return f"Emergency 0x{last.code:04X} ({last.text})"

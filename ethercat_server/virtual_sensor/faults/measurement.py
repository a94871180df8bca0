"""Faults of the measurement: warnings, channels, skipped samples, clock; and other signals."""

from __future__ import annotations

from typing import Final

from ethercat_server.virtual_sensor.faults.command import Call, CommandError, FaultCommand, real, whole
from ethercat_server.virtual_sensor.measurement.disturbance import CHANNELS, MOST_SKIPPED, Disturbances
from ethercat_server.virtual_sensor.measurement.signals import SIGNALS

PPM_LIMIT: Final = 100_000.0


def _warn(call: Call) -> None:
    bits = whole(call.arguments[0], 0, 0xFFFFFFFF)
    samples = whole(call.arguments[1], 1, 2**31) if len(call.arguments) > 1 else None
    call.life.sampler.set_warnings(bits, samples)


def _stick(call: Call) -> None:
    call.life.sampler.stick()


def _unstick(call: Call) -> None:
    call.life.sampler.unstick()


def _channel(call: Call) -> tuple[str, Disturbances]:
    name = call.arguments[0].lower()
    if name not in CHANNELS:
        raise CommandError(f"no channel {name[:40]!r}: available: {', '.join(CHANNELS)}")
    sampler = call.life.sampler
    if sampler.exact:
        raise CommandError("the signal `clock` has no channel faults: use another one")
    sampler.disturbed()
    return name, sampler.disturbances


def _noise(call: Call) -> None:
    channel, disturbances = _channel(call)
    disturbances.set_noise(channel, real(call.arguments[1], 0, 1e6))


def _limit(call: Call) -> None:
    channel, disturbances = _channel(call)
    text = call.arguments[1]
    disturbances.set_limit(channel, None if text == "off" else real(text, 0, 1e6))


def _freeze(call: Call) -> None:
    channel, disturbances = _channel(call)
    disturbances.freeze(channel, True)


def _thaw(call: Call) -> None:
    channel, disturbances = _channel(call)
    disturbances.freeze(channel, False)


def _skip(call: Call) -> None:
    call.life.sampler.set_skip(real(call.arguments[0], 0, MOST_SKIPPED))


def _ppm(call: Call) -> None:
    call.sensor.set_ppm(real(call.arguments[0], -PPM_LIMIT, PPM_LIMIT))


def _signal(call: Call) -> None:
    name = call.arguments[0].lower()
    if name not in SIGNALS:
        raise CommandError(f"no signal {name[:40]!r}: available: {', '.join(SIGNALS)}")
    call.sensor.set_signal(name)


COMMANDS: Final[tuple[FaultCommand, ...]] = (
    FaultCommand(
        "warn", "warn BITS [SAMPLES] [@N]", (1, 2), "set warnings, permanently or for some samples", _warn
    ),
    FaultCommand("stick", "stick [@N]", (0,), "repeat the same process data", _stick),
    FaultCommand("unstick", "unstick [@N]", (0,), "end `stick`", _unstick),
    FaultCommand(
        "noise", "noise CHANNEL DEVIATION [@N]", (2,),
        "add noise of this standard deviation to a channel; 0 ends it", _noise,
    ),
    FaultCommand(
        "limit", "limit CHANNEL VALUE|off [@N]", (2,), "saturate a channel at plus and minus VALUE", _limit
    ),
    FaultCommand("freeze", "freeze CHANNEL [@N]", (1,), "freeze a channel at its next value", _freeze),
    FaultCommand("thaw", "thaw CHANNEL [@N]", (1,), "end `freeze`", _thaw),
    FaultCommand(
        "skip", "skip PERCENT [@N]", (1,), "skip this percentage of the samples at random; 0 ends it", _skip
    ),
    FaultCommand("ppm", "ppm X [@N]", (1,), "set the error of the sensor's clock", _ppm),
    FaultCommand("signal", "signal NAME [@N]", (1,), "measure another signal, from its beginning", _signal),
)  # fmt: skip

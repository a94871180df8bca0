"""`ethercat-virtual-sensor IFACE`: the command line of the virtual sensor."""

from __future__ import annotations

import argparse
import contextlib
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Final

from bota_ethercat.pdo import LAYOUTS
from bota_ethercat.program.completion import add_completion
from bota_ethercat.settings import SETTINGS
from ethercat_server import __version__
from ethercat_server.errors import InterfaceError
from ethercat_server.ethercat.nic import look_up
from ethercat_server.sensor.objects.dictionary import MODELS
from ethercat_server.virtual_sensor import link
from ethercat_server.virtual_sensor.control import ControlError
from ethercat_server.virtual_sensor.dc.kinds import CLOCK_WORDS, ClockWordError, parse_clock
from ethercat_server.virtual_sensor.faults.command import CommandError, real, whole
from ethercat_server.virtual_sensor.faults.measurement import PPM_LIMIT
from ethercat_server.virtual_sensor.faults.table import COMMANDS
from ethercat_server.virtual_sensor.foreign.chain import (
    MOST_SLAVES,
    SENSOR,
    ChainError,
    parse_chain,
    slaves_in,
)
from ethercat_server.virtual_sensor.foreign.kinds import KINDS
from ethercat_server.virtual_sensor.measurement.signals import SIGNALS
from ethercat_server.virtual_sensor.options import (
    EEPROM_MS,
    WRITE_US,
    BusOptions,
    ForeignOptions,
    SensorOptions,
)

_SERIAL_NUMBERS: Final = 100
"""For each bus: more than it has slaves."""


class UsageError(Exception):
    """Contradictory arguments."""


def build_parser() -> argparse.ArgumentParser:
    """The command line."""
    commands = "\n".join(f"  {c.usage:34} {c.meaning}" for c in COMMANDS)
    words = "\n".join(f"  {f'{w.name} {w.values}':34} {w.meaning}" for w in CLOCK_WORDS)
    parser = argparse.ArgumentParser(
        prog="ethercat-virtual-sensor",
        description="Answer EtherCAT frames on a network interface as Bota force/torque sensors do, "
        "and other slaves beside them.",
        epilog=f"commands, one per line on stdin or on the --control socket:\n{commands}\n\n"
        f"of a distributed clock, in --dc or as a command:\n{words}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    several = "; several, comma separated or repeated, for a chain"
    parser.add_argument("iface", metavar="IFACE", help="interface, for instance one end of a veth pair")
    parser.add_argument(
        "--chain", metavar="SLAVES", help=f"all slaves in wire order: {SENSOR}, {', '.join(KINDS)}; "
        "KIND:STATE if another master has left one in this AL state",
    )  # fmt: skip
    parser.add_argument("--sensors", metavar="N", help="sensors on the bus (default: as many as named, or 1)")
    parser.add_argument("--model", action="append", metavar="NAME", help=f"default {MODELS[0]}{several}")
    parser.add_argument(
        "--serial", action="append", metavar="N", help=f"default: by the interface's MAC address{several}"
    )
    parser.add_argument(
        "--pdo", choices=[str(n) for n in LAYOUTS], default="61", help="bytes of process data"
    )
    parser.add_argument("--sinc", metavar="N", help="SINC length after power-on (default 64)")
    parser.add_argument("--ppm", action="append", metavar="X", help=f"clock error{several}")
    parser.add_argument(
        "--dc", action="append", metavar="WORD[=VALUE][+...]", help=f"distributed clock, see below{several}"
    )
    parser.add_argument(
        "--write-us", default=str(WRITE_US), metavar="X",
        help=f"time of the firmware's write of a sample to the controller (default {WRITE_US:g})",
    )  # fmt: skip
    parser.add_argument("--signal", choices=SIGNALS, default="scene", help="measured signal (default scene)")
    parser.add_argument("--noise", choices=("on", "off"), default="on", help="noise of the scene")
    parser.add_argument("--seed", default="0", metavar="N", help="seed of the noise")
    parser.add_argument(
        "--eeprom-ms",
        default=str(EEPROM_MS),
        metavar="X",
        help=f"time of an EEPROM read (default {EEPROM_MS:g})",
    )
    parser.add_argument("--control", metavar="PATH", help="Unix socket for commands")
    parser.add_argument("--exit-on-eof", action="store_true", help="end when stdin ends")
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    add_completion(parser)
    return parser


def _list(given: Sequence[str] | None) -> list[str]:
    return [word for text in given or () for word in text.split(",") if word]


def _number_of(ifname: str) -> int:
    """Of an interface: another has another, and it is the same after a restart."""
    try:
        return int.from_bytes(look_up(ifname).address[3:])
    except InterfaceError:  # said when it is to be opened
        return 0


def options_from(args: argparse.Namespace, default_serial: int = 1) -> BusOptions:
    """The options in parsed arguments; UsageError if they are contradictory."""
    try:
        chain = None if args.chain is None else parse_chain(args.chain)
    except ChainError as error:
        raise UsageError(str(error)) from None
    in_chain = sum(kind == SENSOR for kind, _ in chain or ())
    if chain is not None and args.sensors is not None:
        raise UsageError("--chain names the sensors too: leave --sensors out")
    models, serials, errors = _list(args.model), _list(args.serial), _list(args.ppm)
    clocks = _list(args.dc)
    named = max(len(models), len(serials), len(errors), len(clocks), chain is None)
    sinc_range = SETTINGS["sinc_length"].choices
    assert isinstance(sinc_range, range)
    try:
        option = "--sensors"
        count = whole(args.sensors, 1, MOST_SLAVES) if args.sensors is not None else named
        count = count if chain is None else in_chain
        option = "--seed"
        seed = whole(args.seed, 0, 2**63)
        option = "--sinc"
        sinc = None if args.sinc is None else whole(args.sinc, sinc_range[0], sinc_range[-1])
        option = "--serial"
        serial_numbers = [whole(text, 0, 0xFFFFFFFF) for text in serials]
        option = "--eeprom-ms"
        eeprom_ms = real(args.eeprom_ms, 0, 1000)
        option = "--write-us"
        write_us = real(args.write_us, 0, 1000)
        option = "--dc"
        for text in clocks:
            parse_clock(text)
        option = "--ppm"
        ppms = [real(text, -PPM_LIMIT, PPM_LIMIT) for text in errors]
    except (CommandError, ClockWordError) as error:
        raise UsageError(f"{option}: {error}") from None
    if named > count:
        raise UsageError(f"{named} sensors are named but there are to be {count}: name no more than that")
    for model in models:
        if not model.isascii() or len(model) > 20:
            raise UsageError(f"model {model!r} must have at most 20 ASCII characters, such as {MODELS[0]}")
    sensors = []
    for position in range(count):
        first_serial = serial_numbers[-1] if serial_numbers else default_serial
        given = len(serial_numbers) - 1 if serial_numbers else 0
        sensors.append(
            SensorOptions(
                # The last one applies to the rest; serial numbers are consecutive.
                model=models[min(position, len(models) - 1)] if models else MODELS[0],
                serial=serial_numbers[position]
                if position < len(serial_numbers)
                else first_serial + position - given,
                pdo_size=int(args.pdo),
                sinc_length=sinc,
                ppm=ppms[min(position, len(ppms) - 1)] if ppms else 0.0,
                dc=clocks[min(position, len(clocks) - 1)] if clocks else "",
                write_us=write_us,
                signal=args.signal,
                noise=args.noise == "on",
                seed=seed + position,
                eeprom_ms=eeprom_ms,
            )
        )
    return BusOptions(tuple(sensors) if chain is None else slaves_in(chain, sensors, eeprom_ms))


@contextlib.contextmanager
def _stop_signals() -> Iterator[Callable[[], bool]]:
    """SIGTERM and SIGINT only set a flag; yields its getter."""
    stopped = False

    def stop(_number: int, _frame: object) -> None:
        nonlocal stopped
        stopped = True

    previous = {number: signal.signal(number, stop) for number in (signal.SIGTERM, signal.SIGINT)}
    # As a background job, reading from the terminal must not suspend it.
    previous[signal.SIGTTIN] = signal.signal(signal.SIGTTIN, signal.SIG_IGN)
    try:
        yield lambda: stopped
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def main(
    argv: Sequence[str] | None = None, on_open: Callable[[], None] = lambda: None, number: int = 0
) -> int:
    """Run the virtual sensor: 0 when ended, 1 on failure, 2 for wrong arguments.

    `on_open` is called once its interface is open, before it reads anything. The default serial numbers go by
    `number`, or by the interface's MAC address.
    """
    args = build_parser().parse_args(argv)
    try:
        first_serial = _SERIAL_NUMBERS * (number or _number_of(args.iface))
        options = options_from(args, first_serial or 1)
        if len(args.iface.encode()) > link.LONGEST_NAME:
            raise UsageError(f"interface name {args.iface!r} is longer than {link.LONGEST_NAME} characters")
    except UsageError as error:
        print(f"ethercat-virtual-sensor: {error}", file=sys.stderr)
        return 2
    models = ", ".join(dict.fromkeys(sensor.model for sensor in options.sensors))
    foreign = [slave.kind for slave in options.slaves if isinstance(slave, ForeignOptions)]

    def ready() -> None:
        print(
            f"ready: {len(options.sensors)} sensor(s) {models} on {args.iface}, "
            f"{args.pdo} bytes of process data, signal {args.signal}"
            + (f", beside {', '.join(foreign)}" if foreign else ""),
            flush=True,
        )

    try:
        with _stop_signals() as stopped:
            link.run(
                args.iface,
                options,
                control_path=args.control,
                commands=sys.stdin,
                exit_on_eof=args.exit_on_eof,
                on_open=on_open,
                on_ready=ready,
                should_stop=stopped,
            )
    except (link.LinkError, ControlError) as error:
        print(f"ethercat-virtual-sensor: {error}", file=sys.stderr)
        return 1
    return 0

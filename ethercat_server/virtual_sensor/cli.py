"""`ethercat-virtual-sensor IFACE`: the command line of the virtual sensor."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any, Final

from bota_ethercat.pdo import LAYOUTS
from bota_ethercat.program.arguments import Parser, number, of_type, whole
from bota_ethercat.program.output import ends_with_its_reader
from bota_ethercat.program.real_time import make_real_time
from bota_ethercat.program.signals import signals_call
from bota_ethercat.settings import SETTINGS
from ethercat_server.errors import InterfaceError
from ethercat_server.ethercat.options import ALLOW_IP, ALLOW_IP_HELP
from ethercat_server.sensor.models import MODELS
from ethercat_server.virtual_sensor.distributed_clock import CLOCK_WORDS, parse_clock
from ethercat_server.virtual_sensor.fault import PPM_LIMIT
from ethercat_server.virtual_sensor.faults import COMMANDS
from ethercat_server.virtual_sensor.options import (
    FAULT,
    KINDS,
    LOST,
    MOST_SLAVES,
    SENSOR,
    ForeignOptions,
    SensorOptions,
    SlaveOptions,
    UsageError,
    model_name,
    parse_chain,
    slaves_in,
)
from ethercat_server.virtual_sensor.signals import SIGNALS

_PROGRAM: Final = "ethercat-virtual-sensor"
_SERIAL_NUMBERS: Final = 100  # for each bus: more than it has slaves


def _clock(text: str) -> str:
    list(parse_clock(text))
    return text


def _each(parse: Callable[[str], Any]) -> Callable[[str], list[Any]]:
    return lambda text: [parse(word) for word in text.split(",") if word]


_SEVERAL: Final = "; for several sensors comma separated or repeated"
_ALONG_THE_CHAIN: Final[tuple[tuple[str, str, Callable[[str], Any], str], ...]] = (
    ("model", "NAME", model_name, f"model (default {MODELS[0]})"),
    ("serial", "N", whole(0, 2**32 - 1), "serial number (default: derived from the interface's MAC address)"),
    ("ppm", "X", number(-PPM_LIMIT, PPM_LIMIT), "error of the sensor's clock, positive if fast"),
    ("dc", "WORD[=VALUE][+...]", _clock, "faults of the distributed clock, listed below"),
)


def build_parser() -> argparse.ArgumentParser:
    """The command line."""
    commands = "\n".join(f"  {c.usage:34} {c.meaning}" for c in COMMANDS)
    words = "\n".join(f"  {w.usage:34} {w.meaning}" for w in CLOCK_WORDS)
    parser = Parser(
        _PROGRAM,
        "Simulates a chain of Bota force/torque sensors, and of other slaves, on a network interface.",
        f"commands, with --send or one per line on stdin (@N: of sensor N, by default 0):\n{commands}\n\n"
        f"faults of the distributed clock, in --dc or after the command dc:\n{words}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "iface", metavar="IFACE", nargs="?", help="one end of a veth pair, with the master at the other end"
    )
    parser.add_argument(
        "--chain", metavar="SLAVES", type=parse_chain,
        help=f"all slaves in wire order, comma separated, of {SENSOR}, {', '.join(KINDS)}; "
        "with :STATE one that another master has left in this AL state",
    )  # fmt: skip
    parser.add_argument(
        "--sensors", metavar="N", type=whole(1, MOST_SLAVES),
        help="number of sensors (default: as many as the options below name, at least 1)",
    )  # fmt: skip
    for name, metavar, parse, meaning in _ALONG_THE_CHAIN:
        parser.add_argument(
            f"--{name}", metavar=metavar, type=_each(parse), action="extend", default=[],
            help=f"{meaning}{_SEVERAL}",
        )  # fmt: skip
    parser.add_argument(
        "--sinc", metavar="N", type=of_type(SETTINGS["sinc_length"].type),
        help="SINC length after power-on (default 64)",
    )  # fmt: skip
    parser.add_argument(
        "--pdo", choices=[*map(str, LAYOUTS)], default="61", help="bytes of process data (default 61)"
    )
    parser.add_argument("--signal", choices=SIGNALS, default="scene", help="measured signal (default scene)")
    parser.add_argument("--world", metavar="PATH", help="measure what a simulation sends to this Unix socket")
    parser.add_argument(
        "--world-lost",
        choices=LOST,
        default=FAULT,
        help="what is measured when it stops sending: its last values, zeros, or nothing new (default fault)",
    )
    parser.add_argument(
        "--noise", choices=("on", "off", "none"), default="on",
        help="off: only that of the converters' last bit; none: none at all, and a sample that equals the "
        "one before it is not new (default on)",
    )  # fmt: skip
    parser.add_argument(
        "--control", metavar="PATH",
        help="Unix socket for commands (default: one of this user, in /run/user or the temporary directory)",
    )  # fmt: skip
    parser.add_argument(
        "--send",
        metavar="COMMAND",
        help="send a command to the virtual sensor that runs, print its answer and exit",
    )
    parser.add_argument(ALLOW_IP, action="store_true", help=ALLOW_IP_HELP)
    parser.add_argument("--exit-on-eof", action="store_true", help="exit when stdin ends")
    return parser


def _number_of(ifname: str) -> int:
    """Of an interface: another has another, and it is the same after a restart."""
    from ethercat_server.ethercat.nic import look_up  # noqa: PLC0415 - --help need not wait for it

    try:
        return int.from_bytes(look_up(ifname).address[3:])
    except InterfaceError:  # said when it is to be opened
        return 0


def options_from(args: argparse.Namespace, default_serial: int = 1) -> tuple[SlaveOptions, ...]:
    """The slaves that parsed arguments ask for; UsageError if they are contradictory."""
    chain, count = args.chain, args.sensors
    if chain is not None and count is not None:
        raise UsageError("--chain names the sensors too: leave --sensors out")
    named = max(map(len, (args.model, args.serial, args.ppm, args.dc)))
    if chain is not None:
        count = sum(kind == SENSOR for kind, _ in chain)
    elif count is None:
        count = max(named, 1)
    if named > count:
        raise UsageError(f"{named} sensors are named but there are to be {count}: name no more than that")

    from ethercat_server.virtual_sensor.world import ExternalWorld  # noqa: PLC0415 - likewise

    def of(given: list[Any], position: int, default: Any) -> Any:
        """The last one applies to the rest."""
        return given[min(position, len(given) - 1)] if given else default

    serials = args.serial or [default_serial]
    sensors = [
        SensorOptions(
            model=of(args.model, position, MODELS[0]),
            serial=(serials + [serials[-1] + n for n in range(1, count)])[position],
            pdo_size=int(args.pdo),
            sinc_length=args.sinc,
            ppm=of(args.ppm, position, 0.0),
            dc=of(args.dc, position, ""),
            signal=args.signal,
            world=ExternalWorld(args.world_lost) if args.world else None,
            noise=args.noise == "on",
            last_bit=args.noise != "none",
            seed=position,
        )
        for position in range(count)
    ]
    return tuple(sensors) if chain is None else slaves_in(chain, sensors)


def _get_priority() -> None:
    """That of SCHED_FIFO above a master's: real sensors do not wait for a CPU."""
    from ethercat_server.process.realtime import DEFAULT_PRIORITY  # noqa: PLC0415 - likewise

    if refused := make_real_time(DEFAULT_PRIORITY + 1).refused:
        _say(f"not granted: {', '.join(refused)}; samples may come late")


@ends_with_its_reader
def main(
    argv: Sequence[str] | None = None, on_open: Callable[[], None] = _get_priority, number: int = 0
) -> int:
    """Run the virtual sensor: 0 when ended, 1 on failure, 2 for wrong arguments.

    `on_open` is called once its interface is open, before it reads anything. The default serial numbers go by
    `number`, or by the interface's MAC address.
    """
    parser = build_parser()
    args = parser.parse_args(argv)
    if args.send is not None:
        return _send(args.control, args.send)
    if args.iface is None:
        parser.error("name an interface, or a command with --send")
    try:
        slaves = options_from(args, _SERIAL_NUMBERS * (number or _number_of(args.iface)) or 1)
    except UsageError as error:
        parser.error(str(error))
    from ethercat_server.virtual_sensor import link  # noqa: PLC0415 - likewise

    stopped = threading.Event()
    models = [slave.model for slave in slaves if isinstance(slave, SensorOptions)]
    foreign = [slave.kind for slave in slaves if isinstance(slave, ForeignOptions)]
    ready = (
        f"ready: {len(models)} sensor(s) {', '.join(dict.fromkeys(models))} on {args.iface}, "
        f"{args.pdo} bytes of process data, signal {args.world or args.signal}"
        + (f", beside {', '.join(foreign)}" if foreign else "")
    )

    def on_ready(note: str) -> None:
        if note:
            _say(note)
        print(ready, flush=True)

    try:
        signal.signal(signal.SIGTTIN, signal.SIG_IGN)  # reading from the terminal must not suspend it
        with signals_call(stopped.set):
            link.run(args, slaves, on_open, on_ready, stopped)
    except link.LinkError as error:
        _say(error)
        return 1
    return 0


def _say(sentence: object) -> None:
    print(f"{_PROGRAM}: {sentence}", file=sys.stderr)


def _send(path: str | None, command: str) -> int:
    """Exit code 0 if the virtual sensor that listens there has obeyed."""
    from ethercat_server.virtual_sensor import link  # noqa: PLC0415 - likewise

    path = path or link.own_socket()
    try:
        answer = link.send(path, command)
    except OSError as error:
        why = error.strerror or error
        _say(f"no virtual sensor of yours answers at {path} ({why}): start one, or give --control")
        return 1
    print(answer.replace(" | ", "\n") if command.split() == ["help"] else answer)
    return int(not answer.startswith("ok"))


if __name__ == "__main__":
    sys.exit(main())

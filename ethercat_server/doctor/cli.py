"""`ethercat-doctor`: the command line."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from bota_ethercat.program import server_choice
from bota_ethercat.program.arguments import Parser, number
from bota_ethercat.program.output import ends_with_its_reader
from ethercat_server.daemon.options import SERVER_SETTINGS
from ethercat_server.ethercat.options import ALLOW_IP, ALLOW_IP_HELP
from ethercat_server.process import command_line

_PROGRAM: Final = "ethercat-doctor"
_EXIT_CODES: Final = "exit codes: 0 good or worth a look, 1 trouble, failed or stopped, 2 wrong arguments"
_LONGEST_S: Final = 3600.0


def build_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = Parser(
        _PROGRAM,
        "Diagnoses latency and lost samples: kernel, processors, network card, other software, "
        "bus; then measures. Read-only. Run as root for a complete report.",
        _EXIT_CODES,
    )
    parser.add_argument(
        "iface", metavar="IFACE", nargs="?",
        help="interface the sensors are connected to ('virtual' for a virtual sensor); by default that of "
        f"the server {server_choice.HELP}; a FILE.trace is shown",
    )  # fmt: skip
    parser.add_argument(
        "--seconds", type=number(0, _LONGEST_S), default=10.0, metavar="N",
        help="duration of the measurement (default 10; 0: none)",
    )  # fmt: skip
    for name in ("rt_priority", "cpu"):
        setting = SERVER_SETTINGS[name]
        parser.add_argument(
            setting.flag, dest=name, type=setting.parse_argument, metavar=setting.metavar,
            default=setting.default, help=f"measure like a server with this option: {setting.meaning}",
        )  # fmt: skip
    parser.add_argument(ALLOW_IP, action="store_true", help=ALLOW_IP_HELP)
    parser.add_argument(
        "--trace", type=Path, metavar="FILE",
        help="only write a trace of the server's last minute to FILE: which samples were late or lost",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="machine-readable output")
    return parser


@ends_with_its_reader
def main(argv: Sequence[str] | None = None) -> int:
    """Run the doctor; returns the exit code. argparse exits with 2."""
    command_line.begin(_PROGRAM)
    # Missing privileges are a finding.
    logging.getLogger("ethercat_server.process.realtime").setLevel(logging.ERROR)
    args = build_parser().parse_args(argv)
    from ethercat_server.doctor.program import run  # noqa: PLC0415 - --help need not wait for it

    return command_line.run(_PROGRAM, lambda: run(args), as_json=args.json)


if __name__ == "__main__":
    sys.exit(main())

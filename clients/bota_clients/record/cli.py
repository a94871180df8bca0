"""`ethercat-record`: the command line; catches signals while the rest is imported."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from bota_clients.arguments import DURATION_UNIT, add_force, add_server, duration, position, server_of
from bota_clients.program import Signals, start
from bota_ethercat.program.arguments import Parser, typed
from bota_ethercat.program.output import ends_with_its_reader
from bota_ethercat.program.server_choice import is_address

# Of other formats: a recording so called would be taken for what it is not.
_OTHERS: Final = {".csv", ".parquet", ".npz", ".npy", ".zarr", ".bag", ".db3", ".json", ".txt", ".hdf5"}


def _duration(text: str) -> float:
    if (value := duration(text)) >= 1e-9:
        return value
    raise ValueError


def parse_options(argv: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line; argparse exits with 2 if it is wrong. `sensors` are ascending; None: all."""
    made = Parser(
        "ethercat-record",
        "Records the unmodified stream of ethercat-server into an MCAP file.",
        "Ctrl-C ends the recording.",
        usage="%(prog)s [options] OUT.mcap",
    )
    add = made.add_argument
    add("name", metavar="OUT.mcap", help="file to write")
    add_server(made)
    add("--sensor", type=position, action="append", dest="sensors", metavar="N",
        help="record only the sensor at this position on the bus; repeatable")  # fmt: skip
    add("--for", "--seconds", type=typed(_duration, "a time such as 30s, 5min or 2h"), dest="seconds",
        metavar="TIME", help="stop after this time: 30, 30s, 5min, 2h")  # fmt: skip
    add_force(made)
    add("--no-reconnect", action="store_false", dest="reconnect",
        help="stop when the connection ends, instead of reconnecting")  # fmt: skip
    words = list(sys.argv[1:] if argv is None else argv)
    for at in range(len(words) - 3, -1, -1):  # `--for 5 minutes`
        if words[at] in ("--for", "--seconds") and re.fullmatch(DURATION_UNIT, words[at + 2]):
            words[at + 1 : at + 3] = [" ".join(words[at + 1 : at + 3])]
    options = made.parse_args(words)
    name: str = options.name
    if is_address(name):
        made.error(
            f"{name} is a server's address, no file: write FILE.mcap --server {name}, "
            f"or ./{name} if a file is called so"
        )
    if Path(name).suffix.lower() in _OTHERS:
        made.error(
            f"{name}: a recording is an MCAP file: write {Path(name).with_suffix('.mcap')}, from which "
            "ethercat-export makes .csv, .parquet, .npz and .zarr"
        )
    options.path, options.address = Path(name), server_of(made, options.server)
    if options.sensors is not None:
        options.sensors = sorted(set(options.sensors))
    return options


@ends_with_its_reader
def main(argv: Sequence[str] | None = None) -> int:
    signals = Signals()
    return start("ethercat-record", "record.program", parse_options(argv), signals)


if __name__ == "__main__":
    sys.exit(main())

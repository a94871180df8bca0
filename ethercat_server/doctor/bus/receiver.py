"""A minimal client in a process of its own, which measures the latency of messages over loopback TCP.

`python -m ethercat_server.doctor.bus.receiver PORT` connects, receives messages until the other end closes,
and writes the number of each and its transit time (ns, native i64 pairs) to standard output.
"""

from __future__ import annotations

import socket
import struct
import sys
import time
from array import array
from typing import Final

SIZE: Final = 94
"""As long as a DATA message with 61 bytes of process data."""
MESSAGE: Final = struct.Struct(f">QQ{SIZE - 16}x")
"""Its number, and when it was sent: CLOCK_MONOTONIC in ns."""


def main(port: int) -> None:
    """Receive, then report."""
    figures = array("q")
    rest = b""
    with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
        connection.settimeout(None)
        while data := connection.recv(65536):
            now = time.monotonic_ns()
            data = rest + data
            whole = len(data) // SIZE * SIZE
            rest = data[whole:]
            for number, sent in MESSAGE.iter_unpack(data[:whole]):
                figures.extend((number, now - sent))
    sys.stdout.buffer.write(figures.tobytes())


if __name__ == "__main__":
    main(int(sys.argv[1]))

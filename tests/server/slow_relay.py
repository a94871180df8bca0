"""Passes EtherCAT frames between two interfaces, the answers late: `slow_relay.py MASTER SLAVE DELAY_S`.

Stands for a bus that is slower than usual. Now and then it holds everything up for 3 ms.
"""

from __future__ import annotations

import collections
import select
import socket
import sys
import time

ETHERCAT = 0x88A4


def open_raw(ifname: str) -> socket.socket:
    raw = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    raw.bind((ifname, ETHERCAT))
    raw.setblocking(False)
    return raw


def main(master_side: str, slave_side: str, delay_s: float) -> None:
    master, slave = open_raw(master_side), open_raw(slave_side)
    late: collections.deque[tuple[float, bytes]] = collections.deque()
    hold_up_at = time.monotonic() + 3
    print("ready", flush=True)
    while True:
        wait = max(0.0, late[0][0] - time.monotonic()) if late else 1.0
        ready, _, _ = select.select((master, slave), (), (), wait)
        if master in ready:
            slave.send(master.recv(2048))
        if slave in ready:
            late.append((time.monotonic() + delay_s, slave.recv(2048)))
        if time.monotonic() > hold_up_at:
            hold_up_at = time.monotonic() + 0.5
            time.sleep(0.003)
        while late and late[0][0] <= time.monotonic():
            master.send(late.popleft()[1])


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]))

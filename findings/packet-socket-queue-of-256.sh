#!/usr/bin/env bash
# Linux packet socket: a receive buffer of 208 KiB holds 256 frames of 60 bytes.
#
# One would guess: 212,992 bytes hold some 3,500 of the shortest frames, 4 s of an EtherCAT bus of 800 Hz, and 140 of
# the longest; so short frames are what is safe.
# What happens: what counts is what the kernel allocated for a frame, 832 bytes for 60, and a longest one costs only
# 2.7 times as much: 256 against 93. What does not fit is dropped without an error; only PACKET_STATISTICS counts it.
# A monitor or a master that stands still for 0.16 s at 1600 Hz begins to lose frames. The same rule holds for UDP and
# Unix datagrams. Seen with Linux 6.18 on veth; with a card, its driver decides what a frame costs. Needs root (a
# network namespace); 77 without.
set -euo pipefail
[ "$(id -u)" = 0 ] || { echo "needs root for a network namespace"; exit 77; }
[ "${1-}" = inside ] || exec unshare --net "$0" inside
ip link add left type veth peer name right
ip link set left up
ip link set right up
echo "Linux $(uname -r)"
python3 - <<'END'
import socket, struct, time

ETHERTYPE, SENT, BUFFER = 0x88A4, 6000, 212_992
SOL_PACKET, PACKET_STATISTICS = 263, 6
time.sleep(0.3)
sender = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
sender.bind(("left", 0))

def queued(size: int) -> tuple[int, int]:
    """Frames that a receiver has which did not read meanwhile, and the dropped ones that the kernel counts."""
    receiver = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER // 2)  # which the kernel doubles
    assert receiver.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) == BUFFER
    receiver.bind(("right", ETHERTYPE))
    receiver.setblocking(False)
    frame = (b"\xff" * 6 + bytes.fromhex("020000000001") + ETHERTYPE.to_bytes(2, "big")).ljust(size, b"\0")
    for _ in range(SENT):
        sender.send(frame)
    time.sleep(0.2)
    found = 0
    while True:
        try:
            receiver.recv(2000)
            found += 1
        except BlockingIOError:
            return found, struct.unpack("II", receiver.getsockopt(SOL_PACKET, PACKET_STATISTICS, 8))[1]

seen = {size: queued(size) for size in (60, 1514)}
for size, (found, dropped) in seen.items():
    print(f"{SENT} frames of {size} bytes: {found} are in a buffer of {BUFFER} bytes, {dropped} were dropped")
assert seen[60][0] < 1000 and seen[1514][0] > 60 and sum(seen[60]) == SENT, "the behavior has changed"
END

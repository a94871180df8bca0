#!/usr/bin/env bash
# Linux bridge: a frame whose source address has the group bit is dropped, without an error anywhere.
#
# One would guess: a bridge forwards every broadcast frame to all its ports, so EtherCAT through a bridge is only slower.
# What happens: a broadcast frame from 02:01:01:01:01:01 passes, the same from 01:01:01:01:01:01 never arrives. SOEM and
# what is built on it (pysoem) send with exactly that source address; masters with the card's own address get through.
# A user meets it when a virtual machine's or a container's bridge, or a managed switch, is between master and slaves:
# "no slaves found" with a good cable. Seen with Linux 6.18. Needs root (a network namespace); 77 without.
set -euo pipefail
[ "$(id -u)" = 0 ] || { echo "needs root for a network namespace"; exit 77; }
[ "${1-}" = inside ] || exec unshare --net "$0" inside
for pair in left right; do
    ip link add "$pair" type veth peer name "$pair-far"
done
ip link add between type bridge
for port in left-far right-far; do ip link set "$port" master between; done
for name in left right left-far right-far between; do ip link set "$name" up; done
echo "Linux $(uname -r)"
python3 - <<'END'
import socket, time

ETHERTYPE = 0x88A4
sender = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
sender.bind(("left", 0))
receiver = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
receiver.bind(("right", ETHERTYPE))
receiver.settimeout(0.5)
time.sleep(0.3)

def arrives(source: str) -> bool:
    frame = b"\xff" * 6 + bytes.fromhex(source.replace(":", "")) + ETHERTYPE.to_bytes(2, "big")
    for _ in range(5):
        sender.send(frame.ljust(60, b"\0"))
    try:
        return receiver.recv(100)[6:12].hex(":") == source
    except TimeoutError:
        return False

seen = {source: arrives(source) for source in ("02:01:01:01:01:01", "01:01:01:01:01:01")}
for source, there in seen.items():
    print(f"broadcast from {source}: {'arrives' if there else 'is dropped'}")
assert seen == {"02:01:01:01:01:01": True, "01:01:01:01:01:01": False}, "the behavior has changed"
END

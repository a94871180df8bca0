#!/usr/bin/env bash
# Linux packet socket: one that is made with a protocol receives from every interface until it is bound to one.
#
# One would guess: `socket(AF_PACKET, SOCK_RAW, htons(0x88A4))` followed by `bind(("ens5", 0))` gives frames of ens5 only.
# What happens: frames that came to any other interface between the two calls are in the queue, are delivered after the
# bind, and only the address that recvfrom returns tells them apart. Made with protocol 0 and bound with the protocol,
# the socket has none of them. An EtherCAT master with two network cards, or beside another master, takes answers of the
# other bus for its own. Needs root (a network namespace); 77 without.
set -euo pipefail
[ "$(id -u)" = 0 ] || { echo "needs root for a network namespace"; exit 77; }
[ "${1-}" = inside ] || exec unshare --net "$0" inside
for pair in mine other; do
    ip link add "$pair" type veth peer name "$pair-far"
    ip link set "$pair" up
    ip link set "$pair-far" up
done
echo "Linux $(uname -r)"
python3 - <<'END'
import socket, time

ETHERTYPE = 0x88A4
time.sleep(0.3)
stranger = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
stranger.bind(("other-far", 0))

def strangers(protocol_at_once: bool) -> list[str]:
    """Interfaces of the frames that a socket has which is bound to `mine`."""
    sock = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETHERTYPE) if protocol_at_once else 0)
    stranger.send((b"\xff" * 6 + bytes.fromhex("020000000001") + ETHERTYPE.to_bytes(2, "big")).ljust(60, b"\0"))
    time.sleep(0.1)
    sock.bind(("mine", ETHERTYPE))
    sock.setblocking(False)
    found = []
    while True:
        try:
            found.append(sock.recvfrom(100)[1][0])
        except BlockingIOError:
            return found

seen = {at_once: strangers(at_once) for at_once in (True, False)}
print(f"made with the protocol, then bound to 'mine': frames of {seen[True]}")
print(f"made with protocol 0, then bound to 'mine': frames of {seen[False]}")
assert "other" in seen[True] and not seen[False], "the behavior has changed"
END

#!/usr/bin/env bash
# Linux: an alternative name of an interface works for sockets if it is short, and never for what reads /sys.
#
# One would guess: the names that `ip link` shows as `altname` (udev gives enx..., enp..., ens...) are good everywhere
# a name is, or nowhere but in `ip`.
# What happens: bind of a packet socket and if_nametoindex take one of up to 15 characters, as `ip` takes any; a
# longer one "does not exist"; /sys/class/net has none of either. A socket that was bound by it tells the first name:
# a program that compares the name of recvfrom with the one that it was given drops every frame. A user meets it with
# an EtherCAT master that opens the name well and then finds neither carrier nor driver. Seen with Linux 6.18, CPython
# 3.11. Needs root (a network namespace); 77 without.
set -euo pipefail
[ "$(id -u)" = 0 ] || { echo "needs root for a network namespace"; exit 77; }
[ "${1-}" = inside ] || exec unshare --net --mount "$0" inside
mount -t sysfs none /sys
ip link add left type veth peer name right
short=enx020000000001 long=a-port-of-the-robot
ip link property add dev right altname "$short"
ip link property add dev right altname "$long"
ip link set left up
ip link set right up
echo "Linux $(uname -r)"
python3 - right "$short" "$long" <<'END'
import socket, subprocess, sys, time
from pathlib import Path

ETHERTYPE = 0x88A4
time.sleep(0.3)
sender = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
sender.bind(("left", 0))

def works(name: str) -> tuple[bool, str, bool]:
    """By ip; what recvfrom calls the interface after a bind by that name; by /sys."""
    by_ip = subprocess.run(["ip", "link", "show", name], capture_output=True).returncode == 0
    receiver = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    receiver.settimeout(0.5)
    try:
        receiver.bind((name, ETHERTYPE))
        socket.if_nametoindex(name)
        sender.send((b"\xff" * 6 + bytes.fromhex("020000000001") + ETHERTYPE.to_bytes(2, "big")).ljust(60, b"\0"))
        called = receiver.recvfrom(100)[1][0]
    except OSError as error:
        called = error.strerror
    return by_ip, called, Path("/sys/class/net", name).exists()

seen = [works(name) for name in sys.argv[1:]]
for name, (by_ip, called, by_sys) in zip(sys.argv[1:], seen):
    print(f"{name}: ip {'finds it' if by_ip else 'does not'}, /sys {'has it' if by_sys else 'has not'}, bind: {called}")
expected = [(True, "right", True), (True, "right", False), (True, "No such device", False)]
assert seen == expected, "the behavior has changed"
END

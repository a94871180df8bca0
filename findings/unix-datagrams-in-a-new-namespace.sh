#!/usr/bin/env bash
# Linux: a Unix datagram socket in a new network namespace queues 11 datagrams, whatever the machine is set to.
#
# One would guess: Unix sockets are files and have nothing to do with network namespaces; as much fits as SO_RCVBUF
# and SO_SNDBUF allow, and where systemd has raised net.unix.max_dgram_qlen to 512, that holds for the machine.
# What happens: the limit counts datagrams, not bytes, is each namespace's own, begins with 10 in every new one (a new
# one copies nothing from its parent) and is read when the receiver's socket is made. A receiver that pauses for 12 ms
# loses datagrams of a sender of 1 kHz that does not wait, in a container or namespace only. A user meets it when a
# simulator or logger that has always kept up sends to a program in `ip netns exec` or a container. Seen with Linux
# 6.18. Needs root (network namespaces); 77 without.
set -euo pipefail
[ "$(id -u)" = 0 ] || { echo "needs root for a network namespace"; exit 77; }
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat >"$folder/queued.py" <<'END'
import socket, sys

path = sys.argv[1]
receiver = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 200_000)
receiver.bind(path)
sender = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
sender.setblocking(False)
sent = 0
try:
    while True:
        sender.sendto(bytes(120), path)
        sent += 1
except BlockingIOError:
    print(sent)
END
cat >"$folder/inside" <<'END'
cd "$1"
sysctl -q -w net.unix.max_dgram_qlen=512
echo "Linux $(uname -r)"
parent=$(python3 queued.py "$1/parent")
child=$(unshare --net python3 queued.py "$1/child")
echo "where net.unix.max_dgram_qlen is 512: $parent datagrams of 120 bytes are queued"
echo "in a namespace that is made there:    $child"
[ "$parent" -gt 100 ] && [ "$child" = 11 ] || { echo "the behavior has changed"; exit 1; }
END
unshare --net bash "$folder/inside" "$folder"

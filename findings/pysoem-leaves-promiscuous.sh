#!/usr/bin/env bash
# pysoem 1.1.13 (SOEM): the interface stays promiscuous after close(), and after the process.
#
# One would guess: what a program sets on a socket ends with it, as tcpdump's and Wireshark's promiscuous mode does.
# What happens: the flag is set on the interface, as `ip link set ens5 promisc on` does, and nobody takes it off. From
# then on the card hands up every frame of its segment. A user meets it in a security audit, or on an interface that
# was tried once, by mistake (the office network's), and that costs processor time until the next boot. `ip link set
# ens5 promisc off` ends it. A capturing program's own mode (PACKET_ADD_MEMBERSHIP) is shown in `promiscuity` and is
# gone with its socket. Seen with Linux 6.18. Needs root (a network namespace); 77 without.
set -euo pipefail
[ "$(id -u)" = 0 ] || { echo "needs root for a network namespace"; exit 77; }
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check pysoem==1.1.13
cat >"$folder/capture.py" <<'END'
import socket, struct

with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0) as capture:
    capture.setsockopt(263, 1, struct.pack("iHH8s", socket.if_nametoindex("left"), 1, 0, b""))
END
cat >"$folder/master.py" <<'END'
from importlib.metadata import version

import pysoem

print("pysoem", version("pysoem"), flush=True)
master = pysoem.Master()
master.open("left")
master.close()
END
cat >"$folder/inside" <<'END'
set -euo pipefail
ip link add left type veth peer name right
ip link set left up
ip link set right up
promiscuous() { [[ $(ip link show left) == *PROMISC* ]] && echo yes || echo no; }
before=$(promiscuous)
"$0/venv/bin/python" "$0/capture.py"
captured=$(promiscuous)
"$0/venv/bin/python" "$0/master.py"
after=$(promiscuous)
echo "promiscuous: at first $before; after a capture has ended $captured; after a program of pysoem has ended $after"
[ "$before $captured $after" = "no no yes" ] || { echo "the behavior has changed"; exit 1; }
END
unshare --net bash -c 'source "$0/inside"' "$folder"

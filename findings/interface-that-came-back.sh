#!/usr/bin/env bash
# Linux packet socket: its interface goes and comes back under the same name, and the socket stays deaf without an
# error.
#
# One would guess: a socket that is bound to "ens5" either goes on when ens5 is there again, as it does after `ip link
# set ens5 down` and `up`, or every call fails from then on.
# What happens: one recv fails with ENETDOWN. After that, recv times out as on a quiet line and poll reports nothing;
# only send (ENXIO) and getsockname (an empty name) tell. After down and up the first error is the very same and the
# socket goes on: whoever takes ENETDOWN for "wait for the link" waits for ever. A user meets it with a USB adapter
# that is plugged in again. Seen with Linux 6.18. Needs root (a network namespace); 77 without.
set -euo pipefail
[ "$(id -u)" = 0 ] || { echo "needs root for a network namespace"; exit 77; }
[ "${1-}" = inside ] || exec unshare --net "$0" inside
echo "Linux $(uname -r)"
python3 - <<'END'
import select, socket, subprocess, time

ETHERTYPE = 0x88A4
FRAME = (b"\xff" * 6 + bytes.fromhex("020000000001") + ETHERTYPE.to_bytes(2, "big")).ljust(60, b"\0")

def ip(*commands: str) -> None:
    for command in commands:
        subprocess.run(["ip", "link", *command.split()], check=True)

MADE = ("add left type veth peer name right", "set left up", "set right up")

def after(*commands: str) -> tuple[list[str], str, str]:
    """What three calls of recv say, with frames on the wire; what send says then; the interface by getsockname."""
    ip(*MADE)
    socket_ = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    socket_.bind(("right", ETHERTYPE))
    socket_.settimeout(0.3)
    poll = select.poll()
    poll.register(socket_, select.POLLIN)
    ip(*commands)
    time.sleep(0.3)
    sender = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    sender.bind(("left", 0))
    said = []
    for _ in range(3):
        sender.send(FRAME)
        try:
            said.append(f"{len(socket_.recv(100))} bytes")
        except TimeoutError:
            assert not poll.poll(0)
            said.append("times out")
        except OSError as error:
            said.append(error.strerror)
    name = socket_.getsockname()[0]
    try:
        socket_.send(FRAME)
        sent = "is sent"
    except OSError as error:
        sent = error.strerror
    ip("del left")
    return said, sent, name

seen = {"down and up": after("set right down", "set right up"), "removed and made again": after("del left", *MADE)}
for what, (said, sent, name) in seen.items():
    print(f"{what}: recv: {', '.join(said)}; send: {sent}; getsockname: {name!r}")
assert seen["down and up"] == (["Network is down", "60 bytes", "60 bytes"], "is sent", "right")
assert seen["removed and made again"] == (
    ["Network is down", "times out", "times out"], "No such device or address", ""), "the behavior has changed"
END
